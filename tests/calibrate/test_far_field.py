"""What the far field does to bearings, and tells of the clock, in made-up scans."""

from __future__ import annotations

import numpy as np
import pytest

from soundmap.beam import beam_patterns
from soundmap.calibrate.far_field import (
    UNTOLD,
    Surveyed,
    array_beam,
    far_field_clock,
    level_scans,
    without_far_field,
)
from soundmap.calibrate.peaks import clear_peaks
from soundmap.calibrate.way import Way
from soundmap.geometry import Mount, wrapped_angle
from soundmap.sensors import MicArray

TIME_S = 0.1 * np.arange(300)
ANGLE = 2.0 * np.pi * np.arange(16) / 16
RING_M = 0.155 * np.stack([np.cos(ANGLE), np.sin(ANGLE), 0.0 * ANGLE], axis=-1)
UPRIGHT = MicArray(RING_M, Mount.planar(0.0, 0.0, 0.5, 0.0), None)
HANGING = MicArray(RING_M, Mount(np.diag([1.0, -1.0, -1.0]), np.zeros(3)), None)
HERTZ = np.linspace(1000.0, 6000.0, 26)
PATTERNS = beam_patterns(
    RING_M,
    bearings=120,
    waves=720,
    frequency_hz=HERTZ,
    share=HERTZ**2,
    speed_of_sound_m_s=343.0,
)
PLACE_M = np.array([[7.0, 2.5]])


def turning(clock_s, *, most_rad=0.6):
    """The way of an array that drives straight on while it turns to and fro, with rests."""
    phase = 0.8 * (TIME_S + clock_s)
    axis = most_rad * np.tanh(2.0 * np.sin(phase))
    rate = most_rad * 1.6 * np.cos(phase) / np.cosh(2.0 * np.sin(phase)) ** 2
    place = np.column_stack([0.5 * (TIME_S + clock_s), np.zeros(len(TIME_S))])
    return Way(place, axis, np.tile([0.5, 0.0], (len(TIME_S), 1)), rate)


def straight(clock_s):
    return turning(clock_s, most_rad=0.0)


def scans_of(way, *, far=(), near=4.0, noise=0.01, hand=1):
    """Waves from fixed directions of the map (rad, power), and a source in `PLACE_M`."""
    rng = np.random.default_rng(5)
    step = PLACE_M - way.place_m
    waves = [(np.arctan2(step[:, 1], step[:, 0]), near / np.sum(step**2, axis=1))]
    waves += [(np.full(len(way), direction), np.full(len(way), power)) for direction, power in far]
    heard = 0.5 + noise * rng.standard_normal((len(way), 120))
    for direction, power in waves:
        bearing = hand * (direction - way.axis_rad)
        heard += power[:, None] * PATTERNS[np.rint(bearing * 360.0 / np.pi).astype(int) % 720]
    return (0.1 * heard).astype(np.float32)


ALL_ROUND = [
    (direction, 0.2 + 0.3 * (k % 3)) for k, direction in enumerate(np.arange(0.2, 6.2, 0.7))
]


def clock_of(scans, array=UPRIGHT, way_at=turning):
    beam = array_beam(array, 120, low_hz=1000.0, high_hz=6000.0, speed_of_sound_m_s=343.0)
    stretch = Surveyed(0, beam.harmonics(level_scans(scans, array)), PLACE_M)
    return far_field_clock([stretch], way_at, beam, clock_s=0.0, yaw_rad=0.0)


@pytest.mark.parametrize(("array", "hand"), [(UPRIGHT, 1), (HANGING, -1)])
@pytest.mark.parametrize("clock_s", [-0.06, 0.0, 0.08])
def test_a_field_that_stands_still_tells_the_clock(array, hand, clock_s):
    found = clock_of(scans_of(turning(clock_s), far=ALL_ROUND, hand=hand), array)
    assert found.value == pytest.approx(clock_s, abs=0.002)
    assert found.sigma < 0.008


def test_sound_that_is_the_same_on_all_bearings_tells_nothing():
    assert clock_of(scans_of(turning(0.05))) is UNTOLD


def test_without_a_turn_a_field_tells_nothing():
    assert clock_of(scans_of(straight(0.05), far=ALL_ROUND), way_at=straight) is UNTOLD


def test_peaks_are_pulled_less_without_the_far_field():
    way = turning(0.0)
    scans = scans_of(way, far=ALL_ROUND)
    step = PLACE_M[0] - way.place_m
    true = np.arctan2(step[:, 1], step[:, 0]) - way.axis_rad

    def pulled(some):
        peaks = clear_peaks(some)
        error = np.abs(wrapped_angle(peaks.bearing_rad - true[peaks.scan]))
        return np.sqrt(np.mean(error[error < np.radians(6.0)] ** 2))

    assert pulled(without_far_field(scans, way.axis_rad)) < 0.5 * pulled(scans)
