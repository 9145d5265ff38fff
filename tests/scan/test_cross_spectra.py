from __future__ import annotations

import numpy as np
import pytest
from plane_waves import circle, corner, mic_array, scattered

from soundmap.scan.cross_spectra import BaselineSpectra, baseline_spectra_plain
from soundmap.scan.spectrum import Framing, band_bins
from soundmap.scan.steering import steering_table


def band_and_table(positions, rate_hz, window, low_hz, high_hz, splits=()):
    band = band_bins(rate_hz, window, low_hz=low_hz, high_hz=high_hz)
    table = steering_table(
        mic_array(positions).positions_m,
        24,
        first_bin=band.first,
        frequency_hz=band.frequency_hz,
        weight=band.weight,
        speed_of_sound_m_s=343.0,
        splits=splits,
    )
    return band, table


def compiled(samples, framing, table):
    spectra = np.empty((1, *table.spectra_shape), dtype=np.float32)
    assert BaselineSpectra(samples.shape[1], framing, table).write(samples, 0, spectra).all()
    return spectra[0]


@pytest.mark.parametrize("dtype", ["int16", "int32", "float32", "float64"])
@pytest.mark.parametrize("shape", ["circle", "corner", "scattered", "one"])
@pytest.mark.parametrize(
    ("rate_hz", "window", "low_hz", "high_hz", "splits"),
    [
        (48000.0, 1200, 1000.0, 6000.0, ()),
        (48000.0, 1200, 1000.0, 6000.0, (16, 39)),
        (8000.0, 200, 10.0, 4000.0, ()),
        (8000.0, 201, 10.0, 4000.0, (1, 99)),
        (8000.0, 16, 2000.0, 4000.0, ()),
    ],
)
def test_the_compiled_cross_spectra_are_the_plain_ones(
    rate_hz, window, low_hz, high_hz, splits, shape, dtype
):
    rng = np.random.default_rng([1, window])
    positions = {
        "circle": circle(16),
        "corner": corner(5),
        "scattered": scattered(7, rng),
        "one": np.zeros((1, 2)),
    }[shape]
    framing = Framing(window, window // 3, 4)
    band, table = band_and_table(positions, rate_hz, window, low_hz, high_hz, splits)
    samples = rng.normal(50.0, 3000.0, (framing.span, len(positions))).astype(dtype)
    channels = samples.T.astype(np.float64)
    channels -= channels.mean(axis=1, keepdims=True)
    plain = baseline_spectra_plain(channels, framing, band, table)
    assert np.abs(compiled(samples, framing, table) - plain).max() < 2e-6 * np.abs(plain).max()


@pytest.mark.parametrize("order", ["C", "F"])
def test_how_samples_lie_in_memory_does_not_matter(order):
    rng = np.random.default_rng(2)
    framing = Framing(200, 80, 3)
    _, table = band_and_table(circle(4), 8000.0, 200, 500.0, 3000.0)
    samples = rng.integers(-3000, 3000, (2 * framing.span, 4)).astype(np.int16)
    part = np.array(samples, order=order)[::2]
    expected = compiled(np.ascontiguousarray(part), framing, table)
    assert np.array_equal(compiled(part, framing, table), expected)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_samples_that_are_not_finite_are_refused_and_leave_nothing_behind(value):
    rng = np.random.default_rng(3)
    framing = Framing(200, 80, 3)
    _, table = band_and_table(circle(4), 8000.0, 200, 500.0, 3000.0)
    samples = rng.standard_normal((framing.span, 4))
    broken = samples.copy()
    broken[100, 2] = value
    samples = np.concatenate([samples, broken, samples])
    spectra = np.empty((3, *table.spectra_shape), dtype=np.float32)
    finite = BaselineSpectra(4, framing, table).write(samples, framing.span, spectra)
    assert finite.tolist() == [True, False, True]
    assert np.isfinite(spectra).all()
    assert not spectra[1].any()
    assert np.array_equal(spectra[0], spectra[2])
