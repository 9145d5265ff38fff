import numpy as np
import pytest
from plane_waves import circle, mic_array

from soundmap.detect.evidence import Evidence
from soundmap.detect.harmonics import beam_table
from soundmap.detect.sound_paths import (
    CEILING_M,
    CEILING_SHARE,
    FLOOR_SHARE,
    Kind,
    Path,
    departures,
    heard_places,
    sound_paths,
    waves_heard,
)

WAVES = 360
WALL = np.array([[1.0, 0.0, 3.0]])
"""The plane x = 3 m."""
TABLE = beam_table(
    mic_array(circle(16, 0.155)), (1000.0, 6000.0), bearings=120, waves=WAVES,
    speed_of_sound_m_s=343.0,
)  # fmt: skip


def evidence(turn=0.0, axis=0.0):
    """One scan from the origin; the lasers see the wall and nothing else."""
    ray = axis + 2.0 * np.pi * np.arange(WAVES) / WAVES
    with np.errstate(divide="ignore"):
        to_wall = np.where(np.cos(ray) > 0.01, 3.0 / np.cos(ray), np.nan)
    return Evidence(
        time_s=np.zeros(1),
        place_m=np.zeros((1, 2)),
        axis_rad=np.array([axis]),
        handedness=1,
        height_m=0.6,
        turn_rad=np.array([turn]),
        merged=np.ones(1, np.int64),
        range_m=to_wall[None].astype(np.float32),
        heard=np.zeros((1, TABLE.beams.shape[2]), np.float32),
        weight=np.ones((1, 1)),
        table=TABLE,
    )


@pytest.mark.parametrize("axis", [0.0, 1.1])
def test_a_source_is_heard_directly_and_by_its_images(axis):
    paths = sound_paths(evidence(axis=axis), WALL, np.array([2.0, 1.0]), 0.5, Kind.SOURCE)
    assert paths.gain[Path.DIRECT, 0] == pytest.approx(1.0 / (5.0 + 0.25))
    assert paths.aperture[Path.DIRECT, 0] == pytest.approx(np.sqrt(5.0 / 5.25))
    floor, ceiling = 1.0 / (5.0 + 1.2**2), 1.0 / (5.0 + CEILING_M**2)
    assert paths.gain[Path.FLOOR, 0] == pytest.approx(floor + CEILING_SHARE / FLOOR_SHARE * ceiling)
    below, above = 1.0 / (17.0 + 1.2**2), 1.0 / (17.0 + CEILING_M**2)
    assert paths.gain[Path.WALLS, 0] == pytest.approx(
        1.0 / (17.0 + 0.25) + FLOOR_SHARE * below + CEILING_SHARE * above
    )
    flat = np.sqrt(17.0 / (17.0 + CEILING_M**2))
    assert flat < paths.aperture[Path.WALLS, 0] < 1.0
    toward = np.radians(paths.wave[Path.WALLS, 0]) + axis
    assert np.arctan2(np.sin(toward), np.cos(toward)) == pytest.approx(np.arctan2(1.0, 4.0))
    assert paths.gain[Path.HIDDEN, 0] == 0.0


def test_what_lies_behind_a_wall_is_hidden_but_may_be_an_image():
    place = np.array([4.5, 0.0])
    source = sound_paths(evidence(), WALL, place, 0.2, Kind.SOURCE)
    assert source.gain[Path.DIRECT, 0] == 0.0
    assert source.gain[Path.HIDDEN, 0] > 0.0
    image = sound_paths(evidence(), WALL, place, 0.2, Kind.IMAGE)
    assert image.gain[Path.DIRECT, 0] > 0.0
    assert image.beyond_m[0] == pytest.approx(1.5, abs=1e-6)


def test_a_wall_that_no_laser_sees_there_mirrors_nothing():
    elsewhere = np.array([[0.0, 1.0, 2.5]])
    paths = sound_paths(evidence(), elsewhere, np.array([2.0, 1.0]), 0.2, Kind.SOURCE)
    assert paths.gain[Path.WALLS, 0] == 0.0


def test_a_wave_is_heard_as_its_beam_and_a_turn_blurs_it():
    wave, aperture, gain = np.array([40.25]), np.ones(1), np.array([2.0])
    still = waves_heard(evidence(), wave, aperture, gain)[0]
    between = 0.75 * TABLE.beams[0, 40] + 0.25 * TABLE.beams[0, 41]
    np.testing.assert_allclose(still, 2.0 * between, atol=1e-4)
    turned = waves_heard(evidence(turn=np.radians(9.0)), wave, aperture, gain)[0]
    moments = [waves_heard(evidence(), wave + shift, aperture, gain)[0] for shift in range(-4, 5)]
    mean = np.mean(moments, axis=0)
    assert np.linalg.norm(turned - mean) < 0.12 * np.linalg.norm(mean)
    assert np.linalg.norm(turned) < 0.97 * np.linalg.norm(still)


def test_sound_leaves_toward_the_point_of_reflection():
    place, stand = np.array([2.0, 1.0]), np.zeros((1, 2))
    np.testing.assert_allclose(heard_places(WALL, place)[[Path.FLOOR, Path.WALLS]],
                               [[2.0, 1.0], [4.0, 1.0]])  # fmt: skip
    toward = departures(WALL, place, stand)
    np.testing.assert_allclose(toward[Path.DIRECT, 0], np.array([-2.0, -1.0]) / np.sqrt(5.0))
    mirror = np.array([3.0, 0.75])
    way = (mirror - place) / np.linalg.norm(mirror - place)
    np.testing.assert_allclose(toward[Path.WALLS, 0], way)
