"""Clock and yaw that are off by a known amount, put into audio scans of a made-up drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soundmap.calibrate.calibration import array_offsets
from soundmap.config import CalibrateConfig, ScanConfig
from soundmap.geometry import Mount, Trajectory
from soundmap.sensors import MicArray, OffsetVerdict

START_NS = 1_700_000_000_000_000_000
BEARINGS = 2.0 * np.pi * np.arange(120) / 120
AROUND = 2.0 * np.pi * np.arange(16) / 16
RING_M = 0.155 * np.stack([np.cos(AROUND), np.sin(AROUND), 0.0 * AROUND], axis=-1)
LEVEL = Mount.planar(0.1, -0.05, 0.5, 0.3)
HANGING = Mount(LEVEL.rotation @ np.diag([1.0, -1.0, -1.0]), LEVEL.translation_m)
SOURCES = ((2.0, -1.5, 8.0), (5.5, 2.5, 10.0), (1.0, 4.5, 6.0))
"""x, y [m], and how far it stands out from the rest at 1 m."""
SERPENTINE = ((4.0, 0.0), (2.0, 0.8), (1.5, 0.0), (2.0, 0.8), (2.5, 0.0), (2.0, -0.8), (2.0, 0.0))
STRAIGHT = ((16.0, 0.0),)
"""Legs of a drive: for so long [s], turning so fast [rad/s]."""


def drive(legs, speed_m_s=0.5):
    """Trajectory of a robot that starts in the origin."""
    step_s = 0.02
    rate = np.concatenate([np.full(round(duration / step_s), turn) for duration, turn in legs])
    heading = np.concatenate([[0.0], np.cumsum(rate * step_s)])
    way = speed_m_s * step_s * np.column_stack([np.cos(heading[:-1]), np.sin(heading[:-1])])
    place = np.concatenate([np.zeros((1, 2)), np.cumsum(way, axis=0)])
    time_ns = START_NS + np.rint(np.arange(len(heading)) * step_s * 1e9).astype(np.int64)
    return Trajectory(time_ns, np.column_stack([place, heading]), np.ones(len(heading), dtype=bool))


def sharp_scans(way, time_ns, mount, sources, walk_m_s, width, rng):
    """What sources that stand or walk would give, while the array turns during each scan."""
    pose = way.at(time_ns[:, None] + np.linspace(-5e7, 5e7, 11).astype(np.int64))[:, :, None]
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    looking = mount.base_bearing(BEARINGS) + pose[..., 2]
    x, y = mount.translation_m[:2]
    heard = 1.0 + 0.04 * rng.standard_normal((len(time_ns), len(BEARINGS)))
    for source_x, source_y, strength in sources:
        walked = np.multiply.outer((time_ns - START_NS) * 1e-9, walk_m_s)[:, None, None]
        away_x = source_x + walked[..., 0] - pose[..., 0] - cos * x + sin * y
        away_y = source_y + walked[..., 1] - pose[..., 1] - sin * x - cos * y
        lobe = np.exp(80.0 / width**2 * (np.cos(looking - np.arctan2(away_y, away_x)) - 1.0))
        heard += (strength / (away_x**2 + away_y**2) * lobe).mean(axis=1)
    return (0.06 * heard).astype(np.float32)


def offsets_of(
    legs=SERPENTINE,
    sources=SOURCES,
    *,
    clock_s=0.0,
    yaw_rad=0.0,
    mount=LEVEL,
    positions_m=RING_M,
    mode="correct",
    walk_m_s=(0.0, 0.0),
    trusted=True,
    seed=1,
):
    """What is estimated if the audio's stamps are `clock_s` early and the mount `yaw_rad` off."""
    way = drive(legs)
    margin_ns, step_ns = 400_000_000, 100_000_000
    true_ns = np.arange(START_NS + margin_ns, way.time_ns[-1] - margin_ns, step_ns)
    width, rng = RING_M.max() / positions_m.max(), np.random.default_rng(seed)
    sharp = sharp_scans(way, true_ns, mount, sources, walk_m_s, width, rng)
    back = Mount.planar(0.0, 0.0, 0.0, -yaw_rad)
    believed = Mount(back.rotation @ mount.rotation, mount.translation_m)
    stamped_ns = true_ns - round(clock_s * 1e9)
    array = MicArray(positions_m, believed, None)
    way = replace(way, usable=np.full(len(way), trusted))
    return array_offsets(sharp, stamped_ns, way, array, ScanConfig(), CalibrateConfig(mode=mode))


@pytest.mark.parametrize("mount", [LEVEL, HANGING], ids=["upright", "upside down"])
@pytest.mark.parametrize(("clock_ms", "yaw_deg"), [(80, -8), (-80, 8), (-50, -4), (30, 3)])
def test_what_is_off_is_found_and_corrected(clock_ms, yaw_deg, mount):
    found = offsets_of(clock_s=clock_ms * 1e-3, yaw_rad=np.radians(yaw_deg), mount=mount)
    assert 1e3 * found.clock.correction == pytest.approx(clock_ms, abs=3.0)
    assert np.degrees(found.yaw.correction) == pytest.approx(yaw_deg, abs=0.2)
    assert found.why == ""


@pytest.mark.parametrize("seed", range(3))
def test_what_is_right_is_left_as_it_is(seed):
    found = offsets_of(seed=seed)
    assert (found.clock.verdict, found.yaw.verdict) == (OffsetVerdict.NOUGHT,) * 2
    assert found.clock.correction == found.yaw.correction == 0.0
    assert abs(found.clock.value) < 0.003
    assert abs(found.yaw.value) < np.radians(0.5)


def test_only_what_is_off_is_corrected():
    found = offsets_of(yaw_rad=np.radians(5.0))
    assert np.degrees(found.yaw.correction) == pytest.approx(5.0, abs=0.2)
    assert found.clock.correction == 0.0


def test_in_report_mode_it_is_told_but_not_corrected():
    found = offsets_of(clock_s=0.06, yaw_rad=np.radians(5.0), mode="report")
    assert (found.clock.verdict, found.yaw.verdict) == (OffsetVerdict.CLEAR,) * 2
    assert found.clock.correction == found.yaw.correction == 0.0
    assert found.clock.value == pytest.approx(0.06, abs=0.003)


def test_one_source_is_enough_if_the_robot_turns_beside_it():
    found = offsets_of(sources=SOURCES[:1], clock_s=0.06, yaw_rad=np.radians(5.0))
    assert 1e3 * found.clock.correction == pytest.approx(60.0, abs=10.0)
    assert np.degrees(found.yaw.correction) == pytest.approx(5.0, abs=0.5)


def test_a_small_array_has_a_wide_beam_and_is_less_sure():
    small = offsets_of(clock_s=0.08, yaw_rad=np.radians(8.0), positions_m=RING_M / 3.0)
    large = offsets_of(clock_s=0.08, yaw_rad=np.radians(8.0))
    assert np.degrees(small.yaw.value) == pytest.approx(8.0, abs=1.0)
    assert small.clock.value == pytest.approx(0.08, abs=0.015)
    assert small.yaw.sigma > 1.5 * large.yaw.sigma
    assert small.clock.sigma > 1.5 * large.clock.sigma


def test_without_a_source_nothing_is_said():
    found = offsets_of(sources=())
    assert (found.clock.verdict, found.yaw.verdict) == (OffsetVerdict.UNKNOWN,) * 2
    assert found.why


def test_without_a_turn_the_clock_cannot_be_told():
    found = offsets_of(STRAIGHT, clock_s=0.06, yaw_rad=np.radians(5.0))
    assert found.clock.verdict is OffsetVerdict.UNKNOWN
    assert found.clock.correction == 0.0
    assert "turns" in found.why


@pytest.mark.parametrize("walk_m_s", [(0.3, 0.1), (-0.2, 0.3), (0.0, -0.5)])
def test_a_source_that_walks_is_not_taken_for_an_error_of_the_array(walk_m_s):
    found = offsets_of(sources=((2.0, -1.5, 12.0),), walk_m_s=walk_m_s)
    assert found.clock.correction == found.yaw.correction == 0.0
    assert "fixed places" in found.why
    assert found.guess is not None  # for a fit that may know better


def test_too_short_a_run_says_so():
    found = offsets_of(((3.0, 0.3),))
    assert found.clock.verdict is OffsetVerdict.UNKNOWN
    assert "too few" in found.why
    assert np.isnan(found.clock.value)


def test_a_run_without_a_trusted_pose_says_so():
    found = offsets_of(trusted=False)
    assert found.yaw.verdict is OffsetVerdict.UNKNOWN
    assert "trusted pose" in found.why


def test_a_stretch_where_nothing_is_heard_does_not_hide_what_the_others_tell():
    legs = (*SERPENTINE, (90.0, 0.0))
    found = offsets_of(legs, clock_s=0.05, yaw_rad=np.radians(5.0))
    assert 1e3 * found.clock.correction == pytest.approx(50.0, abs=5.0)
    assert np.degrees(found.yaw.correction) == pytest.approx(5.0, abs=0.5)


def test_a_long_run_is_one_of_many_stretches():
    loop = ((8.0, 0.0), (2.0, 0.785)) * 8
    sources = ((2.0, -1.5, 8.0), (6.0, 2.0, 8.0), (2.0, 6.0, 8.0), (-1.5, 2.0, 8.0))
    found = offsets_of(loop, sources, clock_s=0.04, yaw_rad=np.radians(-3.0))
    assert 1e3 * found.clock.correction == pytest.approx(40.0, abs=3.0)
    assert np.degrees(found.yaw.correction) == pytest.approx(-3.0, abs=0.2)
    assert found.places > 8


def test_a_robot_that_hardly_moves_says_so():
    found = offsets_of(((0.6, 2.5), (0.6, -2.5), (0.6, 2.5), (0.6, -2.5)))
    assert found.yaw.verdict is OffsetVerdict.UNKNOWN
    assert np.isnan(found.yaw.value)
