import numpy as np
import worlds

from soundmap.deskew import Rays
from soundmap.geometry import wrapped_angle
from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.localize.global_start import (
    FINE_SIGMA_M,
    SCORE_MARGIN,
    _bounds,
    nearness_to_wall,
    pose_score,
    start_hypotheses,
)

BEARING = np.linspace(-np.pi, np.pi, 90, endpoint=False)


def seen_by(bearing, ranges):
    """Rays from the middle of the robot."""
    ends = np.stack([ranges * np.cos(bearing), ranges * np.sin(bearing)], axis=-1)
    ends = ends[np.isfinite(ranges)]
    return Rays(0, np.zeros_like(ends), ends)


def seen_from(pose, *, reach_m, rings=worlds.RINGS):
    at = np.repeat(np.array(pose[:2])[None], len(BEARING), axis=0)
    ranges = worlds.exact_ranges(at, BEARING + pose[2], rings)
    return seen_by(BEARING, np.where(ranges < reach_m, ranges, np.nan))


def test_hypotheses_of_a_symmetric_room_hold_both_of_its_ends():
    frame = GridFrame(0.05, (0.0, 0.0), (60, 120))
    occupied = np.zeros(frame.shape, dtype=bool)
    occupied[[10, 50], 10:111] = True
    occupied[10:51, [10, 110]] = True
    free = np.zeros(frame.shape, dtype=bool)
    free[11:50, 11:110] = True
    room = OccupancyGrid(frame, occupied, free)
    bearing = np.linspace(-np.pi, np.pi, 180, endpoint=False)
    pose = np.array([2.0, 1.0, 0.4])
    direction = bearing + pose[2]
    with np.errstate(divide="ignore"):
        along_x = np.where(np.cos(direction) > 0, 5.525 - 2.0, 2.0 - 0.525) / abs(np.cos(direction))
        along_y = np.where(np.sin(direction) > 0, 2.525 - 1.0, 1.0 - 0.525) / abs(np.sin(direction))
    ranges = np.minimum(along_x, along_y)
    rays = seen_by(bearing, ranges)
    found = start_hypotheses(room, rays, least_score=0.4)
    mirrored = np.array([6.05 - pose[0], 3.05 - pose[1], pose[2] - np.pi])
    for expected in (pose, mirrored):
        off = found.pose - expected
        near = np.hypot(off[:, 0], off[:, 1]) + np.abs(wrapped_angle(off[:, 2]))
        assert near.min() < 0.1
        assert found.score[near.argmin()] > 0.9 * found.score[0]
    assert not found.are_too_many


def test_no_pose_in_a_box_scores_more_than_the_bound_of_the_box():
    room, rng = worlds.room(), np.random.default_rng(7)
    distance = room.clearance_cells * np.float32(room.frame.resolution_m)
    place_of = (np.array(room.frame.origin_m), room.frame.resolution_m)
    points = seen_from([2.0, 1.0, 0.4], reach_m=30.0).end_m.astype(np.float32)
    sharp = nearness_to_wall(distance, FINE_SIGMA_M)
    boxes = rng.uniform([-1.0, 0.0, -np.pi], [7.0, 5.0, np.pi], (200, 3))
    boxes[0] = [2.1, 0.95, 0.42]
    for half_m, half_rad in ((0.4, 0.2), (0.1, 0.05)):
        slack = np.sqrt(2.0) * half_m + half_rad * np.hypot(*points.T)
        slack += 0.75 * room.frame.resolution_m  # a score is that of the whole cell
        bound = _bounds(distance, *place_of, boxes, points, slack.astype(np.float32), 0.0)
        for box, most in zip(boxes, bound, strict=True):
            inside = box + rng.uniform(-1.0, 1.0, (20, 3)) * [half_m, half_m, half_rad]
            scores = [pose_score(sharp, *place_of, pose, points) for pose in inside]
            assert max(scores) <= most + 1e-6


def test_all_places_are_found_that_score_well_at_any_pose_of_a_fine_grid():
    room = worlds.room()
    distance = room.clearance_cells * np.float32(room.frame.resolution_m)
    sharp = nearness_to_wall(distance, FINE_SIGMA_M)
    place_of = (np.array(room.frame.origin_m), room.frame.resolution_m)
    rays = seen_from([5.0, 1.3, 2.0], reach_m=2.0)  # two walls at most: fits in many places
    points = rays.end_m.astype(np.float32)
    found = start_hypotheses(room, rays, least_score=0.4)
    assert not found.are_too_many
    x, y, turn = np.arange(0.25, 7.0, 0.1), np.arange(0.25, 5.0, 0.1), np.radians(np.arange(90) * 4)
    best = 0.0
    for pose in np.stack(np.meshgrid(x, y, turn), axis=-1).reshape(-1, 3):
        row, column = room.frame.cells(pose[:2])
        if not room.free[row, column] or distance[row, column] < 0.2:
            continue
        score = pose_score(sharp, *place_of, pose, points)
        best = max(best, score)
        if score > found.score[0] - 0.5 * SCORE_MARGIN:
            off = found.pose - pose
            near = np.hypot(off[:, 0], off[:, 1]) < 0.4
            assert np.any(near & (np.abs(wrapped_angle(off[:, 2])) < 0.3)), pose
    assert best <= found.score[0] + 0.02


def test_where_a_single_wall_is_seen_every_place_along_it_is_a_hypothesis():
    outline = np.array([[0.0, 0.0], [60.0, 0.0], [60.0, 40.0], [0.0, 40.0]]) + worlds.HALF
    room = worlds.room((outline,), GridFrame(0.05, (-1.0, -1.0), (840, 1240)))
    found = start_hypotheses(
        room, seen_from([30.0, 3.0, 0.3], reach_m=10.0, rings=(outline,)), least_score=0.4
    )
    assert not found.are_too_many
    for x_m in np.arange(11.0, 50.0, 0.5):
        for pose in ([x_m, 3.0, 0.3], [60.05 - x_m, 37.05, 0.3 + np.pi]):
            off = found.pose - pose
            assert (np.hypot(off[:, 0], off[:, 1]) < 0.3).any(), pose


def test_a_scan_that_fits_nearly_anywhere_tells_that_there_are_more_places():
    outline = np.array([[0.0, 0.0], [60.0, 0.0], [60.0, 40.0], [0.0, 40.0]]) + worlds.HALF
    room = worlds.room((outline,), GridFrame(0.05, (-1.0, -1.0), (840, 1240)))
    bearing = np.array([-0.02, 0.0, 0.02])
    found = start_hypotheses(room, seen_by(bearing, np.full(3, 5.0)), least_score=0.4)
    assert found.are_too_many


def test_a_map_without_walls_has_no_hypotheses():
    frame = GridFrame(0.05, (0.0, 0.0), (40, 40))
    nothing = OccupancyGrid(frame, np.zeros(frame.shape, bool), np.ones(frame.shape, bool))
    rays = seen_from([1.0, 1.0, 0.0], reach_m=30.0)
    assert len(start_hypotheses(nothing, rays, least_score=0.4).pose) == 0
