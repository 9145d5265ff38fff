import numpy as np
import pytest
from plane_waves import circle, mic_array

from soundmap.beam import beam_patterns

FREQUENCIES = np.linspace(1000.0, 6000.0, 400)


def patterns(**options):
    positions = mic_array(circle(16)).positions_m
    return beam_patterns(
        positions, bearings=24, waves=72, frequency_hz=FREQUENCIES, speed_of_sound_m_s=343.0,
        **options,
    )  # fmt: skip


@pytest.mark.parametrize("aperture", [1.0, 0.6])
def test_the_beam_is_the_mean_over_frequencies_of_a_direct_sum(aperture):
    positions = mic_array(circle(5, 0.1)).positions_m
    beam = beam_patterns(
        positions, bearings=7, waves=9, frequency_hz=FREQUENCIES, aperture=aperture,
        speed_of_sound_m_s=343.0,
    )  # fmt: skip
    looking, coming = 2 * np.pi * 3 / 7, 2 * np.pi * 4 / 9
    step = aperture * np.array([np.cos(coming), np.sin(coming)])
    step -= [np.cos(looking), np.sin(looking)]
    gains = [
        abs(np.mean([np.exp(2j * np.pi * f * (p[:2] @ step) / 343.0) for p in positions])) ** 2
        for f in FREQUENCIES
    ]
    assert beam[4, 3] == pytest.approx(np.mean(gains), abs=1e-5)


def test_sound_that_rises_with_frequency_has_a_narrower_beam():
    slopes = [(FREQUENCIES / 1000.0) ** power for power in (2.0, 0.0, -4.0)]
    rising, even, falling = (patterns(share=share)[0, 2] for share in slopes)
    assert rising < even < falling


def test_a_wave_from_above_has_a_lower_and_wider_beam():
    level, steep = patterns(aperture=1.0)[0], patterns(aperture=0.7)[0]
    assert steep[0] < 0.8 * level[0]
    assert steep[1] / steep[0] > level[1] / level[0]
