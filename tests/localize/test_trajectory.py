from dataclasses import replace

import numpy as np
import pytest
import worlds

from soundmap.config import LocalizeConfig
from soundmap.errors import MapError, NothingUsableError
from soundmap.geometry import Trajectory, composed, relative, wrapped_angle
from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.localize.placement import Placement, _unbroken
from soundmap.localize.smoothing import chained
from soundmap.localize.trajectory import estimate_trajectory
from soundmap.localize.views import chosen_views
from soundmap.losses import LossLedger

LOOP = [(1.0, 1.0), (5.5, 1.2), (4.0, 2.2), (1.2, 4.2), (1.0, 1.5)]
TRUTH = worlds.driven(LOOP)
SCANS = worlds.laser_scans(TRUTH, [worlds.FRONT, worlds.BACK])
ROOM = worlds.room()
CONFIG = LocalizeConfig(particles=300)


def odometry_of(truth, *, scale=1.0, turn_scale=1.0, drift_rad_per_m=0.0):
    """What wheels with systematic errors would say; starts at the origin."""
    step = relative(truth.pose[:-1], truth.pose[1:])
    length = np.hypot(step[:, 0], step[:, 1])
    step = step * [scale, scale, turn_scale]
    step[:, 2] += drift_rad_per_m * length
    pose = [np.zeros(3)]
    for part in step:
        pose.append(composed(pose[-1], part))
    return Trajectory(truth.time_ns, np.array(pose), truth.usable)


def errors(estimate, truth=TRUTH):
    off = estimate.pose - truth.at(estimate.time_ns)
    return np.hypot(off[:, 0], off[:, 1]), np.abs(wrapped_angle(off[:, 2]))


START = tuple(TRUTH.pose[0])


def test_with_perfect_sensors_the_filter_follows_the_truth_within_a_cell():
    estimate = estimate_trajectory(SCANS, odometry_of(TRUTH), ROOM, CONFIG, start_pose=START)
    position, heading = errors(estimate)
    assert estimate.usable.all()
    assert position.max() < 0.05
    assert np.degrees(heading).mean() < 0.3
    assert estimate.time_ns[0] <= SCANS[0].middle_ns
    assert estimate.time_ns[-1] == max(scan.middle_ns for scan in SCANS)


def test_without_a_start_pose_the_robot_is_found_in_the_map():
    estimate = estimate_trajectory(SCANS, odometry_of(TRUTH), ROOM, CONFIG)
    position, _ = errors(estimate)
    assert estimate.usable.mean() > 0.95
    assert position[estimate.usable].max() < 0.06


def test_a_wrong_start_pose_is_recovered_from():
    losses = LossLedger()
    wrong = (4.0, 0.6, 2.0)
    estimate = estimate_trajectory(
        SCANS, odometry_of(TRUTH), ROOM, CONFIG, start_pose=wrong, losses=losses
    )
    position, _ = errors(estimate)
    assert position[estimate.usable].max() < 0.06
    assert estimate.usable[len(estimate) // 3 :].all()
    assert any("stopped matching" in loss.what for loss in losses)


def test_systematic_odometry_errors_do_not_lose_the_robot():
    odometry = odometry_of(TRUTH, scale=1.05, turn_scale=0.96, drift_rad_per_m=np.radians(3.0))
    estimate = estimate_trajectory(SCANS, odometry, ROOM, CONFIG)
    position, heading = errors(estimate)
    assert estimate.usable.mean() > 0.95
    assert np.quantile(position[estimate.usable], 0.95) < 0.06
    assert np.degrees(heading[estimate.usable]).mean() < 0.6


def test_one_scanner_is_enough():
    front = [scan for scan in SCANS if scan.scanner == 0]
    position, _ = errors(estimate_trajectory(front, odometry_of(TRUTH), ROOM, CONFIG))
    assert np.quantile(position, 0.95) < 0.06


def test_a_run_that_begins_with_heading_180_degrees_does_not_flip():
    truth = worlds.driven([(5.5, 1.2), (1.0, 1.2), (1.0, 1.6)])
    scans = worlds.laser_scans(truth, [worlds.FRONT])
    estimate = estimate_trajectory(
        scans, odometry_of(truth), ROOM, CONFIG, start_pose=tuple(truth.pose[0])
    )
    position, heading = errors(estimate, truth)
    assert position.max() < 0.06
    assert np.degrees(heading.max()) < 2.0


def test_obstacles_that_the_map_lacks_do_not_pull_the_pose():
    rng = np.random.default_rng(0)
    blocked = []
    for scan in SCANS:
        ranges = scan.range_m.copy()
        first = rng.integers(0, len(ranges))
        hidden = (np.arange(len(ranges)) + first) % len(ranges) < 0.3 * len(ranges)
        ranges[hidden] = np.minimum(ranges[hidden], rng.uniform(0.4, 0.8))
        blocked.append(replace(scan, range_m=ranges))
    estimate = estimate_trajectory(blocked, odometry_of(TRUTH), ROOM, CONFIG)
    position, _ = errors(estimate)
    assert estimate.usable.mean() > 0.9
    assert np.quantile(position[estimate.usable], 0.95) < 0.08


def test_people_who_stand_in_front_for_a_moment_do_not_lose_the_robot():
    covered, ready = [], SCANS[0].time_ns + 4_000_000_000
    for scan in SCANS:
        if 0 <= scan.time_ns - ready < 400_000_000:
            scan = replace(scan, range_m=np.minimum(scan.range_m, 0.4))
        covered.append(scan)
    estimate = estimate_trajectory(covered, odometry_of(TRUTH), ROOM, CONFIG)
    moment = (estimate.time_ns >= ready) & (estimate.time_ns < ready + 400_000_000)
    assert moment.any()
    assert estimate.usable.all()
    assert errors(estimate)[0][moment].max() < 0.05


def test_the_same_input_gives_the_same_trajectory():
    short = SCANS[:120]
    first, second = (estimate_trajectory(short, odometry_of(TRUTH), ROOM, CONFIG) for _ in range(2))
    assert np.array_equal(first.pose, second.pose)
    assert np.array_equal(first.time_ns, second.time_ns)


class TestFaults:
    def test_odometry_that_stands_still_while_the_view_changes(self):
        stuck = Trajectory(TRUTH.time_ns, np.zeros_like(TRUTH.pose), TRUTH.usable)
        with pytest.raises(NothingUsableError, match="odometry never moves"):
            estimate_trajectory(SCANS, stuck, ROOM, CONFIG)

    def test_a_robot_that_really_stands_still_is_localized(self):
        still = SCANS[:8]
        stuck = Trajectory(TRUTH.time_ns, np.zeros_like(TRUTH.pose), TRUTH.usable)
        estimate = estimate_trajectory(still, stuck, ROOM, CONFIG, start_pose=START)
        assert errors(estimate)[0].max() < 0.08

    def test_a_log_of_a_robot_at_rest_is_localized_without_a_start_pose(self):
        rest = worlds.driven([(1.0, 1.0), (1.0, 1.0), (1.0, 1.0)])
        rest = Trajectory(rest.time_ns, np.repeat(rest.pose[:1], len(rest), axis=0), rest.usable)
        scans = worlds.laser_scans(rest, [worlds.FRONT, worlds.BACK])
        estimate = estimate_trajectory(scans, odometry_of(rest), ROOM, CONFIG)
        assert estimate.usable.mean() > 0.9
        assert errors(estimate, rest)[0][estimate.usable].max() < 0.08

    def test_scans_without_returns(self):
        empty = [replace(scan, range_m=np.full_like(scan.range_m, np.nan)) for scan in SCANS]
        losses = LossLedger()
        with pytest.raises(NothingUsableError, match="no laser scan has enough returns"):
            estimate_trajectory(empty, odometry_of(TRUTH), ROOM, CONFIG, losses=losses)
        assert next(iter(losses)).count == len(SCANS)

    def test_no_scans_at_all(self):
        with pytest.raises(NothingUsableError, match="no laser scan"):
            estimate_trajectory([], odometry_of(TRUTH), ROOM, CONFIG)

    def test_the_map_of_another_site(self):
        rng = np.random.default_rng(1)
        other = OccupancyGrid(
            GridFrame(0.05, (0.0, 0.0), (200, 200)),
            rng.random((200, 200)) < 0.002,
            np.ones((200, 200), dtype=bool),
        )
        with pytest.raises(MapError, match="do not match the map"):
            estimate_trajectory(SCANS[:200], odometry_of(TRUTH), other, CONFIG)

    def test_a_map_that_covers_only_part_of_the_run_flags_the_rest(self):
        occupied = ROOM.occupied.copy()
        occupied[:, ROOM.frame.cells([3.0, 0.0])[1] :] = False
        half = OccupancyGrid(ROOM.frame, occupied, ROOM.free)
        losses = LossLedger()
        estimate = estimate_trajectory(
            SCANS, odometry_of(TRUTH), half, CONFIG, start_pose=START, losses=losses
        )
        position, _ = errors(estimate)
        assert 0.1 < estimate.usable.mean() < 0.95
        assert np.quantile(position[estimate.usable], 0.95) < 0.25
        assert any(loss.what == "robot not localized" for loss in losses)

    def test_odometry_that_ends_early_ends_the_trajectory(self):
        half = len(TRUTH) // 2
        odometry = odometry_of(TRUTH)
        cut = Trajectory(odometry.time_ns[:half], odometry.pose[:half], odometry.usable[:half])
        losses = LossLedger()
        estimate = estimate_trajectory(SCANS, cut, ROOM, CONFIG, start_pose=START, losses=losses)
        assert estimate.time_ns[-1] <= cut.time_ns[-1]
        assert next(iter(losses)).what == "laser scan without odometry"


def test_odometry_that_sticks_in_mid_run_does_not_lose_the_robot():
    """For three seconds the wheels report nothing, in a straight and in a turn."""
    for start_s in (4.0, 14.0):
        time_s = (TRUTH.time_ns - TRUTH.time_ns[0]) * 1e-9
        pose = odometry_of(TRUTH).pose
        step = relative(pose[:-1], pose[1:])
        step[(time_s[1:] > start_s) & (time_s[1:] < start_s + 3.0)] = 0.0
        stuck = [np.zeros(3)]
        for part in step:
            stuck.append(composed(stuck[-1], part))
        odometry = Trajectory(TRUTH.time_ns, np.array(stuck), TRUTH.usable)
        estimate = estimate_trajectory(SCANS, odometry, ROOM, CONFIG)
        position, _ = errors(estimate)
        assert estimate.usable.mean() > 0.95
        assert np.quantile(position[estimate.usable], 0.95) < 0.06
        assert position[estimate.usable].max() < 0.15


@pytest.mark.parametrize("seen_end", [True, False])
def test_in_a_featureless_corridor_no_pose_is_usable_that_is_not_known(seen_end):
    """Scanners that reach 4 m in a slanted corridor of 24 m; odometry reports 4 % too much."""
    turn = 0.3
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    ring = np.array([[0, 0], [24, 0], [24, 2], [0, 2]]) @ rotation.T
    way = np.array([[1.0, 1.0], [23.0 if seen_end else 16.0, 1.0]]) @ rotation.T
    truth = worlds.driven([tuple(point) for point in way])
    scans = [
        replace(scan, range_m=np.where(scan.range_m < 4.0, scan.range_m, np.nan))
        for scan in worlds.laser_scans(
            truth, [worlds.FRONT, worlds.BACK], rate_hz=10.0, beams=181, rings=(ring,)
        )
    ]
    frame = GridFrame(0.05, (-1.5, -0.5), (220, 520))
    room, odometry = worlds.room((ring,), frame), odometry_of(truth, scale=1.04)
    start = tuple(truth.pose[0])
    estimate = estimate_trajectory(scans, odometry, room, CONFIG, start_pose=start)
    off, _ = errors(estimate, truth)
    sigma = np.sqrt(np.trace(estimate.covariance[:, :2, :2], axis1=1, axis2=2))
    assert off[estimate.usable].max() < 0.3
    assert np.mean(off > 3.0 * sigma + 0.02) < 0.05
    if not seen_end:
        assert not estimate.usable[-1]
        assert sigma[-1] > 0.3


def test_walls_of_one_direction_and_noise_make_no_pose_known():
    """A scanner of 8 m with 3 cm of noise in 40 m of bare corridor; its end shows in the last scan.

    Lines through few returns point anywhere, and a return or two lie on the corner of the map by
    chance: they used to make poses usable that were 0.6 m off.
    """
    ring = np.array([[0, 0], [40, 0], [40, 2], [0, 2]]) + worlds.HALF
    truth = worlds.driven([(8.0, 1.0), (32.0, 1.0)])
    rng = np.random.default_rng(3)
    scans = []
    for scan in worlds.laser_scans(truth, [worlds.FRONT], rate_hz=10.0, beams=271, rings=(ring,)):
        ranges = scan.range_m + rng.normal(0.0, 0.03, len(scan.range_m))
        scans.append(replace(scan, range_m=np.where(ranges < 8.0, ranges, np.nan)))
    room = worlds.room((ring,), GridFrame(0.05, (-1.0, -1.0), (80, 840)))
    odometry = odometry_of(truth, scale=1.03, drift_rad_per_m=0.01)
    with pytest.raises(
        MapError, match=r"nothing in their reach tells where along its walls.*known"
    ):
        estimate_trajectory(scans, odometry, room, CONFIG, start_pose=tuple(truth.pose[0]))


class TestPlacesThatLookAlike:
    """A rectangular room without a mark is the same after half a turn."""

    outline = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0]]) + worlds.HALF
    truth = worlds.driven([(1.0, 1.0), (5.0, 1.0), (5.0, 3.0), (2.0, 3.0)])

    def scans(self, outline):
        mounts = [worlds.FRONT, worlds.BACK]
        return worlds.laser_scans(self.truth, mounts, rate_hz=10.0, rings=(outline,))

    @pytest.mark.parametrize("smoothing", [True, False])
    def test_the_program_says_that_it_cannot_tell(self, smoothing):
        config = CONFIG.model_copy(update={"smoothing": smoothing})
        odometry, room = odometry_of(self.truth), worlds.room((self.outline,))
        with pytest.raises(MapError, match=r"looks alike in several places.*--start-pose"):
            estimate_trajectory(self.scans(self.outline), odometry, room, config)

    def test_a_start_pose_tells(self):
        start = tuple(self.truth.pose[0] + [0.1, -0.1, 0.05])
        odometry, room = odometry_of(self.truth), worlds.room((self.outline,))
        estimate = estimate_trajectory(
            self.scans(self.outline), odometry, room, CONFIG, start_pose=start
        )
        assert errors(estimate, self.truth)[0].max() < 0.06

    def test_a_mark_tells(self):
        niche = np.array([[0.0, 3.0], [-0.6, 3.0], [-0.6, 2.2], [0.0, 2.2]]) + worlds.HALF
        outline = np.concatenate([self.outline, niche])
        odometry, room = odometry_of(self.truth), worlds.room((outline,))
        estimate = estimate_trajectory(self.scans(outline), odometry, room, CONFIG)
        assert estimate.usable.mean() > 0.95
        assert errors(estimate, self.truth)[0][estimate.usable].max() < 0.08


class TestAHallOfWhichTheScannerSeesOneWall:
    """60 m x 40 m and a scanner of 25 m: hundreds of places along the walls fit the first scans."""

    outline = np.array([[0.0, 0.0], [60.0, 0.0], [60.0, 40.0], [0.0, 40.0]]) + worlds.HALF
    frame = GridFrame(0.05, (-1.0, -1.0), (840, 1240))

    def drive(self, outline, way):
        truth = worlds.driven(way, speed=1.0)
        rings = (np.array(outline),)
        scans = worlds.laser_scans(truth, [worlds.FRONT], rate_hz=5.0, beams=181, rings=rings)
        seen = [
            replace(scan, range_m=np.where(scan.range_m < 25.0, scan.range_m, np.nan))
            for scan in scans
        ]
        odometry = odometry_of(truth, scale=1.005)
        return truth, seen, odometry, worlds.room(rings, self.frame)

    def niched(self):
        niche = np.array([[52.0, 0.0], [52.0, -0.5], [54.0, -0.5], [54.0, 0.0]]) + worlds.HALF
        return np.concatenate([self.outline[:1], niche, self.outline[1:]])

    @pytest.mark.parametrize(
        "way", [[(36.0, 37.0), (22.0, 37.0), (22.0, 34.0)], [(30.0, 3.0), (50.0, 3.0)]]
    )
    def test_no_place_is_told_that_half_a_turn_of_the_hall_makes_another_one(self, way):
        _, scans, odometry, room = self.drive(self.outline, way)
        with pytest.raises(MapError, match=r"looks alike in several places.*--start-pose"):
            estimate_trajectory(scans, odometry, room, CONFIG)

    def test_a_niche_that_comes_into_sight_later_tells(self):
        truth, scans, odometry, room = self.drive(self.niched(), [(26.0, 3.0), (56.0, 3.0)])
        estimate = estimate_trajectory(scans, odometry, room, CONFIG)
        assert estimate.usable.mean() > 0.9
        assert errors(estimate, truth)[0][estimate.usable].max() < 0.15

    def test_a_start_off_along_the_wall_is_mended_from_where_the_place_was_plain(self):
        """Followed ahead alone, a third is off: at first the niche is too small to tell."""
        truth, scans, odometry, room = self.drive(self.niched(), [(26.0, 3.0), (56.0, 3.0)])
        views = chosen_views(scans, odometry, CONFIG, LossLedger())
        placement = Placement(room, views, CONFIG, LossLedger())
        true = truth.at(views.time_ns)
        placement.find(true[0] + [-0.6, 0.0, 0.0])
        off_m = np.hypot(*(placement.pose - true)[:, :2].T)
        assert placement.known.all()
        assert np.mean(off_m > 0.15) < 0.27


def test_smoothing_brings_the_poses_nearer_to_the_truth():
    odometry = odometry_of(TRUTH, scale=1.03, turn_scale=0.98, drift_rad_per_m=np.radians(2.0))
    plain, smoothed = (
        estimate_trajectory(SCANS, odometry, ROOM, CONFIG.model_copy(update={"smoothing": on}))
        for on in (False, True)
    )
    plain_off, smoothed_off = errors(plain), errors(smoothed)
    assert np.median(smoothed_off[0]) < 0.7 * np.median(plain_off[0])
    assert np.median(smoothed_off[0]) < 0.006
    assert np.degrees(smoothed_off[1].mean()) < 0.15
    assert plain.covariance is None
    assert smoothed.covariance.shape == (len(smoothed), 3, 3)


def test_walls_on_the_edges_of_their_cells_do_not_shift_the_poses():
    """All stand a millimetre above the lower edges, but for two faces of the pillar."""
    low = 0.001 - worlds.HALF
    pillar = worlds.PILLAR + low
    pillar = np.where(pillar > pillar.mean(axis=0), pillar - 0.002, pillar)
    rings = (worlds.OUTLINE + low, pillar)
    scans = worlds.laser_scans(TRUTH, [worlds.FRONT, worlds.BACK], rings=rings)
    estimate = estimate_trajectory(
        scans, odometry_of(TRUTH), worlds.room(rings), CONFIG, start_pose=START
    )
    assert np.median(errors(estimate)[0]) < 0.02


def test_scans_far_apart_with_poor_odometry_are_still_aligned():
    """One scan in 0.7 m, and odometry that misses up to ten degrees between them."""
    rng = np.random.default_rng(5)
    sparse = [scan for scan in SCANS if scan.scanner == 0][::28]
    step = relative(TRUTH.pose[:-1], TRUTH.pose[1:])
    step[:, 2] += rng.normal(0, 0.004, len(step)) + 0.05 * np.hypot(step[:, 0], step[:, 1])
    pose = [np.zeros(3)]
    for part in step:
        pose.append(composed(pose[-1], part))
    odometry = Trajectory(TRUTH.time_ns, np.array(pose), TRUTH.usable)
    estimate = estimate_trajectory(sparse, odometry, ROOM, CONFIG, start_pose=START)
    position, heading = errors(estimate)
    assert np.median(position[estimate.usable]) < 0.03
    assert np.degrees(heading[estimate.usable].mean()) < 0.8
    assert len(estimate.of_scans()) == len(sparse)
    assert len(estimate) > 10 * len(sparse), "odometry carries the pose between the scans"
    assert estimate.usable.mean() > 0.9


def niched_corridor():
    """Twenty metres with a niche, for a scanner that sees four: most of it looks alike."""
    niche = [[14.0, 2.0], [14.0, 3.2], [12.5, 3.2], [12.5, 2.0]]
    return np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 2.0], *niche, [0.0, 2.0]]) + 0.025


def test_a_start_taken_for_another_place_of_a_corridor_is_mended_where_the_run_tells():
    rings = (niched_corridor(),)
    frame = GridFrame(0.05, (-1.0, -1.0), (100, 440))
    room = worlds.room(rings, frame)
    truth = worlds.driven([(6.0, 1.0), (17.0, 1.0), (6.5, 1.1)])
    scans = worlds.laser_scans(truth, [worlds.FRONT], rings=rings, rate_hz=10.0)
    seen = [
        replace(scan, range_m=np.where(scan.range_m < 4.0, scan.range_m, np.nan)) for scan in scans
    ]
    views = chosen_views(seen, odometry_of(truth), CONFIG, LossLedger())
    placement = Placement(room, views, CONFIG, LossLedger())
    placement.find(np.array(truth.at(views.time_ns[0])))
    true = placement.pose.copy()
    # As a wrong start leaves it: all the way in, three metres off; on the way back, right.
    half = len(views) // 2
    placement.pose[:half, 0] -= 3.0
    placement.matched[:half] -= 0.1
    placement.mend()
    assert np.abs(placement.pose - true)[:, :2].max() < 0.05


def test_a_robot_that_was_carried_elsewhere_is_left_there():
    views = chosen_views(SCANS, odometry_of(TRUTH), CONFIG, LossLedger())
    placement = Placement(ROOM, views, CONFIG, LossLedger())
    placement.find(np.array(START))
    carried = replace(views, odometry=views.odometry.copy())
    half = len(views) // 2
    carried.odometry[half:] = composed([1.0, 2.0, 1.5], views.odometry[half:])
    moved = Placement(ROOM, carried, CONFIG, LossLedger())
    moved.find(np.array(START))
    off = moved.pose - placement.pose
    assert np.hypot(off[:, 0], off[:, 1])[moved.known].max() < 0.1
    assert moved.known.mean() > 0.9


def test_scans_behind_a_long_way_without_any_do_not_refute_a_place():
    """Odometry has drifted out of reach there: they say nothing for or against it."""
    gone = (TRUTH.pose[:, 1] > 2.0) & (TRUTH.pose[:, 0] < 3.8)
    seen = [scan for scan in SCANS if not np.interp(scan.time_ns, TRUTH.time_ns, gone)]
    views = chosen_views(seen, odometry_of(TRUTH), CONFIG, LossLedger())
    everything = np.arange(len(views))
    gap_m = np.diff(views.driven_m)
    assert np.count_nonzero(gap_m > 3.0) == 1
    before, after = np.split(everything, [int(gap_m.argmax()) + 1])
    for piece in (before, after):
        for view in (piece[0], piece[-1]):
            assert np.array_equal(_unbroken(views, everything, int(view)), piece)
    assert np.array_equal(_unbroken(views, after[2:], int(after[5])), after[2:])


def test_a_wheel_that_slips_half_a_metre_leaves_right_poses_or_flagged_ones():
    odometry = odometry_of(TRUTH)
    step = relative(odometry.pose[:-1], odometry.pose[1:])
    step[300:310] += [0.025, 0.0, 0.15]  # 1.5 rad in 0.2 s
    slipped = Trajectory(TRUTH.time_ns, chained(step), TRUTH.usable)
    estimate = estimate_trajectory(SCANS, slipped, ROOM, CONFIG)
    position, turn = errors(estimate)
    assert 0.9 < estimate.usable.mean() < 1.0
    assert position[estimate.usable].max() < 0.1
    assert np.degrees(turn[estimate.usable].max()) < 1.5
