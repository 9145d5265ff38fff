import numpy as np
import pytest

from soundmap.simulate.noise import ambient_table, diffuse_noise, drive_table, self_noise_rms
from soundmap.simulate.spectra import a_weighting

RATE, SPEED = 48000.0, 343.0
ANGLE = 2 * np.pi * np.arange(8) / 8
CIRCLE = np.stack([0.155 * np.cos(ANGLE), 0.155 * np.sin(ANGLE), 0.6 + 0 * ANGLE], axis=-1)


def measured_dba(signal: np.ndarray) -> float:
    """A-weighted level of the channels' mean power [dB re 20 uPa]."""
    spectrum = np.fft.rfft(signal.astype(float), axis=-1)
    weight = a_weighting(np.fft.rfftfreq(signal.shape[-1], 1 / RATE))
    power = 2 * np.mean(np.sum((np.abs(spectrum) * weight) ** 2, axis=-1)) / signal.shape[-1] ** 2
    return float(10 * np.log10(power / 20e-6**2))


def test_the_coherence_of_diffuse_noise_is_that_of_the_closed_form() -> None:
    bins = (1 << 17) + 1
    spectra = diffuse_noise(CIRCLE, np.ones(bins), RATE, SPEED, np.random.default_rng(4))
    frequency = np.arange(bins) * 0.5 * RATE / (bins - 1)
    for first, second in ((0, 1), (0, 3), (0, 4), (2, 7)):
        distance = np.linalg.norm(CIRCLE[first] - CIRCLE[second])
        for low in np.arange(200.0, 6000.0, 400.0):
            band = (frequency >= low) & (frequency < low + 100.0)
            a, b = spectra[first, band], spectra[second, band]
            coherence = np.vdot(b, a) / np.sqrt(np.vdot(a, a).real * np.vdot(b, b).real)
            expected = np.mean(np.sinc(2 * frequency[band] * distance / SPEED))
            assert abs(coherence - expected) < 4.5 / np.sqrt(band.sum())


def test_ambient_and_drive_noise_have_the_levels_asked_for() -> None:
    rng = np.random.default_rng(1)
    ambient = ambient_table(CIRCLE, 42.0, 1 << 16, RATE, SPEED, rng)
    drive = drive_table(CIRCLE, 40.0, 1 << 16, RATE, SPEED, rng)
    assert measured_dba(ambient) == pytest.approx(42.0, abs=0.1)
    assert measured_dba(drive) == pytest.approx(40.0, abs=0.1)


def test_self_noise_has_the_level_asked_for() -> None:
    noise = self_noise_rms(28.0, RATE) * np.random.default_rng(1).standard_normal((4, 1 << 16))
    assert measured_dba(noise) == pytest.approx(28.0, abs=0.1)
