"""Where in the map the robot may be, when nobody says: correlative search over all poses.

The end points of the laser rays are laid over the map at every place and heading, and scored by
how near they come to its surfaces (Olson, "Real-time correlative scan matching", ICRA 2009). Boxes
of poses are halved over and over, and dropped once no pose in them can score well enough (branch
and bound, as in Hess et al., "Real-time loop closure in 2D LIDAR SLAM", ICRA 2016), so that what is
left is every place that looks like the scan, not only the first that were met.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from soundmap.deskew import Rays
from soundmap.geometry import FloatArray, wrapped_angle
from soundmap.grid import OccupancyGrid
from soundmap.localize.particles import MODE_RADIUS_M, MODE_RADIUS_RAD

COARSEST_M = 0.8
"""Side of the greatest boxes of positions; their headings turn the ends of the rays as far."""
HALVINGS = 3
FINE_SIGMA_M = 0.10
MOST_RAYS = 180
"""Rays laid over the map; more of a view say the same."""
SCORE_MARGIN = 0.25
"""A pose whose score is this much (of 1) below the best is no hypothesis."""
BEAM = 1000
"""Boxes that are halved at every size, at first, to learn early how good the best pose is."""
MOST_MODES = 1000
"""A scan that fits in more places than this says nothing about the place."""
MOST_BOXES = 200_000
"""Nor does one that may fit in so many boxes."""
AT_ONCE = 1 << 19
"""Boxes weighed at once; bounds memory."""
TABLE_STEPS = 16
TRIED = 30
"""Of them are climbed from as well."""
GOLDEN = 0.6180339887
CLEARANCE_M = 0.15
"""The base stands at least this far from every wall."""


@dataclass(frozen=True)
class Hypotheses:
    """Poses of the base from which the map looks like a scan.

    Attributes
    ----------
    pose : ndarray, shape (K, 3)
        [m, m, rad], best first; none where there are too many.
    score : ndarray, shape (K,)
        Between 0 and 1.
    are_too_many : bool
        The scan fits in so many places that it tells nothing.
    """

    pose: FloatArray
    score: FloatArray
    are_too_many: bool = False


NO_POSE, NO_SCORE = np.empty((0, 3)), np.empty(0)


def start_hypotheses(room: OccupancyGrid, rays: Rays, *, least_score: float) -> Hypotheses:
    """All poses whose scores come within `SCORE_MARGIN` of the best, a step apart.

    None, if the scan fits nowhere.

    Parameters
    ----------
    room : OccupancyGrid
    rays : Rays
        Of one or several scanners, in one base frame.
    least_score : float
        A pose that scores less is no hypothesis, be it the best.
    """
    if len(rays) == 0 or not room.occupied.any():
        return Hypotheses(NO_POSE, NO_SCORE)
    return _Search(room, rays, least_score).hypotheses()


def nearness_to_wall(distance: NDArray[np.float32], sigma_m: float) -> NDArray[np.float32]:
    """1 on a wall, falling as a Gaussian of width ``sigma_m`` away from it."""
    return np.exp(-0.5 * (distance / np.float32(sigma_m)) ** 2)


class _Search:
    """Every pose in a map that a scan may have been taken from."""

    def __init__(self, room: OccupancyGrid, rays: Rays, least_score: float) -> None:
        points = rays.end_m[:: -(-len(rays) // MOST_RAYS)].astype(np.float32)
        # Neighbours say much the same: rays from all around show sooner that a box is no good.
        self._points = points[np.argsort(np.arange(len(points)) * GOLDEN % 1.0)]
        self._range_m = np.hypot(*self._points.T).astype(np.float32)
        self._lever_m = max(1.0, float(self._range_m.mean()))
        self._frame = room.frame
        self._distance = room.clearance_cells * np.float32(room.frame.resolution_m)
        self._place_of = (np.array(room.frame.origin_m), room.frame.resolution_m)
        self._sharp = nearness_to_wall(self._distance, FINE_SIGMA_M)
        self._from_free_m = _distance_from_free(room, self._distance)
        self._least = least_score

    def hypotheses(self) -> Hypotheses:
        half_m = 0.5 * COARSEST_M
        turns = int(np.ceil(np.pi * self._lever_m / (np.sqrt(2.0) * half_m)))
        half_rad = np.pi / turns
        boxes, bound = self._promising(self._coarsest(half_m, turns), half_m, half_rad)
        self._dive(boxes, bound, half_m, half_rad)
        for _ in range(HALVINGS):
            half_m, half_rad = 0.5 * half_m, 0.5 * half_rad
            boxes, bound = self._promising(_halved(boxes, half_m, half_rad), half_m, half_rad)
            if len(boxes) > MOST_BOXES:
                return Hypotheses(NO_POSE, NO_SCORE, are_too_many=True)
        pose, score = self._climbed(self._best_of_bins(boxes), half_m)
        kept = _separate_modes(pose[score >= self._least], score[score >= self._least])
        if len(kept.pose) > MOST_MODES:
            return Hypotheses(NO_POSE, NO_SCORE, are_too_many=True)
        return kept

    def _dive(
        self, boxes: FloatArray, bound: NDArray[np.float32], half_m: float, half_rad: float
    ) -> None:
        """Learn about how good the best pose is, so that most boxes need not be halved."""
        for _ in range(HALVINGS):
            half_m, half_rad = 0.5 * half_m, 0.5 * half_rad
            boxes = boxes[np.argsort(-bound, kind="stable")[:BEAM]]
            boxes, bound = self._promising(_halved(boxes, half_m, half_rad), half_m, half_rad)

    def _coarsest(self, half_m: float, turns: int) -> Iterator[FloatArray]:
        """Middles of the greatest boxes, shapes (N, 3), some headings at a time."""
        left, right, bottom, top = self._frame.extent_m
        x = np.arange(left + half_m, right + half_m, 2.0 * half_m)
        y = np.arange(bottom + half_m, top + half_m, 2.0 * half_m)
        places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        places = places[self._has_room(places, half_m)]
        heading = -np.pi + (np.arange(turns) + 0.5) * (2.0 * np.pi / turns)
        for part in np.array_split(heading, -(-max(1, len(places) * turns) // AT_ONCE)):
            yield np.column_stack([np.tile(places, (len(part), 1)), np.repeat(part, len(places))])

    def _promising(
        self, parts: Iterator[FloatArray], half_m: float, half_rad: float
    ) -> tuple[FloatArray, NDArray[np.float32]]:
        """The boxes that may hold a good pose, and what such a pose can score at most."""
        kept: list[FloatArray] = [np.empty((0, 3))]
        bounds: list[NDArray[np.float32]] = [np.empty(0, dtype=np.float32)]
        slack_m = (np.sqrt(2.0) * half_m + half_rad * self._range_m).astype(np.float32)
        for part in parts:
            boxes = part[self._has_room(part[:, :2], half_m)]
            bound = _bounds(
                self._distance, *self._place_of, boxes, self._points, slack_m, self._least
            )
            good = bound >= self._least
            kept.append(boxes[good])
            bounds.append(bound[good])
        boxes, bound = np.concatenate(kept), np.concatenate(bounds)
        self._climbed(boxes[np.argsort(-bound, kind="stable")[:TRIED]], half_m)
        return boxes, bound

    def _has_room(self, places_m: FloatArray, half_m: float) -> NDArray[np.bool_]:
        """Whether a robot may stand somewhere in squares about the places, shape (N,)."""
        last = np.array(self._frame.shape) - 1
        row, column = np.clip(self._frame.cells(places_m), 0, last).T
        reach_m = np.sqrt(2.0) * (half_m + 0.5 * self._frame.resolution_m)
        return np.asarray(self._from_free_m[row, column] <= reach_m)

    def _climbed(self, pose: FloatArray, step_m: float) -> tuple[FloatArray, FloatArray]:
        """Each pose moved uphill by ever smaller steps, and the scores there."""
        score = np.empty(0)
        while step_m >= 0.01:
            pose, score = self._stepped(pose, step_m)
            step_m *= 0.5
        self._least = max(self._least, float(score.max(initial=0.0)) - SCORE_MARGIN)
        return pose, score

    def _stepped(self, pose: FloatArray, step_m: float) -> tuple[FloatArray, FloatArray]:
        """Each pose moved to the best of its 27 neighbours, and the score there."""
        steps = np.stack(np.meshgrid([0, -1, 1], [0, -1, 1], [0, -1, 1]), axis=-1).reshape(-1, 3)
        offset = steps * np.array([step_m, step_m, step_m / self._lever_m])
        around = (pose[:, None, :] + offset).reshape(-1, 3)
        score = _pose_scores(self._sharp, *self._place_of, around, self._points)
        score = score.reshape(len(pose), len(steps))
        best = np.argmax(score, axis=1)
        chosen = around.reshape(len(pose), len(steps), 3)[np.arange(len(pose)), best]
        chosen[:, 2] = wrapped_angle(chosen[:, 2])
        return chosen, score.max(axis=1)

    def _best_of_bins(self, pose: FloatArray) -> FloatArray:
        """Of the poses that are much the same, the best one."""
        score = _pose_scores(self._sharp, *self._place_of, pose, self._points)
        order = np.argsort(-score, kind="stable")
        size = 0.5 * np.array([MODE_RADIUS_M, MODE_RADIUS_M, MODE_RADIUS_RAD])
        bins = np.floor(pose[order] / size).astype(np.int64)
        _, first = np.unique(bins, axis=0, return_index=True)
        return pose[order[np.sort(first)]]


def _distance_from_free(room: OccupancyGrid, distance: NDArray[np.float32]) -> NDArray[np.float32]:
    """How far each cell is from where a robot has room [m]; infinite if it has none anywhere."""
    from scipy.ndimage import distance_transform_edt

    open_space = room.free if room.free.any() else ~room.occupied
    for clearance in (CLEARANCE_M, 0.0):
        fits = open_space & (distance > clearance)
        if fits.any():
            away = distance_transform_edt(~fits) * room.frame.resolution_m
            return np.asarray(away, dtype=np.float32)
    return np.full(room.frame.shape, np.inf, dtype=np.float32)


def _halved(boxes: FloatArray, half_m: float, half_rad: float) -> Iterator[FloatArray]:
    """Middles of the eight parts of each box, whose half sides are given, some at a time."""
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    offset = signs * np.array([half_m, half_m, half_rad])
    for start in range(0, len(boxes), AT_ONCE // 8):
        yield (boxes[start : start + AT_ONCE // 8, None, :] + offset).reshape(-1, 3)


def _separate_modes(pose: FloatArray, score: FloatArray) -> Hypotheses:
    """Poses that are not much the same, best first; of very many, the first `MOST_MODES` + 1."""
    order = np.argsort(-score, kind="stable")
    pose, score = pose[order], score[order]
    kept: list[int] = []
    for index in range(len(pose)):
        offset = pose[kept] - pose[index]
        near = np.hypot(offset[:, 0], offset[:, 1]) < 0.5 * MODE_RADIUS_M
        if not np.any(near & (np.abs(wrapped_angle(offset[:, 2])) < 0.5 * MODE_RADIUS_RAD)):
            kept.append(index)
        if len(kept) > MOST_MODES:
            break
    return Hypotheses(pose[kept], score[kept])


@njit(cache=True, nogil=True)
def pose_score(
    nearness: NDArray[np.float32],
    origin: FloatArray,
    resolution: float,
    pose: FloatArray,
    points: NDArray[np.float32],
) -> float:
    """Mean nearness to a wall of the points, seen from one pose."""
    rows, columns = nearness.shape
    cos, sin = np.cos(pose[2]) / resolution, np.sin(pose[2]) / resolution
    start_x, start_y = (pose[0] - origin[0]) / resolution, (pose[1] - origin[1]) / resolution
    total = 0.0
    for point in range(len(points)):
        column = start_x + cos * points[point, 0] - sin * points[point, 1]
        row = start_y + sin * points[point, 0] + cos * points[point, 1]
        if 0.0 <= row < rows and 0.0 <= column < columns:
            total += nearness[int(row), int(column)]
    return total / len(points)


@njit(cache=True, nogil=True, parallel=True)
def _bounds(
    distance: NDArray[np.float32],
    origin: FloatArray,
    resolution: float,
    boxes: FloatArray,
    points: NDArray[np.float32],
    slack: NDArray[np.float32],
    least: float,
) -> NDArray[np.float32]:
    """What a pose in each box can score at most; 0 where that is less than ``least``.

    From the middle of a box to its poses no ray's end moves farther than its slack, and the
    distance to the walls changes by no more than that.
    """
    rows, columns = distance.shape
    bound = np.zeros(len(boxes), dtype=np.float32)
    per_metre = np.float32(TABLE_STEPS / FINE_SIGMA_M)
    nearness = np.exp(-0.5 * (np.arange(4 * TABLE_STEPS) / TABLE_STEPS) ** 2).astype(np.float32)
    for box in prange(len(boxes)):
        cos, sin = np.cos(boxes[box, 2]) / resolution, np.sin(boxes[box, 2]) / resolution
        start_x = (boxes[box, 0] - origin[0]) / resolution
        start_y = (boxes[box, 1] - origin[1]) / resolution
        total, enough = 0.0, least * len(points)
        for point in range(len(points)):
            x = start_x + cos * points[point, 0] - sin * points[point, 1]
            y = start_y + sin * points[point, 0] + cos * points[point, 1]
            column, row = min(max(int(x), 0), columns - 1), min(max(int(y), 0), rows - 1)
            outside = resolution * (max(abs(x - column), abs(y - row)) - 1.0)
            off = int(max(distance[row, column] - slack[point], 0.0) * per_metre)
            if off < len(nearness) and outside <= slack[point]:
                total += nearness[off]
            if total + len(points) - 1 - point < enough:
                total = 0.0
                break
        bound[box] = total / len(points)
    return bound


@njit(cache=True, nogil=True, parallel=True)
def _pose_scores(
    nearness: NDArray[np.float32],
    origin: FloatArray,
    resolution: float,
    pose: FloatArray,
    points: NDArray[np.float32],
) -> FloatArray:
    score = np.empty(len(pose))
    for index in prange(len(pose)):
        score[index] = pose_score(nearness, origin, resolution, pose[index], points)
    return score
