"""Where in the map the robot may be, when nobody says: correlative search over all poses.

The end points of the laser rays are laid over the map at every place and heading, and scored by
how near they come to its surfaces (Olson, "Real-time correlative scan matching", ICRA 2009). The
best poses, several where the site looks alike in several places, seed the particle filter.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from soundmap.deskew import Rays
from soundmap.geometry import FloatArray, wrapped_angle
from soundmap.grid import OccupancyGrid
from soundmap.localize.particles import MODE_RADIUS_M, MODE_RADIUS_RAD

COARSE_STEP_M = 0.2
COARSE_HEADINGS = 72
COARSE_SIGMA_M = 0.25
FINE_SIGMA_M = 0.10
CANDIDATES = 1200
MODES = 40
SCORE_MARGIN = 0.25
"""A pose whose score is this much (of 1) below the best is no hypothesis."""
CLEARANCE_M = 0.15
"""The base stands at least this far from every wall."""


def start_hypotheses(room: OccupancyGrid, rays: Rays) -> tuple[FloatArray, FloatArray]:
    """Poses of the base from which the map looks like the scan, best first.

    Parameters
    ----------
    room : OccupancyGrid
    rays : Rays
        Of one or several scanners, in one base frame.

    Returns
    -------
    pose : ndarray, shape (K, 3)
        [m, m, rad], K <= 40; K = 0 if the map has no place for a robot.
    score : ndarray, shape (K,)
        Between 0 and 1.
    """
    distance = room.clearance_cells * np.float32(room.frame.resolution_m)
    places = _places(room, distance)
    if len(places) == 0 or len(rays) == 0:
        return np.empty((0, 3)), np.empty(0)
    points = rays.end_m.astype(np.float32)
    heading = np.linspace(-np.pi, np.pi, COARSE_HEADINGS, endpoint=False)
    place_of = (np.array(room.frame.origin_m), room.frame.resolution_m)
    blurred = nearness_to_wall(distance, COARSE_SIGMA_M)
    coarse = _place_scores(blurred, *place_of, places, heading, points)
    best = np.argsort(coarse, axis=None)[::-1][:CANDIDATES]
    place, turn = np.unravel_index(best, coarse.shape)
    pose = np.column_stack([places[place], heading[turn]])
    sharper = nearness_to_wall(distance, FINE_SIGMA_M)
    for step_m in (0.1, 0.05, 0.025):
        pose, score = _climbed((sharper, *place_of), pose, points, step_m)
    return _separate_modes(pose, score)


def nearness_to_wall(distance: NDArray[np.float32], sigma_m: float) -> NDArray[np.float32]:
    """1 on a wall, falling as a Gaussian of width ``sigma_m`` away from it."""
    return np.exp(-0.5 * (distance / np.float32(sigma_m)) ** 2)


def _places(room: OccupancyGrid, distance: NDArray[np.float32]) -> FloatArray:
    """Positions about `COARSE_STEP_M` apart where a robot has room, shape (P, 2)."""
    stride = max(1, round(COARSE_STEP_M / room.frame.resolution_m))
    open_space = room.free if room.free.any() else ~room.occupied
    for clearance in (CLEARANCE_M, 0.0):
        fits = open_space & (distance > clearance)
        coarse = np.zeros_like(fits)
        coarse[::stride, ::stride] = fits[::stride, ::stride]
        if coarse.any():
            return room.frame.centres(np.argwhere(coarse))
    return np.empty((0, 2))


def _climbed(
    grid: tuple[NDArray[np.float32], FloatArray, float],
    pose: FloatArray,
    points: NDArray[np.float32],
    step_m: float,
) -> tuple[FloatArray, FloatArray]:
    """Each pose moved to the best of its 27 neighbours, and the score there."""
    steps = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 3)
    # At 3 m, a usual range, a turn of step / 3 m moves the end points as far as a step does.
    offset = steps * np.array([step_m, step_m, step_m / 3.0])
    around = (pose[:, None, :] + offset).reshape(-1, 3)
    score = _pose_scores(*grid, around, points).reshape(len(pose), -1)
    best = np.argmax(score, axis=1)
    chosen = around.reshape(len(pose), -1, 3)[np.arange(len(pose)), best]
    chosen[:, 2] = wrapped_angle(chosen[:, 2])
    return chosen, score.max(axis=1)


def _separate_modes(pose: FloatArray, score: FloatArray) -> tuple[FloatArray, FloatArray]:
    order = np.argsort(score)[::-1]
    pose, score = pose[order], score[order]
    kept: list[int] = []
    for index in np.flatnonzero(score >= score[0] - SCORE_MARGIN):
        offset = pose[kept] - pose[index]
        near = np.hypot(offset[:, 0], offset[:, 1]) < 0.5 * MODE_RADIUS_M
        if not np.any(near & (np.abs(wrapped_angle(offset[:, 2])) < 0.5 * MODE_RADIUS_RAD)):
            kept.append(int(index))
        if len(kept) == MODES:
            break
    return pose[kept], score[kept]


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
def _place_scores(
    nearness: NDArray[np.float32],
    origin: FloatArray,
    resolution: float,
    places: FloatArray,
    heading: FloatArray,
    points: NDArray[np.float32],
) -> FloatArray:
    score = np.empty((len(places), len(heading)))
    for place in prange(len(places)):
        pose = np.array([places[place, 0], places[place, 1], 0.0])
        for turn in range(len(heading)):
            pose[2] = heading[turn]
            score[place, turn] = pose_score(nearness, origin, resolution, pose, points)
    return score


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
