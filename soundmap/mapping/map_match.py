"""One map of a site laid on another: where two maps with origins of their own are the same place.

Every map that is built from a log has its origin at the robot's first pose, so two runs of a site
have two frames. Their walls tell how the frames lie: first by the correlative search that also
closes loops, then by drawing each wall cell of one to the nearest of the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soundmap.geometry import FloatArray, composed, transformed
from soundmap.grid import OccupancyGrid
from soundmap.mapping.correlation import best_placement, nearness_grid

NEAR_M, NEAR_RAD = 3.0, np.radians(20.0)
"""First the origins are supposed no farther apart than this: robots start where they are parked."""
FAR_M = 30.0
LEAST_SCORE = 0.35
RIVAL_SHARE, RIVAL_M = 0.93, 0.5
"""A match is one if no other pose, farther off than this, comes as near to its score."""
MOST_POINTS = 400
ROUNDS = 30
AGREE_M = 0.15
"""Walls agree that lie within this of each other."""
LEAST_AGREEING = 0.6


@dataclass(frozen=True)
class MapMatch:
    """How a map lies in the frame of another.

    Attributes
    ----------
    pose : ndarray, shape (3,)
        Of the other map's frame in the frame of the first [m], [rad].
    agreeing : float
        Share of the other map's walls that lie on walls of the first.
    """

    pose: FloatArray
    agreeing: float


def matched_maps(room: OccupancyGrid, other: OccupancyGrid) -> MapMatch | None:
    """Where a map lies in the frame of another of the same site.

    Returns
    -------
    MapMatch or None
        None if the walls do not tell, or tell of several places alike.
    """
    walls, others = _walls(room), _walls(other)
    if len(walls) < 10 or len(others) < 10:
        return None
    grid = nearness_grid(walls, walls.mean(axis=0))
    some = others[np.linspace(0, len(others) - 1, min(len(others), MOST_POINTS)).astype(int)]
    reach = float(np.hypot(*walls.T).max())  # the other origin lies somewhere on this map
    for window_m, window_rad in ((NEAR_M, NEAR_RAD), (min(reach, FAR_M), np.pi)):
        found = best_placement(
            grid,
            some,
            np.zeros(3),
            window_m=window_m,
            window_rad=window_rad,
            least_score=LEAST_SCORE,
            rival_beyond_m=RIVAL_M,
        )
        if found is not None:
            if found.rival > RIVAL_SHARE * found.score:
                return None
            pose, agreeing = _refined(walls, others, found.pose)
            if agreeing >= LEAST_AGREEING:
                return MapMatch(pose, agreeing)
    return None


def _walls(room: OccupancyGrid) -> FloatArray:
    """Cells that a ray can hit, shape (P, 2) [m]; the inside of a thick wall is none."""
    from scipy.ndimage import binary_erosion

    surface = room.occupied & ~binary_erosion(room.occupied, border_value=1)
    return room.frame.centres(np.argwhere(surface))


def _refined(
    walls_m: FloatArray, others_m: FloatArray, pose: FloatArray
) -> tuple[FloatArray, float]:
    """The pose at which walls lie on their nearest walls, and the share that does."""
    from scipy.spatial import cKDTree

    tree = cKDTree(walls_m)
    for _ in range(ROUNDS):
        moved = transformed(pose, others_m)
        away, nearest = tree.query(moved, distance_upper_bound=2.0 * AGREE_M)
        met = np.isfinite(away)
        if met.sum() < 3:
            break
        pose = composed(_rigid(moved[met], walls_m[nearest[met]]), pose)
    away, _ = tree.query(transformed(pose, others_m))
    return pose, float(np.mean(away < AGREE_M))


def _rigid(points_m: FloatArray, onto_m: FloatArray) -> FloatArray:
    """The pose that takes points onto others with the least squares of the distances."""
    middle, goal = points_m.mean(axis=0), onto_m.mean(axis=0)
    one, two = points_m - middle, onto_m - goal
    turn = np.arctan2(np.sum(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]), np.sum(one * two))
    cos, sin = np.cos(turn), np.sin(turn)
    shift = goal - np.array([[cos, -sin], [sin, cos]]) @ middle
    return np.array([*shift, turn])
