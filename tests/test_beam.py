import numpy as np
import pytest
from plane_waves import circle, mic_array

from soundmap.beam import beam_patterns, turned_beam_patterns

BAND = {"low_hz": 1000.0, "high_hz": 6000.0, "speed_of_sound_m_s": 343.0}


def patterns(slope=-6.0, bearings=24, waves=72):
    positions = mic_array(circle(16)).positions_m
    return beam_patterns(
        positions, bearings=bearings, waves=waves, slope_db_per_octave=slope, **BAND
    )


def test_the_beam_is_the_mean_over_frequencies_of_a_direct_sum():
    positions = mic_array(circle(5, 0.1)).positions_m
    beam = beam_patterns(positions, bearings=7, waves=9, slope_db_per_octave=0.0, **BAND)
    looking, coming = 2 * np.pi * 3 / 7, 2 * np.pi * 4 / 9
    step = np.array([np.cos(coming) - np.cos(looking), np.sin(coming) - np.sin(looking)])
    gains = [
        abs(np.mean([np.exp(2j * np.pi * f * (p[:2] @ step) / 343.0) for p in positions])) ** 2
        for f in np.linspace(1000.0, 6000.0, 400)
    ]
    assert beam[4, 3] == pytest.approx(np.mean(gains), abs=0.01)


def test_sound_that_rises_with_frequency_has_a_narrower_beam():
    assert patterns(8.0)[0, 2] < patterns(0.0)[0, 2] < patterns(-14.0)[0, 2]


def test_a_turn_blurs_the_beam_as_the_mean_of_its_moments_does():
    at_rest = patterns(waves=360)
    turned = turned_beam_patterns(at_rest, np.radians(9.0))
    moments = np.mean([np.roll(at_rest, shift, axis=0) for shift in range(-4, 5)], axis=0)
    np.testing.assert_allclose(turned, moments, atol=2e-3)
    assert turned[0, 0] < at_rest[0, 0] - 0.01
