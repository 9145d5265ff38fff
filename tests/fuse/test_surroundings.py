import weakref
from dataclasses import replace

import numpy as np
import pytest
import worlds

from soundmap.fuse.surroundings import (
    DIRECTIONS,
    SurroundingsGatherer,
    thinned,
)
from soundmap.geometry import Trajectory, transformed
from soundmap.surroundings import BLOCK, SurroundingsPacker
from tests.fuse.gathered import gathered_surroundings

TRUTH = worlds.driven([(1.0, 1.0), (5.0, 1.0), (5.0, 2.2)])
SCANS = worlds.laser_scans(TRUTH, [worlds.FRONT, worlds.BACK], beams=721)


def all_points(surroundings):
    return surroundings.points(np.arange(len(surroundings)))


def test_points_lie_on_the_walls_where_the_robot_is_at_their_time():
    surroundings = gathered_surroundings(SCANS, TRUTH)
    seconds = (TRUTH.time_ns[-1] - TRUTH.time_ns[0]) * 1e-9
    assert 9 * seconds < len(surroundings) <= 10 * seconds + 2
    assert np.all(np.diff(surroundings.time_ns) > 0)
    off = []
    for time_ns, points in zip(surroundings.time_ns, all_points(surroundings), strict=True):
        seen = points[np.isfinite(points[:, 0])].astype(float)
        assert len(seen) > 0.95 * DIRECTIONS  # two scanners see all around
        pose = TRUTH.at(time_ns)
        distance = np.hypot(*seen.T)
        bearing = np.arctan2(seen[:, 1], seen[:, 0]) + pose[2]
        origin = np.broadcast_to(pose[:2], seen.shape)
        off.append(np.abs(distance - worlds.exact_ranges(origin, bearing)))
    # Corners aside, where a scanner off the base sees what the base does not.
    assert np.quantile(np.concatenate(off), 0.97) < 0.01


def test_the_frame_of_the_odometry_does_not_matter():
    away = np.array([20.0, -7.0, 2.0])
    elsewhere = Trajectory(
        TRUTH.time_ns,
        np.column_stack([transformed(away, TRUTH.pose[:, :2]), TRUTH.pose[:, 2] + away[2]]),
        TRUTH.usable,
    )
    here, there = (gathered_surroundings(SCANS, track) for track in (TRUTH, elsewhere))
    same = np.isclose(all_points(here), all_points(there), rtol=0, atol=0.01, equal_nan=True)
    assert same.mean() > 0.999


def test_scans_are_let_go_of_while_others_come():
    gatherer = SurroundingsGatherer(TRUTH)
    alive = []
    scans = worlds.laser_scans(TRUTH, [worlds.FRONT], beams=91)[::-1]
    while scans:
        scan = scans.pop()
        gatherer.see(scan)
        alive.append(weakref.ref(scan))
        del scan
        assert sum(reference() is not None for reference in alive) <= 0.6 * 20
    assert len(gatherer.gathered()) > 80


def test_a_scanner_that_falls_silent_shows_nothing_soon_after():
    half = len(SCANS) // 2
    scans = [scan for k, scan in enumerate(SCANS) if scan.scanner == 0 or k < half]
    surroundings = gathered_surroundings(scans, TRUTH)
    share = np.isfinite(all_points(surroundings)[:, :, 0]).mean(axis=1)
    middle = surroundings.nearest(SCANS[half].time_ns, within_ns=10**9)
    assert share[: middle - 5].min() > 0.95
    assert share[middle + 5 :].max() < 0.85


def test_without_scans_or_odometry_there_are_no_points():
    assert len(gathered_surroundings([], TRUTH)) == 0
    early = Trajectory(TRUTH.time_ns - 10**12, TRUTH.pose, TRUTH.usable)
    assert np.isnan(all_points(gathered_surroundings(SCANS, early))).all()


def test_of_many_points_the_one_nearest_to_a_direction_is_kept():
    points = np.array([[2.0, 0.01], [3.0, 0.001], [0.0, 1.0], [-1.0, -1e-9], [-4.0, 0.1]])
    kept = thinned(points, 8)
    assert kept[0].tolist() == [3.0, 0.001]
    assert kept[2].tolist() == [0.0, 1.0]
    assert kept[4].tolist() == [-1.0, -1e-9]
    assert np.isnan(kept[[1, 3, 5, 6, 7]]).all()


def packed(time_ns, points):
    packer = SurroundingsPacker(points.shape[1])
    for time, own in zip(time_ns, points, strict=True):
        packer.add(int(time), own)
    return packer.surroundings()


def test_points_come_back_to_the_bit_in_any_order():
    rng = np.random.default_rng(4)
    points = np.cumsum(rng.normal(0.0, 0.02, (700, 30, 2)), axis=0).astype(np.float16)
    points[rng.random((700, 30)) < 0.1] = np.nan
    points[0, 0], points[300, 1] = (np.inf, -0.0), (-6e-8, 65504.0)
    surroundings = packed(np.arange(700), points)
    index = rng.integers(0, 700, 1000)
    assert np.array_equal(surroundings.points(index).view(np.uint16), points[index].view(np.uint16))
    assert surroundings.points(index[:0]).shape == (0, 30, 2)


def test_an_hour_of_what_a_robot_sees_takes_60_megabytes():
    surroundings = gathered_surroundings(SCANS, TRUTH)
    assert len(surroundings.packed) / len(surroundings) < 60e6 / 36_000


def test_the_nearest_surroundings_in_time_are_found():
    surroundings = packed([100, 200, 400], np.zeros((3, 4, 2)))
    wanted = [0, 99, 149, 151, 310, 400, 449, 451]
    assert surroundings.nearest(wanted, within_ns=50).tolist() == [-1, 0, 0, 1, -1, 2, 2, -1]
    assert surroundings.nearest(290, within_ns=100) == 1


def test_surroundings_need_points_at_every_time():
    whole = packed(np.arange(BLOCK), np.zeros((BLOCK, 4, 2)))
    with pytest.raises(ValueError, match="points"):
        replace(whole, time_ns=np.arange(BLOCK + 1))
