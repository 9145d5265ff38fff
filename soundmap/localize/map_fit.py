"""How laser points pull a pose onto the surfaces of the map: distance-field scan matching.

Every point is drawn to the nearest surface by the gradient of the distance to it, so no point needs
a partner (likelihood fields refined by Gauss-Newton, as in Kohlbrecher et al., "A flexible and
scalable SLAM system", SSRR 2011). What the map does not show, people and boxes, lies far from its
surfaces and is weighed down by a robust kernel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from soundmap.geometry import FloatArray
from soundmap.grid import OccupancyGrid


@dataclass(frozen=True)
class SurfaceField:
    """Distance to the nearest surface of the map.

    Attributes
    ----------
    distance_m : ndarray of float32, shape (H, W)
        From the centre of each cell to that of the nearest cell that a ray can hit [m].
    origin_m : ndarray, shape (2,)
        Centre of cell [0, 0] in the map frame [m].
    resolution_m : float
    """

    distance_m: NDArray[np.float32]
    origin_m: FloatArray
    resolution_m: float


def surface_field(room: OccupancyGrid) -> SurfaceField:
    """Distances to the surfaces of a map; the inside of a thick wall is no surface."""
    from scipy.ndimage import binary_erosion, distance_transform_edt

    inside = binary_erosion(room.occupied, border_value=1)
    surface = room.occupied & ~inside
    distance = distance_transform_edt(~surface) * room.frame.resolution_m
    centre = room.frame.centres([0, 0])
    return SurfaceField(distance.astype(np.float32), centre, room.frame.resolution_m)


def point_pull(
    field: SurfaceField,
    pose: FloatArray,
    points_m: NDArray[np.floating],
    first: NDArray[np.int64],
    share: FloatArray,
    *,
    sigma_m: float,
    kernel_m: float,
) -> tuple[FloatArray, FloatArray]:
    r"""Normal equations of fitting the points of each pose to the map.

    The cost of pose k is :math:`\sum_i w_i d(T_k p_i)^2 / 2 \sigma^2` with Welsch's weights
    :math:`w_i = e^{-d_i^2 / 2 c^2}`.

    Parameters
    ----------
    field : SurfaceField
    pose : ndarray, shape (K, 3)
        Of the base in the map frame.
    points_m : ndarray, shape (P, 2)
        Ends of the rays of all poses, one pose after another, in the base frame [m].
    first : ndarray of int64, shape (K + 1,)
        Points of pose k are ``points_m[first[k]:first[k + 1]]``.
    share : ndarray, shape (P,)
        Weight of each point.
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
        field.distance_m,
        field.origin_m,
        field.resolution_m,
        np.ascontiguousarray(pose),
        np.ascontiguousarray(points_m, dtype=np.float32),
        first,
        share,
        sigma_m,
        kernel_m,
    )


@njit(cache=True, nogil=True)
def _point_pull(
    distance: NDArray[np.float32],
    origin: FloatArray,
    resolution: float,
    pose: FloatArray,
    points: NDArray[np.float32],
    first: NDArray[np.int64],
    share: FloatArray,
    sigma: float,
    kernel: float,
) -> tuple[FloatArray, FloatArray]:
    information = np.zeros((len(pose), 3, 3))
    pull = np.zeros((len(pose), 3))
    for k in range(len(pose)):
        own = slice(first[k], first[k + 1])
        add_map_pull(
            information[k],
            pull[k],
            distance,
            origin,
            resolution,
            pose[k],
            points[own],
            share[own],
            sigma,
            kernel,
        )
    return information, pull


@njit(cache=True, nogil=True)
def add_map_pull(
    information: FloatArray,
    pull: FloatArray,
    distance: NDArray[np.float32],
    origin: FloatArray,
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
        u = (pose[0] + lever_x - origin[0]) / resolution
        v = (pose[1] + lever_y - origin[1]) / resolution
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
