from dataclasses import replace

import numpy as np
import pytest

from soundmap.errors import NothingUsableError
from soundmap.geometry import transformed
from soundmap.losses import LossLedger
from soundmap.mapping.key_scans import STRIP_M, chosen_key_scans
from tests import worlds
from tests.mapping import drives


@pytest.fixture(scope="module")
def drive():
    truth = worlds.driven([(1, 1), (5, 1), (5, 2)])
    return truth, worlds.laser_scans(truth, [worlds.FRONT, worlds.BACK], rate_hz=20, beams=541)


def test_a_scan_is_taken_when_its_own_scanner_has_moved_or_turned(drive):
    truth, scans = drive
    found = drives.keys(scans, truth)
    for scanner in (0, 1):
        own = [scan for scan in found.scans if scan.scanner == scanner]
        pose = np.array([scan.odometry for scan in own])
        moved = np.hypot(*np.diff(pose[:, :2], axis=0).T)
        turned = np.abs(np.diff(pose[:, 2]))
        assert np.all((moved >= 0.2) | (turned >= 0.17))
        assert np.all((moved < 0.25) & (turned < 0.25)), "and no later than one scan after that"
    times = [scan.time_ns for scan in found.scans]
    assert times == sorted(times)
    assert len(found.time_ns) == len(scans)


def test_returns_lie_on_the_walls_apart_and_in_order(drive):
    truth, scans = drive
    for key in drives.keys(scans, truth, most_returns=150).scans[::7]:
        assert 50 < len(key) <= 150
        strip = np.floor(key.end_m[:, 1] / STRIP_M)
        assert np.all(np.diff(strip) >= 0)
        assert np.all((np.diff(strip) > 0) | (np.diff(key.end_m[:, 0]) >= 0))
        pose = truth.at(key.time_ns)
        origin, end = transformed(pose, key.origin_m), transformed(pose, key.end_m)
        step = end - origin
        exact = worlds.exact_ranges(origin, np.arctan2(step[:, 1], step[:, 0]))
        off = np.abs(np.hypot(*step.T) - exact)
        assert np.quantile(off, 0.95) < 1e-4
        assert off.max() < 0.02  # returns next to a corner, laid on a line through both walls
        known = np.any(key.normal != 0, axis=1)
        assert known.mean() > 0.6
        np.testing.assert_allclose(np.hypot(*key.normal[known].T), 1.0, atol=1e-5)
        towards = np.sum(key.normal * (key.origin_m - key.end_m), axis=1)[known]
        assert np.all(towards > 0)


def test_the_robots_own_parts_are_removed_and_the_walls_stay(drive):
    truth, scans = drive
    post = slice(100, 118)

    def with_post(scan):
        ranges = scan.range_m.copy()
        ranges[post] = 0.31
        return replace(scan, range_m=ranges)

    clean = drives.keys(scans, truth)
    found = drives.keys([with_post(scan) for scan in scans], truth)
    front = [scan for scan in found.scans if scan.scanner == 0]
    assert found.body_returns > len(front)
    assert clean.body_returns == 0
    for key in found.scans:
        assert np.hypot(*(key.end_m - key.origin_m).T).min() > 0.32


def test_a_wall_beside_a_robot_at_rest_is_not_taken_for_the_robot():
    truth = worlds.driven([(0.5, 0.5), (0.6, 0.5)])
    found = drives.keys(worlds.laser_scans(truth, [worlds.FRONT]), truth, distance_m=0.002)
    assert len(found.scans) > 3
    assert found.body_returns == 0


def test_scans_outside_the_odometry_are_counted(drive):
    truth, scans = drive
    early = replace(scans[0], time_ns=int(truth.time_ns[0]) - 10**9)
    losses = LossLedger()
    options = {"distance_m": 0.2, "angle_rad": 0.2, "most_returns": 300, "spacing_m": 0.05}
    chosen_key_scans([early, *scans[:5]], truth, **options, losses=losses)
    assert [(loss.what, loss.count) for loss in losses] == [("laser scan without odometry", 1)]
    with pytest.raises(NothingUsableError, match="no map can be built"):
        chosen_key_scans([early], truth, **options, losses=losses)


def test_scans_with_hardly_a_return_are_counted(drive):
    truth, scans = drive
    blind = replace(scans[0], range_m=np.full(len(scans[0].range_m), np.nan))
    losses = LossLedger()
    options = {"distance_m": 0.2, "angle_rad": 0.2, "most_returns": 300, "spacing_m": 0.05}
    found = chosen_key_scans([blind, *scans[1:5]], truth, **options, losses=losses)
    assert [loss.what for loss in losses] == ["laser scan with too few returns"]
    assert {scan.scanner for scan in found.scans} == {0, 1}


def test_odometry_that_stands_still_while_the_robot_drives_is_an_error(drive):
    truth, scans = drive
    stuck = replace(truth, pose=np.zeros_like(truth.pose))
    with pytest.raises(NothingUsableError, match="never moves"):
        drives.keys(scans, stuck)


def test_a_robot_at_rest_with_people_about_is_no_error():
    truth = worlds.driven([(1, 1), (1.001, 1)])
    scans = worlds.laser_scans(truth, [worlds.FRONT], rate_hz=20)

    def with_passer_by(scan, number):
        ranges = scan.range_m.copy()
        ranges[20 * number : 20 * number + 60] = 0.7
        return replace(scan, range_m=ranges)

    seen = [with_passer_by(scan, number) for number, scan in enumerate(scans)]
    assert len(drives.keys(seen, truth).scans) == 1
