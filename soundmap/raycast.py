r"""Range from a pose to the first occupied cell: what a laser ray would measure in the map.

Near walls each ray visits the cells that it crosses one by one (Amanatides and Woo, "A fast voxel
traversal algorithm for ray tracing", Eurographics 1987); elsewhere it leaps over cells that the
distance to the nearest wall shows to be empty. The result is that of the walk alone.

A map says only that the surface lies somewhere in the occupied cell, so the range is that to the
middle of the ray's way through it: half a cell of bias towards the robot would be left if the near
boundary were taken.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from soundmap.geometry import FloatArray
from soundmap.grid import OccupancyGrid


def cast_ranges(
    room: OccupancyGrid, origins_m: ArrayLike, bearings_rad: ArrayLike, *, range_max_m: float
) -> FloatArray:
    """Distance along each ray to the middle of its way through the first occupied cell [m].

    Parameters
    ----------
    room : OccupancyGrid
    origins_m : array_like, shape (..., 2)
        Where the rays start, map frame [m].
    bearings_rad : array_like, shape (...)
        Directions in the map frame [rad].
    range_max_m : float
        Rays end here [m].

    Returns
    -------
    ndarray, shape (...)
        ``range_max_m`` where nothing is met, also for rays that leave the map; 0 where the ray
        starts in an occupied cell.
    """
    bearings = np.asarray(bearings_rad, dtype=np.float64)
    origins = np.broadcast_to(np.asarray(origins_m, dtype=np.float64), (*bearings.shape, 2))
    points = np.ascontiguousarray(origins).reshape(-1, 2)
    ranges = _cast_many(
        room.clearance_cells,
        points,
        bearings.ravel(),
        np.array(room.frame.origin_m),
        room.frame.resolution_m,
        range_max_m,
    )
    return ranges.reshape(bearings.shape)


@njit(cache=True, nogil=True)
def walked_range(
    clearance: NDArray[np.float32], x: float, y: float, cos: float, sin: float, limit: float
) -> float:
    """Distance to the first occupied cell, in cells; ``limit`` if there is none nearer.

    ``clearance`` is `OccupancyGrid.clearance_cells`, ``x, y`` the start in cells from the corner of
    cell [0, 0], ``cos, sin`` the direction.
    """
    rows, columns = clearance.shape
    far = 1e30
    per_column = 1.0 / abs(cos) if abs(cos) > 1e-12 else far
    per_row = 1.0 / abs(sin) if abs(sin) > 1e-12 else far
    column, row = int(np.floor(x)), int(np.floor(y))
    distance = 0.0
    next_column = ((column + 1 - x) if cos > 0 else (x - column)) * per_column
    next_row = ((row + 1 - y) if sin > 0 else (y - row)) * per_row
    while distance < limit:
        if 0 <= row < rows and 0 <= column < columns:
            free = clearance[row, column]
            if free == 0.0:
                if distance == 0.0:
                    return 0.0
                return min(0.5 * (distance + min(next_column, next_row)), limit)
            # Both points lie within half a diagonal of their cells' centres.
            leap = free - 1.4143
            if leap > 2.0:
                distance += leap
                at_x, at_y = x + distance * cos, y + distance * sin
                column, row = int(np.floor(at_x)), int(np.floor(at_y))
                next_column = ((column + 1 - x) if cos > 0 else (x - column)) * per_column
                next_row = ((row + 1 - y) if sin > 0 else (y - row)) * per_row
                continue
        elif (
            (column < 0 and cos <= 0)
            or (column >= columns and cos >= 0)
            or (row < 0 and sin <= 0)
            or (row >= rows and sin >= 0)
        ):
            return limit
        if next_column < next_row:
            distance = next_column
            next_column += per_column
            column += 1 if cos > 0 else -1
        else:
            distance = next_row
            next_row += per_row
            row += 1 if sin > 0 else -1
    return limit


@njit(cache=True, nogil=True)
def _cast_many(
    clearance: NDArray[np.float32],
    points: FloatArray,
    bearings: FloatArray,
    origin: FloatArray,
    resolution: float,
    range_max: float,
) -> FloatArray:
    ranges = np.empty(len(bearings))
    for ray in range(len(bearings)):
        x = (points[ray, 0] - origin[0]) / resolution
        y = (points[ray, 1] - origin[1]) / resolution
        cos, sin = np.cos(bearings[ray]), np.sin(bearings[ray])
        walked = walked_range(clearance, x, y, cos, sin, range_max / resolution)
        ranges[ray] = walked * resolution
    return ranges
