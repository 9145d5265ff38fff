"""How laser points pull a pose onto the surfaces of the map: distance-field scan matching.

Every point is drawn to the nearest surface by the gradient of the distance to it, so no point needs
a partner (likelihood fields refined by Gauss-Newton, as in Kohlbrecher et al., "A flexible and
scalable SLAM system", SSRR 2011). What the map does not show, people and boxes, lies far from its
surfaces and is weighed down by a robust kernel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from soundmap.geometry import FloatArray
from soundmap.grid import OccupancyGrid

WALL_REACH_M = 0.35
"""Cells this near to a cell of a straight wall make a line with it ..."""
WALL_FLATNESS = 0.08
"""... whose variance across is at most this share of that along."""


@dataclass(frozen=True)
class Surface:
    """The cells of a map that rays can hit, how far every cell is from them, and how they face.

    Attributes
    ----------
    distance_m : ndarray of float32, shape (H, W)
        From the centre of each cell to that of the nearest surface cell [m].
    nearest : ndarray of int32, shape (H, W)
        Index of that surface cell.
    own : ndarray of int32, shape (H, W)
        Index of the cell itself where it is a surface cell, else -1.
    cell : ndarray of int64, shape (C, 2)
        Row and column of each surface cell.
    centre_m : ndarray, shape (C, 2)
        [m, map frame]
    normal : ndarray, shape (C, 2)
        Unit normal of the straight wall that a cell belongs to; zero where there is none. Either
        sign.
    corner_m : ndarray, shape (2,)
        Lower-left corner of cell [0, 0] [m].
    resolution_m : float
    """

    distance_m: NDArray[np.float32]
    nearest: NDArray[np.int32]
    own: NDArray[np.int32]
    cell: NDArray[np.int64]
    centre_m: FloatArray
    normal: FloatArray
    corner_m: FloatArray
    resolution_m: float


def map_surface(room: OccupancyGrid) -> Surface:
    """The surface cells of a map; the inside of a thick wall is no surface."""
    from scipy.ndimage import binary_erosion, distance_transform_edt

    surface = room.occupied & ~binary_erosion(room.occupied, border_value=1)
    own = np.full(room.frame.shape, -1, dtype=np.int32)
    cell = np.argwhere(surface)
    own[surface] = np.arange(len(cell), dtype=np.int32)
    distance, (row, column) = distance_transform_edt(~surface, return_indices=True)
    return Surface(
        (distance * room.frame.resolution_m).astype(np.float32),
        own[row, column],
        own,
        cell,
        room.frame.centres(cell),
        _wall_normals(own, cell, max(1, round(WALL_REACH_M / room.frame.resolution_m))),
        np.array(room.frame.origin_m),
        room.frame.resolution_m,
    )


def point_pull(
    surface: Surface,
    pose: FloatArray,
    points_m: NDArray[np.floating],
    first: NDArray[np.int64],
    share: NDArray[Any],
    *,
    sigma_m: float,
    kernel_m: float,
) -> tuple[FloatArray, FloatArray]:
    r"""Normal equations of fitting the points of each pose to the map.

    The cost of pose k is :math:`\sum_i w_i d(T_k p_i)^2 / 2 \sigma^2` with Welsch's weights
    :math:`w_i = e^{-d_i^2 / 2 c^2}`. The cells of a wall at an angle make steps, which would hold a
    pose along the wall; so, where the map shows a straight wall, :math:`d` counts as changing
    across it alone.

    Parameters
    ----------
    surface : Surface
    pose : ndarray, shape (K, 3)
        Of the base in the map frame.
    points_m : ndarray, shape (P, 2)
        Ends of the rays of all poses, one pose after another, in the base frame [m].
    first : ndarray of int64, shape (K + 1,)
        Points of pose k are ``points_m[first[k]:first[k + 1]]``.
    share : ndarray, shape (P,)
        Weight of each point; what has none does not count.
    sigma_m : float
        :math:`\sigma` [m].
    kernel_m : float
        :math:`c` [m]; points farther off than 3 c do not count at all.

    Returns
    -------
    information : ndarray, shape (K, 3, 3)
        :math:`\sum w J^T J / \sigma^2`.
    pull : ndarray, shape (K, 3)
        :math:`-\sum w J^T d / \sigma^2`: the Gauss-Newton step solves information . step = pull.
    """
    return _point_pull(
        *pull_grids(surface),
        np.ascontiguousarray(pose),
        np.ascontiguousarray(points_m, dtype=np.float32),
        first,
        share,
        sigma_m,
        kernel_m,
    )


PullGrids = tuple[NDArray[np.float32], NDArray[np.int32], FloatArray, FloatArray, float]


def pull_grids(surface: Surface) -> PullGrids:
    """What `add_map_pull` needs of a surface."""
    return (
        surface.distance_m,
        surface.nearest,
        surface.normal,
        surface.corner_m,
        surface.resolution_m,
    )


@njit(cache=True, nogil=True)
def _wall_normals(own: NDArray[np.int32], cell: NDArray[np.int64], reach: int) -> FloatArray:
    """Normals of lines through the surface cells around each, zero where they make no line."""
    rows, columns = own.shape
    normal = np.zeros((len(cell), 2))
    for c in range(len(cell)):
        row, column = cell[c]
        count = 0
        x = y = xx = xy = yy = 0.0
        for r in range(max(row - reach, 0), min(row + reach + 1, rows)):
            for k in range(max(column - reach, 0), min(column + reach + 1, columns)):
                dx, dy = k - column, r - row
                if own[r, k] >= 0 and dx * dx + dy * dy <= reach * reach:
                    count += 1
                    x += dx
                    y += dy
                    xx += dx * dx
                    xy += dx * dy
                    yy += dy * dy
        if count < reach:
            continue
        var_x, var_y = xx / count - (x / count) ** 2, yy / count - (y / count) ** 2
        cov = xy / count - (x / count) * (y / count)
        half_sum, half_gap = 0.5 * (var_x + var_y), np.hypot(0.5 * (var_x - var_y), cov)
        if half_sum - half_gap <= WALL_FLATNESS * (half_sum + half_gap):
            along = 0.5 * np.arctan2(2.0 * cov, var_x - var_y)
            normal[c, 0], normal[c, 1] = -np.sin(along), np.cos(along)
    return normal


@njit(cache=True, nogil=True)
def _point_pull(
    distance: NDArray[np.float32],
    nearest: NDArray[np.int32],
    normal: FloatArray,
    corner: FloatArray,
    resolution: float,
    pose: FloatArray,
    points: NDArray[np.float32],
    first: NDArray[np.int64],
    share: NDArray[Any],
    sigma: float,
    kernel: float,
) -> tuple[FloatArray, FloatArray]:
    information = np.zeros((len(pose), 3, 3))
    pull = np.zeros((len(pose), 3))
    most = 0
    for k in range(len(pose)):
        most = max(most, first[k + 1] - first[k])
    own, weight = np.empty((most, 2), dtype=np.float32), np.empty(most)
    for k in range(len(pose)):
        count = 0
        for i in range(first[k], first[k + 1]):
            if share[i] > 0:
                own[count, 0], own[count, 1] = points[i, 0], points[i, 1]
                weight[count] = share[i]
                count += 1
        add_map_pull(
            information[k],
            pull[k],
            distance,
            nearest,
            normal,
            corner,
            resolution,
            pose[k],
            own[:count],
            weight[:count],
            sigma,
            kernel,
        )
    return information, pull


@njit(cache=True, nogil=True)
def add_map_pull(
    information: FloatArray,
    pull: FloatArray,
    distance: NDArray[np.float32],
    nearest: NDArray[np.int32],
    normal: FloatArray,
    corner: FloatArray,
    resolution: float,
    pose: FloatArray,
    points: NDArray[np.float32],
    share: FloatArray,
    sigma: float,
    kernel: float,
) -> None:
    """Add the normal equations of one pose to ``information`` (3, 3) and ``pull`` (3,)."""
    rows, columns = distance.shape
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    for i in range(len(points)):
        lever_x = cos * points[i, 0] - sin * points[i, 1]
        lever_y = sin * points[i, 0] + cos * points[i, 1]
        u = (pose[0] + lever_x - corner[0]) / resolution - 0.5  # from the centre of cell [0, 0]
        v = (pose[1] + lever_y - corner[1]) / resolution - 0.5
        if not (0.0 <= u < columns - 1 and 0.0 <= v < rows - 1):
            continue
        column, row = int(u), int(v)
        a, b = u - column, v - row
        d00, d01 = distance[row, column], distance[row, column + 1]
        d10, d11 = distance[row + 1, column], distance[row + 1, column + 1]
        off = (1 - b) * ((1 - a) * d00 + a * d01) + b * ((1 - a) * d10 + a * d11)
        if off > 3.0 * kernel:
            continue
        slope_x = ((1 - b) * (d01 - d00) + b * (d11 - d10)) / resolution
        slope_y = ((1 - a) * (d10 - d00) + a * (d11 - d01)) / resolution
        wall = nearest[int(v + 0.5), int(u + 0.5)]
        across = slope_x * normal[wall, 0] + slope_y * normal[wall, 1]
        if normal[wall, 0] != 0.0 or normal[wall, 1] != 0.0:
            slope_x, slope_y = across * normal[wall, 0], across * normal[wall, 1]
        weight = share[i] * np.exp(-0.5 * (off / kernel) ** 2) / (sigma * sigma)
        add_residual(information, pull, off, slope_x, slope_y, lever_x, lever_y, weight)


@njit(cache=True, nogil=True)
def add_residual(
    information: FloatArray,
    pull: FloatArray,
    off: float,
    slope_x: float,
    slope_y: float,
    lever_x: float,
    lever_y: float,
    weight: float,
) -> None:
    """Add one point: its residual, the slope of that, and where it lies from the base."""
    jacobian = (slope_x, slope_y, slope_y * lever_x - slope_x * lever_y)
    for m in range(3):
        pull[m] -= weight * jacobian[m] * off
        for n in range(3):
            information[m, n] += weight * jacobian[m] * jacobian[n]
