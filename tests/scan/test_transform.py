from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from soundmap.scan.lanes import LANES, constant, lanes_array
from soundmap.scan.transform import ROW, transform, transform_plan


@njit
def spectrum_of(samples, hop, offset, plan, spectrum):
    transform(samples, 0, LANES, hop * LANES, constant(offset), plan, spectrum)


@pytest.mark.parametrize(
    ("window", "first", "bins"),
    [
        (1200, 24, 128),  # 15 x 16 x 5
        (1102, 24, 128),  # 29 x 2 x 19: 25 ms at 44.1 kHz
        (512, 0, 258),  # nothing but radix 4 and 2
        (2048, 1000, 30),
        (551, 23, 128),  # odd
        (276, 0, 140),  # past half the rate
        (211, 3, 90),  # a prime
        (16, 1, 9),
        (9, 0, 9),
        (5, 1, 3),
        (4, 0, 4),
    ],
)
def test_a_bands_spectrum_is_that_of_the_whole_transform(window, first, bins):
    rng = np.random.default_rng(window)
    hop = window // 3 + 1
    samples = lanes_array(2 * hop + window, LANES)
    samples[:] = rng.normal(3.0, 1.0, samples.shape)
    spectrum = lanes_array(3, bins + 1, ROW)
    spectrum_of(samples, hop, np.float32(3.0), transform_plan(window, first, bins), spectrum)
    found = spectrum[:, :bins, :LANES] + 1j * spectrum[:, :bins, LANES:]
    frames = [samples[f * hop : f * hop + window] - 3.0 for f in range(3)]
    expected = np.fft.fft(np.array(frames, dtype=np.float64), axis=1)
    assert np.abs(found - expected[:, first : first + bins]).max() < 5e-7 * np.abs(expected).max()
    assert not spectrum[:, bins:].any()


@pytest.mark.parametrize("window", [400, 800, 882, 1102, 1200, 2048, 2400, 4800])
def test_few_sums_are_made_for_a_quarter_of_the_spectrum(window):
    # A whole transform of real samples takes 2.5 L log2 L where L is a power of two.
    plan = transform_plan(window, 24, window // 8)
    halves, columns = len(plan.turn), plan.power * plan.rest
    sums = columns * plan.reals * halves + 4 * halves * columns * (plan.power.bit_length() // 2)
    sums += 4 * len(plan.row) * plan.rest
    assert sums < 3.0 * window * np.log2(window)
