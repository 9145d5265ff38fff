from dataclasses import replace

import numpy as np
import pytest

from soundmap.carrying import odometry_times_between
from soundmap.config import MappingConfig
from soundmap.errors import NothingUsableError
from soundmap.geometry import Trajectory, composed, transformed
from soundmap.losses import LossLedger
from soundmap.mapping.geometric_map import (
    build_map,
    carried_trajectory,
    held_in_place,
    tied_together,
)
from soundmap.mapping.pose_graph import Links
from tests import worlds
from tests.mapping import drives

ERRORS = {
    "sound odometry": {},
    "odometry long by 5 % that bends to the left": {"scale": 1.05, "turn_per_metre": 0.05},
    "odometry short by 5 % that bends to the right": {"scale": 0.95, "turn_per_metre": -0.05},
}


@pytest.fixture(scope="module")
def drive():
    truth = worlds.driven(drives.ROUND)
    scans = worlds.laser_scans(truth, [worlds.FRONT, worlds.BACK], rate_hz=6, beams=271)
    return truth, drives.noisy(scans, 0.015)


def distance_to_walls(points):
    walls = worlds.segments()
    along = walls[:, 1] - walls[:, 0]
    share = np.einsum("psk,sk->ps", points[:, None] - walls[:, 0], along) / np.sum(along**2, 1)
    foot = walls[:, 0] + np.clip(share, 0, 1)[..., None] * along
    return np.hypot(*np.moveaxis(points[:, None] - foot, -1, 0)).min(axis=1)


@pytest.mark.parametrize("error", ERRORS.values(), ids=ERRORS)
def test_a_drive_is_mapped_whatever_the_odometry(drive, error):
    truth, scans = drive
    built = build_map(lambda: scans, drives.reported(truth, **error), MappingConfig())
    true = drives.from_first(truth, built.trajectory.time_ns)
    off_m, off_rad = drives.errors(built.trajectory.pose, true)
    assert np.median(off_m) < 0.01
    assert np.max(off_m) < 0.03
    assert np.median(off_rad) < np.radians(0.15)
    assert built.trajectory.usable.all()
    start = truth.at(built.trajectory.time_ns[0])
    walls = transformed(start, built.room.frame.centres(np.argwhere(built.room.occupied)))
    distance = distance_to_walls(walls)
    assert np.mean(distance < 0.06) > 0.98, "walls stand where they are, and once"
    assert len(walls) > 300
    if error:
        assert built.facts.odometry.distance_scale == pytest.approx(1 / error["scale"], abs=0.01)


def test_one_scanner_with_half_a_view_is_enough(drive):
    truth, scans = drive
    front = [scan for scan in scans if scan.scanner == 0]
    built = build_map(lambda: front, drives.reported(truth, scale=1.03), MappingConfig())
    true = drives.from_first(truth, built.trajectory.time_ns)
    assert np.median(drives.errors(built.trajectory.pose, true)[0]) < 0.02


def test_the_same_log_gives_the_same_map(drive):
    truth, scans = drive
    odometry = drives.reported(truth, scale=1.02)
    first, second = (build_map(lambda: scans[:120], odometry, MappingConfig()) for _ in range(2))
    np.testing.assert_array_equal(first.trajectory.pose, second.trajectory.pose)
    np.testing.assert_array_equal(first.room.occupied, second.room.occupied)


def test_a_robot_that_stands_still_maps_what_it_sees(drive):
    _, scans = drive
    time_ns = np.array([scans[0].time_ns - 10**9, scans[0].time_ns + 10**9])
    still = Trajectory(time_ns, np.zeros((2, 3)), np.ones(2, dtype=bool))
    built = build_map(lambda: scans[:1], still, MappingConfig())
    assert len(built.trajectory) == 1
    assert built.facts.key_scans == 1
    assert built.room.occupied.sum() > 50


def test_progress_never_goes_back_and_losses_are_told(drive):
    truth, scans = drive
    told, losses = [], LossLedger()
    late = Trajectory(truth.time_ns[200:], truth.pose[200:], truth.usable[200:])
    build_map(lambda: scans[:150], late, MappingConfig(), losses=losses, report=told.append)
    assert told == sorted(told)
    assert 0.99 < told[-1] <= 1.0
    assert [loss.what for loss in losses] == ["laser scan without odometry"]


def test_nothing_to_map_is_an_error(drive):
    truth, _ = drive
    with pytest.raises(NothingUsableError, match="no map can be built"):
        build_map(list, truth, MappingConfig())


def test_between_key_scans_the_correction_is_spread_over_the_way():
    time_ns = np.arange(11, dtype=np.int64) * 10**8
    way = np.column_stack([np.arange(11) * 0.1, np.zeros((11, 2))])
    odometry = Trajectory(time_ns, way, np.ones(11, dtype=bool))
    pose = composed(np.array([5.0, 5.0, np.pi / 2]), np.array([[0.0, 0, 0], [1.1, 0, 0]]))
    matched = np.array([True, False])
    found = carried_trajectory(time_ns, odometry, time_ns[[0, 10]], pose, matched)
    np.testing.assert_allclose(found.pose[:, 1], 5.0 + 0.11 * np.arange(11), atol=1e-5)
    assert found.usable[:10].all()


def test_where_the_wheels_slipped_between_key_scans_nothing_is_carried():
    """Half a metre and a third of a turn that only the odometry knows of."""
    time_ns = np.arange(41, dtype=np.int64) * 10**8
    way = np.column_stack([np.arange(41) * 0.1, np.zeros((41, 2))])
    slipped = np.concatenate([way[:25], composed(np.array([0.25, 0.0, 2.0]), way[25:])])
    odometry = Trajectory(time_ns, slipped, np.ones(41, dtype=bool))
    keys = np.array([0, 10, 20, 30, 40])
    found = carried_trajectory(time_ns, odometry, time_ns[keys], way[keys], np.ones(5, bool))
    assert np.flatnonzero(~found.usable).tolist() == list(range(20, 31))


def test_rare_scans_are_joined_by_the_poses_of_the_odometry():
    odometry = Trajectory(
        np.arange(101, dtype=np.int64) * 10**8, np.zeros((101, 3)), np.ones(101, dtype=bool)
    )
    laser_ns = np.array([50, 100, 150, 4000, 4100]) * 10**6
    between = odometry_times_between(laser_ns, odometry, rare_ns=200 * 10**6)
    assert between.min() == 200 * 10**6
    assert between.max() == 3900 * 10**6
    assert len(between) == 38
    ends = laser_ns[[0, -1]]
    found = carried_trajectory(laser_ns, odometry, ends, np.zeros((2, 3)), np.ones(2, bool))
    assert len(found) == 5 + 38
    assert found.of_scans().time_ns.tolist() == laser_ns.tolist()


@pytest.mark.parametrize(("beams", "noise_m"), [(181, 0.01), (667, 0.03), (667, 0.05)])
def test_a_corridor_is_as_long_as_odometry_says_and_its_middle_is_flagged(beams, noise_m):
    """Scanners that reach 4 m see nothing but two walls over most of 30 m.

    With many beams and much noise the returns on the walls lie nearer together than they scatter.
    """
    turn = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    ring = np.array([[0, 0], [30, 0], [30, 2], [0, 2]]) @ turn.T
    truth = worlds.driven([tuple(turn @ [1.0, 1.0]), tuple(turn @ [29.0, 1.0])], speed=1.0)
    mounts = [worlds.FRONT, worlds.BACK]
    scans = worlds.laser_scans(truth, mounts, rate_hz=8, beams=beams, rings=(ring,))
    scans = [
        replace(scan, range_m=np.where(scan.range_m < 4.0, scan.range_m, np.nan))
        for scan in drives.noisy(scans, noise_m)
    ]
    odometry = drives.reported(truth, scale=1.02, turn_per_metre=0.005)
    losses = LossLedger()
    built = build_map(lambda: scans, odometry, MappingConfig(), losses=losses)
    track = built.trajectory
    true = drives.from_first(truth, track.time_ns)
    assert drives.errors(track.pose, true)[0].max() < 0.03 * 28.0 + 0.1
    way = np.hypot(true[:, 0], true[:, 1])
    middle = (way > 12.0) & (way < 16.0)
    assert not track.usable[middle].any()
    assert track.usable[way < 4.0].all()
    assert any("do not tell the way" in loss.what for loss in losses)


def test_scans_are_held_by_walls_that_run_two_ways_and_for_some_way_by_odometry():
    pose = np.zeros((40, 3))
    driven_m = np.arange(40.0)
    corridor, corner = np.diag([1.0, 1e4, 1e4]), np.diag([1e4, 1e4, 1e4])
    index = np.arange(1, 40)
    pairs = np.stack([index, index - 1], axis=-1)
    information = np.where((index < 10)[:, None, None], corner, corridor)
    links = Links(pairs, np.zeros((39, 3)), information)
    held = held_in_place(pose, links, driven_m, most_drift_m=0.2)
    assert held[:16].all()
    assert not held[17:].any()


def test_what_odometry_alone_ties_to_the_map_over_metres_is_flagged_until_a_surface_ties_it():
    driven_m = np.concatenate([0.2 * np.arange(20), 3.8 + 8.0 + 0.2 * np.arange(10)])
    index = np.delete(np.arange(1, 30), 19)
    pairs = np.stack([index, index - 1], axis=-1)
    links = Links(pairs, np.zeros((28, 3)), np.tile(1e4 * np.eye(3), (28, 1, 1)))
    assert np.array_equal(tied_together(links, driven_m), np.arange(30) < 20)
    pairs = np.concatenate([pairs, [[25, 3]]])
    seen_again = Links(pairs, np.zeros((29, 3)), np.tile(1e4 * np.eye(3), (29, 1, 1)))
    assert tied_together(seen_again, driven_m).all()


def test_poses_that_odometry_carries_on_for_metres_behind_the_last_scan_are_flagged():
    time_ns = np.arange(100, dtype=np.int64) * 100_000_000
    pose = np.column_stack([0.1 * np.arange(100), np.zeros(100), np.zeros(100)])
    odometry = Trajectory(time_ns, pose, np.ones(100, dtype=bool))
    key = np.arange(0, 41, 2)
    fits = np.ones(len(key), dtype=bool)
    carried = carried_trajectory(time_ns, odometry, time_ns[key], pose[key], fits)
    assert np.array_equal(carried.usable, pose[:, 0] < 4.0 + 3.0 + 0.05)
