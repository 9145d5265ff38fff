from itertools import pairwise

import numpy as np
from plane_waves import circle, mic_array

from soundmap.beam import beam_patterns
from soundmap.detect.harmonics import beam_table

ARRAY = mic_array(circle(16, 0.155))
EDGES_HZ = (1000.0, 2500.0, 6000.0)
TABLE = beam_table(ARRAY, EDGES_HZ, bearings=120, waves=90, speed_of_sound_m_s=343.0)


def test_a_scan_of_one_wave_is_the_beam_of_the_table():
    scan = np.stack(
        [
            beam_patterns(
                ARRAY.positions_m,
                bearings=120,
                waves=90,
                frequency_hz=np.linspace(low + 50.0, high - 50.0, 60),
                speed_of_sound_m_s=343.0,
            )[17]
            for low, high in pairwise(EDGES_HZ)
        ]
    )
    beam = TABLE.beams[0, 17]
    assert np.linalg.norm(TABLE.harmonics(scan) - beam) < 0.03 * np.linalg.norm(beam)


def test_what_is_the_same_on_all_bearings_tells_nothing():
    assert np.abs(TABLE.harmonics(np.full((3, 2, 120), 7.0))).max() < 1e-12


def test_noise_that_microphones_do_not_share_is_as_loud_in_all_harmonics():
    rng = np.random.default_rng(5)
    looking = 2.0 * np.pi * np.arange(120) / 120
    toward = np.stack([np.cos(looking), np.sin(looking)])
    scans = np.zeros((300, 1, 120))
    for hertz in np.linspace(2600.0, 5900.0, 12):
        steer = np.exp(2j * np.pi * hertz / 343.0 * (ARRAY.positions_m[:, :2] @ toward))
        noise = rng.standard_normal((300, 16, 2)) @ [1.0, 1j]
        scans[:, 0] += np.abs(noise @ steer.conj()) ** 2
    half = scans.repeat(2, axis=1)
    spread = TABLE.harmonics(half)[:, TABLE.starts[1] :].std(axis=0)
    low, high = np.quantile(spread, [0.1, 0.9])  # of some, the array's symmetry leaves nothing
    assert high < 4.0 * low
