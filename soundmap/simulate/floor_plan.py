"""Floor plan: the vertical walls of a room, which may have any outline, pillars and niches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from soundmap.geometry import FloatArray


@dataclass(frozen=True)
class FloorPlan:
    """Walls seen from above.

    What lies inside an odd number of rings is open floor: the first ring bounds the room, a ring
    inside it is a pillar or a block.

    Attributes
    ----------
    start_m, end_m : ndarray, shape (W, 2)
        The two ends of every wall in the map frame [m].
    reflection : ndarray, shape (W,)
        Sound pressure reflection coefficient of each wall [-], 0 to 1.
    ring : ndarray of int, shape (W,)
        Which closed outline each wall belongs to.
    """

    start_m: FloatArray
    end_m: FloatArray
    reflection: FloatArray
    ring: NDArray[np.int64]

    @classmethod
    def from_rings(
        cls, rings: Sequence[ArrayLike], reflections: Sequence[float | Sequence[float]]
    ) -> FloorPlan:
        """A plan from closed outlines, shapes (corners, 2) [m], and their coefficients.

        The coefficient of an outline is one number, or one for each of its walls: wall i runs
        from corner i to the next.
        """
        starts, ends, coefficients, ring = [], [], [], []
        for index, (corners, reflection) in enumerate(zip(rings, reflections, strict=True)):
            corner = np.asarray(corners, dtype=np.float64)
            starts.append(corner)
            ends.append(np.roll(corner, -1, axis=0))
            coefficients.append(np.broadcast_to(np.asarray(reflection, float), len(corner)))
            ring.append(np.full(len(corner), index))
        return cls(
            np.concatenate(starts),
            np.concatenate(ends),
            np.concatenate(coefficients),
            np.concatenate(ring),
        )

    def contains(self, points_m: ArrayLike) -> NDArray[np.bool_]:
        """Whether each point, shape (..., 2) [m], is on open floor."""
        return odd_crossings(points_m, self.start_m, self.end_m)

    @property
    def area_m2(self) -> float:
        """Open floor [m2]."""
        total = 0.0
        for ring in np.unique(self.ring):
            own = self.ring == ring
            a, b = self.start_m[own], self.end_m[own]
            area = abs(0.5 * float(np.sum(a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1])))
            within = odd_crossings(a[0], self.start_m[~own], self.end_m[~own])
            total += -area if within else area
        return total

    @property
    def lengths_m(self) -> FloatArray:
        """Length of every wall [m], shape (W,)."""
        return np.hypot(*(self.end_m - self.start_m).T)

    def crossed(self, start_m: ArrayLike, end_m: ArrayLike) -> NDArray[np.bool_]:
        """Whether the straight way between two points, shapes (..., 2) [m], meets a wall.

        Touching a wall with an end is no crossing.
        """
        return np.any(crossings(start_m, end_m, self.start_m, self.end_m), axis=-1)


def odd_crossings(points_m: ArrayLike, start_m: FloatArray, end_m: FloatArray) -> NDArray[np.bool_]:
    """Whether a ray from each point meets an odd number of segments: the even-odd rule."""
    point = np.asarray(points_m, dtype=np.float64)[..., None, :]
    x, y = point[..., 0], point[..., 1]
    straddles = (start_m[:, 1] > y) != (end_m[:, 1] > y)
    rise = end_m[:, 1] - start_m[:, 1]
    share = (y - start_m[:, 1]) / np.where(rise == 0.0, 1.0, rise)
    meets = x < start_m[:, 0] + share * (end_m[:, 0] - start_m[:, 0])
    return np.asarray(np.sum(straddles & meets, axis=-1) % 2 == 1)


def crossings(
    start_m: ArrayLike, end_m: ArrayLike, wall_start_m: FloatArray, wall_end_m: FloatArray
) -> NDArray[np.bool_]:
    """Which walls each straight way crosses; shapes (..., 2), (..., 2), (W, 2) to (..., W).

    The ends of a way lie on walls where sound is reflected, so a wall that is met within a
    billionth of the way's length of either end does not count.
    """
    a = np.asarray(start_m, dtype=np.float64)[..., None, :]
    way = np.asarray(end_m, dtype=np.float64)[..., None, :] - a
    wall = wall_end_m - wall_start_m
    gap = wall_start_m - a
    denominator = way[..., 0] * wall[:, 1] - way[..., 1] * wall[:, 0]
    parallel = denominator == 0.0
    safe = np.where(parallel, 1.0, denominator)
    along = (gap[..., 0] * wall[:, 1] - gap[..., 1] * wall[:, 0]) / safe
    across = (gap[..., 0] * way[..., 1] - gap[..., 1] * way[..., 0]) / safe
    margin = 1e-9
    return np.asarray(
        ~parallel & (along > margin) & (along < 1.0 - margin) & (across >= 0.0) & (across <= 1.0)
    )


def distance_to_walls(points_m: ArrayLike, start_m: FloatArray, end_m: FloatArray) -> FloatArray:
    """Distance of each point, shape (..., 2), to the nearest of the segments (W, 2) [m]."""
    point = np.asarray(points_m, dtype=np.float64)[..., None, :]
    wall = end_m - start_m
    share = np.sum((point - start_m) * wall, axis=-1) / np.sum(wall * wall, axis=-1)
    foot = start_m + np.clip(share, 0.0, 1.0)[..., None] * wall
    return np.asarray(np.min(np.hypot(*np.moveaxis(point - foot, -1, 0)), axis=-1))
