from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import get_window

from soundmap.scan.spectrum import (
    Framing,
    band_bins,
    band_spectrum,
    cross_spectral_matrix,
    hann_power,
)


def test_the_papers_frames_at_its_rate():
    framing = Framing.from_times(48000.0, window_s=0.025, hop_s=0.010, frames=10)
    assert (framing.window, framing.hop, framing.span, framing.advance) == (1200, 480, 5520, 4800)


def test_a_hop_is_a_whole_number_of_samples_at_any_rate():
    framing = Framing.from_times(11025.0, window_s=0.025, hop_s=0.010, frames=10)
    assert (framing.window, framing.hop, framing.advance) == (276, 110, 1100)


@pytest.mark.parametrize(("window", "hop", "frames"), [(3, 1, 1), (100, 0, 1), (100, 50, 0)])
def test_frames_without_extent_are_refused(window, hop, frames):
    with pytest.raises(ValueError, match="holds no sound"):
        Framing(window, hop, frames)


@given(
    rate_hz=st.floats(8000.0, 192000.0),
    window=st.integers(200, 9600),
    edges=st.tuples(st.floats(0.01, 1.0), st.floats(0.01, 1.0)).filter(
        lambda pair: abs(pair[0] - pair[1]) > 0.01
    ),
)
def test_the_weights_of_the_bins_add_up_to_the_band(rate_hz, window, edges):
    width = rate_hz / window
    low_hz, high_hz = (share * rate_hz / 2.0 for share in sorted(edges))
    band = band_bins(rate_hz, window, low_hz=low_hz, high_hz=high_hz)
    lost = max(0.5 * width - low_hz, 0.0)  # to bin 0
    covered_hz = 0.5 * band.weight.sum() * width
    # A window of odd length has no bin for the last half width below half the rate.
    assert high_hz - low_hz - lost - 0.5 * width < covered_hz + 1e-6 * rate_hz
    assert covered_hz < high_hz - low_hz - lost + 1e-6 * rate_hz
    assert np.all(band.weight > 0.0)
    assert np.all(band.weight <= 2.0 + 1e-9)
    assert np.allclose(band.frequency_hz, (band.first + np.arange(len(band))) * width)
    assert band.first >= 1


def test_the_bin_at_half_the_rate_counts_once():
    band = band_bins(8000.0, 200, low_hz=1000.0, high_hz=4000.0)
    assert band.frequency_hz[-1] == 4000.0
    assert band.weight[-1] == pytest.approx(1.0)


def test_an_impossible_band_is_refused_with_what_to_do():
    with pytest.raises(ValueError, match=r"1000 Hz to 6000 Hz .* 4000 Hz, half .* 8000 Hz.* set"):
        band_bins(8000.0, 200, low_hz=1000.0, high_hz=6000.0)
    with pytest.raises(ValueError, match="is empty"):
        band_bins(48000.0, 1200, low_hz=2000.0, high_hz=2000.0)
    with pytest.raises(ValueError, match="longer window"):
        band_bins(48000.0, 480, low_hz=10.0, high_hz=20.0)


@pytest.mark.parametrize(
    ("rate_hz", "window", "low_hz", "high_hz"),
    [(48000.0, 1200, 1000.0, 6000.0), (8000.0, 200, 10.0, 4000.0), (8000.0, 201, 10.0, 4000.0)],
)
def test_the_spectrum_is_that_of_hann_windowed_frames(rate_hz, window, low_hz, high_hz):
    rng = np.random.default_rng(1)
    framing = Framing(window, window // 3, 4)
    band = band_bins(rate_hz, window, low_hz=low_hz, high_hz=high_hz)
    channels = rng.standard_normal((6, framing.span + 5))
    spectrum = band_spectrum(channels, framing, band)
    assert spectrum.shape == (len(band), 6, 4)
    hann = get_window("hann", window)  # periodic, by scipy
    for frame in range(4):
        start = frame * framing.hop
        windowed = np.fft.rfft(hann * channels[:, start : start + window])
        expected = windowed[:, band.first : band.first + len(band)].T
        assert np.allclose(spectrum[:, :, frame], expected, rtol=0, atol=1e-10)
    assert hann_power(window) == pytest.approx(window * np.sum(hann**2))


def test_single_precision_stays_single():
    framing = Framing(200, 80, 2)
    band = band_bins(8000.0, 200, low_hz=500.0, high_hz=2000.0)
    spectrum = band_spectrum(np.ones((3, 280), dtype=np.float32), framing, band)
    assert spectrum.dtype == np.complex64
    assert cross_spectral_matrix(spectrum).dtype == np.complex64


def test_cross_spectra_are_sums_over_frames_of_products_of_pairs():
    rng = np.random.default_rng(2)
    spectrum = rng.standard_normal((3, 4, 5)) + 1j * rng.standard_normal((3, 4, 5))
    matrix = cross_spectral_matrix(spectrum)
    assert np.allclose(matrix, np.einsum("kmf,knf->kmn", spectrum, spectrum.conj()))
    assert np.allclose(matrix, matrix.conj().transpose(0, 2, 1))
