"""How the returns of laser scans compare with the map, as seen from given poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from soundmap.geometry import FloatArray
from soundmap.grid import OccupancyGrid
from soundmap.localize.views import Views
from soundmap.raycast import walked_range

NEIGHBOUR_CELLS = 1.5
"""The eight cells around a cell lie within this distance."""


@dataclass(frozen=True)
class Agreement:
    """What the map explains of each view, and what contradicts it.

    Attributes
    ----------
    is_matched : ndarray of bool, shape (P,)
        Which returns lie where the map shows a surface.
    matched : ndarray, shape (K,)
        Share of such returns a view.
    beyond : ndarray, shape (K,)
        Share that lies behind a surface of the map: things may stand before a wall that the map
        lacks, but no ray passes through a wall that is there.
    """

    is_matched: NDArray[np.bool_]
    matched: FloatArray
    beyond: FloatArray


def agreement(
    room: OccupancyGrid, pose: FloatArray, views: Views, *, tolerance_m: float
) -> Agreement:
    """Compare every view with the map.

    Parameters
    ----------
    room : OccupancyGrid
    pose : ndarray, shape (K, 3)
        Of the base in the map frame, one a view.
    views : Views
    tolerance_m : float
        Greatest difference between measured and cast range of a match [m].
    """
    is_matched = np.zeros(len(views.end_m), dtype=np.bool_)
    matched, beyond = np.zeros(len(views)), np.zeros(len(views))
    corner = np.array(room.frame.origin_m)
    _agree(
        room.clearance_cells,
        corner,
        room.frame.resolution_m,
        np.ascontiguousarray(pose),
        views.first,
        views.origin_m,
        views.end_m,
        tolerance_m,
        is_matched,
        matched,
        beyond,
    )
    return Agreement(is_matched, matched, beyond)


def view_shares(
    room: OccupancyGrid, pose: FloatArray, views: Views, view: int, *, tolerance_m: float
) -> tuple[float, float]:
    """Shares of one view that match and that lie beyond, from one pose, shape (3,)."""
    own = slice(views.first[view], views.first[view + 1])
    return agreed_shares(
        room.clearance_cells,
        np.array(room.frame.origin_m),
        room.frame.resolution_m,
        pose,
        views.origin_m[own],
        views.end_m[own],
        tolerance_m,
        np.zeros(own.stop - own.start, dtype=np.bool_),
    )


@njit(cache=True, nogil=True)
def _agree(
    clearance: NDArray[np.float32],
    corner: FloatArray,
    resolution: float,
    pose: FloatArray,
    first: NDArray[np.int64],
    origin: NDArray[np.float32],
    end: NDArray[np.float32],
    tolerance: float,
    is_matched: NDArray[np.bool_],
    matched: FloatArray,
    beyond: FloatArray,
) -> None:
    for k in range(len(pose)):
        matched[k], beyond[k] = agreed_shares(
            clearance,
            corner,
            resolution,
            pose[k],
            origin[first[k] : first[k + 1]],
            end[first[k] : first[k + 1]],
            tolerance,
            is_matched[first[k] : first[k + 1]],
        )


@njit(cache=True, nogil=True)
def agreed_shares(
    clearance: NDArray[np.float32],
    corner: FloatArray,
    resolution: float,
    pose: FloatArray,
    origin: NDArray[np.float32],
    end: NDArray[np.float32],
    tolerance: float,
    is_matched: NDArray[np.bool_],
) -> tuple[float, float]:
    """Shares of one view that match and that lie beyond; ``is_matched`` (B,) is written to."""
    rows, columns = clearance.shape
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    matched = beyond = 0
    for i in range(len(end)):
        start_x = pose[0] + cos * origin[i, 0] - sin * origin[i, 1]
        start_y = pose[1] + sin * origin[i, 0] + cos * origin[i, 1]
        end_x = pose[0] + cos * end[i, 0] - sin * end[i, 1]
        end_y = pose[1] + sin * end[i, 0] + cos * end[i, 1]
        column = int(np.floor((end_x - corner[0]) / resolution))
        row = int(np.floor((end_y - corner[1]) / resolution))
        # Where a surface is grazed, the range says little: look around the end point as well.
        inside = 0 <= row < rows and 0 <= column < columns
        is_matched[i] = inside and clearance[row, column] < NEIGHBOUR_CELLS
        if not is_matched[i]:
            measured = np.hypot(end_x - start_x, end_y - start_y)
            if measured == 0.0:
                continue
            expected = resolution * walked_range(
                clearance,
                (start_x - corner[0]) / resolution,
                (start_y - corner[1]) / resolution,
                (end_x - start_x) / measured,
                (end_y - start_y) / measured,
                (measured + 2.0 * tolerance) / resolution,
            )
            is_matched[i] = abs(measured - expected) < tolerance
            beyond += not is_matched[i] and measured > expected
        matched += is_matched[i]
    count = max(len(end), 1)
    return matched / count, beyond / count
