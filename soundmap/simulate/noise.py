"""Noise: sound at the microphones that comes from no source, as periodic tables."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray
from soundmap.simulate.propagation import FloatTable
from soundmap.simulate.spectra import (
    a_weighting,
    machine_density,
    noise_spectrum,
    one_period,
    with_level,
)

BAND_BINS = 64
"""Neighbouring frequencies that share one coherence matrix."""
_MOTORS_M = np.array([[0.0, 0.17, 0.08], [0.0, -0.17, 0.08]])
"""Where the drive noise comes from, in the base frame [m]."""


def diffuse_noise(
    positions_m: FloatArray,
    density: FloatArray,
    rate_hz: float,
    speed_of_sound_m_s: float,
    rng: np.random.Generator,
) -> NDArray[np.complex64]:
    r"""Half spectra of noise that comes evenly from all directions.

    The coherence of two microphones at distance d is :math:`\sin(kd) / kd`: independent noises
    are mixed by a square root of the matrix of coherences, frequency by frequency.

    Parameters
    ----------
    positions_m : ndarray, shape (Q, 3)
    density : ndarray, shape (F,)
        Power density at each frequency of the half spectrum, arbitrary unit.
    rate_hz, speed_of_sound_m_s : float
    rng : numpy.random.Generator

    Returns
    -------
    ndarray, shape (Q, F)
    """
    count, bins = len(positions_m), len(density)
    distance = np.linalg.norm(positions_m[:, None] - positions_m[None], axis=-1)
    frequency = np.arange(bins) * (0.5 * rate_hz / (bins - 1))
    result = np.zeros((count, bins), dtype=np.complex64)
    for first in range(0, bins, BAND_BINS):
        band = slice(first, min(first + BAND_BINS, bins))
        kd_over_pi = 2.0 * np.mean(frequency[band]) * distance / speed_of_sound_m_s
        power, shape = np.linalg.eigh(np.sinc(kd_over_pi))
        mixing = shape * np.sqrt(np.maximum(power, 0.0))
        random = rng.standard_normal((2, count, band.stop - band.start))
        result[:, band] = mixing @ (random[0] + 1j * random[1]) * np.sqrt(density[band])
    return result


def ambient_table(
    positions_m: FloatArray,
    dba: float,
    length: int,
    rate_hz: float,
    speed_of_sound_m_s: float,
    rng: np.random.Generator,
) -> FloatTable:
    """One period of diffuse ambient noise at every microphone [Pa], shape (Q, length).

    The level is that of the microphones' mean power.
    """
    density = machine_density("ambient", np.fft.rfftfreq(length, 1.0 / rate_hz).astype(float))
    spectra = diffuse_noise(positions_m, density, rate_hz, speed_of_sound_m_s, rng)
    return _periods(spectra, length, rate_hz, dba)


def drive_table(
    positions_m: FloatArray,
    dba: float,
    length: int,
    rate_hz: float,
    speed_of_sound_m_s: float,
    rng: np.random.Generator,
) -> FloatTable:
    """One period of the noise of two motors at every microphone [Pa], shape (Q, length).

    Parameters
    ----------
    positions_m : ndarray, shape (Q, 3)
        In the base frame.
    dba : float
        Level of the microphones' mean power at full speed.
    """
    omega = 2.0 * np.pi * np.fft.rfftfreq(length, 1.0 / rate_hz)
    spectra = np.zeros((len(positions_m), len(omega)), dtype=np.complex64)
    for motor in _MOTORS_M:
        sound = noise_spectrum("drive", length, rate_hz, rng)
        for row, distance in zip(spectra, np.linalg.norm(positions_m - motor, axis=1), strict=True):
            row += (np.exp(-1j * omega * (distance / speed_of_sound_m_s)) / distance) * sound
    return _periods(spectra, length, rate_hz, dba)


def self_noise_rms(dba: float, rate_hz: float) -> float:
    """Root mean square of white noise with an A-weighted level, up to half the rate [Pa]."""
    share = float(np.mean(a_weighting(np.linspace(0.0, 0.5 * rate_hz, 4096)) ** 2))
    return float(20e-6 * 10.0 ** (dba / 20.0) / np.sqrt(share))


def _periods(spectra: NDArray[np.complex64], length: int, rate_hz: float, dba: float) -> FloatTable:
    mean = np.sqrt(np.mean(np.abs(spectra).astype(np.float64) ** 2, axis=0)) + 0j
    scaled = with_level(mean, length, rate_hz, dba)
    at = int(np.argmax(np.abs(mean)))
    scale = float(np.abs(scaled[at]) / np.abs(mean[at]))
    return np.stack([one_period(row * np.float32(scale), length) for row in spectra])
