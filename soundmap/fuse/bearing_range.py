"""How far the first surface is on each bearing of the array, from the laser points. Sect. 2.4."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from soundmap.geometry import FloatArray, Mount, Trajectory, relative, wrapped_angle
from soundmap.memory import sparse_zeros
from soundmap.side_by_side import side_by_side
from soundmap.surroundings import Surroundings

AGE_NS = 200_000_000
"""Surroundings farther away in time than this are no longer the same."""
CHUNK = 256
"""Times that are worked out at once; bounds the memory of long runs."""
AROUND = 360
"""Directions in which :func:`ranges_around` tells ranges."""
ROWS = 16 * CHUNK
"""Times of which it holds the ranges twice."""


def surface_ranges(
    surroundings: Surroundings,
    trajectory: Trajectory,
    time_ns: NDArray[np.int64],
    mount: Mount,
    bearing_rad: FloatArray,
    *,
    tolerance_rad: float,
) -> NDArray[np.float32]:
    r"""Ranges :math:`\rho_n(k)` on bearings of the array at many times.

    The points nearest in time are taken along with the robot's motion to each time. The compiled
    form of :func:`ranges_on_bearings`.

    Parameters
    ----------
    surroundings : Surroundings
    trajectory : Trajectory
        Base in whatever frame.
    time_ns : ndarray of int64, shape (S,)
    mount : Mount
        Microphone array in the base frame.
    bearing_rad : ndarray, shape (S, N) or (N,)
        Bearings in the array's own frame [rad]. The n-th lies within half a spacing of
        :math:`2 \pi n / N`, or is NaN.
    tolerance_rad : float
        A point farther off a bearing than this does not count [rad]; at most half a spacing.

    Returns
    -------
    ndarray of float32, shape (S, N)
        [m]; NaN where no point is near enough, or nothing is known of that time.
    """
    ranges = np.full((len(time_ns), bearing_rad.shape[-1]), np.nan, dtype=np.float32)
    bearing = np.broadcast_to(np.asarray(bearing_rad, dtype=np.float64), ranges.shape)
    centre, axes = mount.translation_m[:2].copy(), mount.rotation[:2, :2].copy()
    place = surroundings.nearest(time_ns, within_ns=AGE_NS)

    def fill(start: int) -> None:
        row = start + np.flatnonzero(place[start : start + CHUNK] >= 0)
        then = trajectory.at(surroundings.time_ns[place[row]])
        motion = relative(trajectory.at(time_ns[row]), then)
        fixed = np.isfinite(motion).all(axis=-1)
        row, motion = row[fixed], motion[fixed]
        points = surroundings.points(place[row]).astype(np.float32)
        _surface_ranges(points, motion, centre, axes, bearing, tolerance_rad, row, ranges)

    side_by_side(fill, range(0, len(time_ns), CHUNK))
    return ranges


def ranges_around(
    surroundings: Surroundings,
    trajectory: Trajectory,
    time_ns: NDArray[np.int64],
    mount: Mount,
    wanted: NDArray[np.int64] | None = None,
) -> NDArray[np.float32]:
    """Ranges to the first surface all around the array at many times, shape (S, M) [m].

    On its own bearings 2 pi m / M; NaN where unknown. If only some times are wanted, the others
    have 0 and take no memory.
    """
    some = np.arange(len(time_ns)) if wanted is None else wanted
    directions = 2.0 * np.pi * np.arange(AROUND) / AROUND
    ranges = sparse_zeros(len(time_ns), AROUND)
    for start in range(0, len(some), ROWS):
        rows = some[start : start + ROWS]
        ranges[rows] = surface_ranges(
            surroundings, trajectory, time_ns[rows], mount, directions, tolerance_rad=np.pi / AROUND
        )
    return ranges


def ranges_on_bearings(
    points_m: ArrayLike, bearing_rad: ArrayLike, *, tolerance_rad: float
) -> FloatArray:
    r"""Range :math:`\rho_n` on each bearing: that of the laser point nearest in angle.

    Parameters
    ----------
    points_m : array_like, shape (P, 2)
        Laser points of all scanners relative to the array's centre [m].
    bearing_rad : array_like, shape (N,)
        Bearings in the same axes as the points [rad].
    tolerance_rad : float
        A point farther off the bearing than this does not count [rad].

    Returns
    -------
    ndarray, shape (N,)
        [m]; NaN where no point is near enough.

    Examples
    --------
    >>> points = [[2.0, 0.0], [0.0, 3.0]]
    >>> ranges_on_bearings(points, [0.01, np.pi / 2, np.pi], tolerance_rad=0.03)
    array([ 2.,  3., nan])
    """
    points = np.asarray(points_m, dtype=np.float64).reshape(-1, 2)
    wanted = wrapped_angle(bearing_rad)
    if len(points) == 0:
        return np.full(wanted.shape, np.nan)
    angle = np.arctan2(points[:, 1], points[:, 0])
    order = np.argsort(angle, kind="stable")
    sorted_angle = angle[order]
    right = np.searchsorted(sorted_angle, wanted) % len(points)
    left = right - 1  # index -1 is the last point: the circle closes
    off_right = np.abs(wrapped_angle(sorted_angle[right] - wanted))
    off_left = np.abs(wrapped_angle(sorted_angle[left] - wanted))
    nearest = np.where(off_left < off_right, order[left], order[right])
    distance = np.hypot(points[nearest, 0], points[nearest, 1])
    return np.where(np.minimum(off_left, off_right) <= tolerance_rad, distance, np.nan)


@njit(cache=True, nogil=True)
def _surface_ranges(  # type: ignore[no-untyped-def]
    point_m, motion, centre, axes, bearing, tolerance, row, ranges
):
    """Fills the given rows (K,) of the ranges (S, N) from points (K, M, 2)."""
    bearings = bearing.shape[1]
    least = np.empty(bearings)
    turned = axes[0, 0] * axes[1, 1] - axes[0, 1] * axes[1, 0]
    for k in range(len(row)):
        least[:] = np.inf
        cos, sin = np.cos(motion[k, 2]), np.sin(motion[k, 2])
        for p in range(point_m.shape[1]):
            x, y = point_m[k, p, 0], point_m[k, p, 1]
            if np.isnan(x):
                continue
            dx = motion[k, 0] + cos * x - sin * y - centre[0]
            dy = motion[k, 1] + sin * x + cos * y - centre[1]
            own_x = (axes[1, 1] * dx - axes[0, 1] * dy) / turned
            own_y = (axes[0, 0] * dy - axes[1, 0] * dx) / turned
            angle = np.arctan2(own_y, own_x)
            cell = int(np.rint(angle * bearings / (2.0 * np.pi)))
            for near in range(cell - 1, cell + 2):
                n = near % bearings
                away = abs(angle - bearing[row[k], n])
                away = min(away, abs(away - 2.0 * np.pi))
                if away <= tolerance and away < least[n]:
                    least[n] = away
                    ranges[row[k], n] = np.hypot(dx, dy)
