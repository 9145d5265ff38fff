"""The best place of a scan on others within a window: correlative search by branch and bound.

The others are drawn as a grid of nearness; halving blocks of translations under an upper bound
from maxima of that grid finds the very best pose without trying all (Olson, ICRA 2009; Hess et
al., ICRA 2016).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from soundmap.geometry import FloatArray

CELL_M = 0.05
SIGMA_M = 0.08
"""Nearness falls off with the distance from a return by this standard deviation [m]."""
REACH_CELLS = 5
LEVELS = 5
"""Blocks of 1, 2, ..., 16 cells."""
MOST_SIDE_M = 60.0

ByteArray = NDArray[np.uint8]


@dataclass(frozen=True)
class NearnessGrid:
    """Nearness to the returns of laser scans, 255 at a return.

    Attributes
    ----------
    levels : ndarray of uint8, shape (L, H, W)
        Level l holds the greatest nearness in the block of 2^l x 2^l cells that starts at a cell.
    origin_m : tuple of float
        Corner of cell [0, 0], x and y [m].
    """

    levels: NDArray[np.uint8]
    origin_m: tuple[float, float]


def nearness_grid(points_m: FloatArray, centre_m: FloatArray) -> NearnessGrid:
    """The grid of some returns, shape (P, 2) [m], within 30 m of a centre."""
    low = np.maximum(points_m.min(axis=0), centre_m - MOST_SIDE_M / 2) - 0.5
    high = np.minimum(points_m.max(axis=0), centre_m + MOST_SIDE_M / 2) + 0.5
    side = np.maximum(np.ceil((high - low) / CELL_M).astype(np.int64), 1)
    offset = np.arange(-REACH_CELLS, REACH_CELLS + 1) * CELL_M
    square = offset[:, None] ** 2 + offset[None, :] ** 2
    stamp = np.rint(255 * np.exp(-0.5 * square / SIGMA_M**2)).astype(np.uint8)
    cell = np.floor((points_m - low) / CELL_M).astype(np.int64)
    base = np.zeros((int(side[1]), int(side[0])), dtype=np.uint8)
    _stamp(base, np.ascontiguousarray(cell), stamp)
    return NearnessGrid(_pooled(base, LEVELS), (float(low[0]), float(low[1])))


@dataclass(frozen=True)
class Placement:
    """Where a scan lies best, and how well.

    Attributes
    ----------
    pose : ndarray, shape (3,)
    score : float
        Mean nearness of the returns, 0 to 1.
    rival : float
        The best score of any pose that is clearly another one; 0 if not asked for.
    """

    pose: FloatArray
    score: float
    rival: float


def best_placement(
    grid: NearnessGrid,
    points_m: NDArray[np.floating],
    expected: FloatArray,
    *,
    window_m: float,
    window_rad: float,
    least_score: float = 0.0,
    rival_beyond_m: float | None = None,
    rival_beyond_rad: float = 0.25,
) -> Placement | None:
    """The pose within a window at which the returns of a scan come nearest to those of others.

    Parameters
    ----------
    grid : NearnessGrid
    points_m : ndarray, shape (P, 2)
        Returns of the scan in its own frame [m].
    expected : ndarray, shape (3,)
        Middle of the window, in the frame of the grid.
    window_m, window_rad : float
        Half widths of the window.
    least_score : float
        Worse poses are of no interest.
    rival_beyond_m, rival_beyond_rad : float
        Poses farther than this from the best count as rivals; None: do not look for any.

    Returns
    -------
    Placement or None
        None if no pose has the least score.
    """
    reach = max(float(np.quantile(np.hypot(*points_m.T), 0.9)), 1.0)
    step = CELL_M / reach
    turns = int(np.ceil(window_rad / step))
    heading = expected[2] + step * np.arange(-turns, turns + 1)
    half = int(np.ceil(window_m / CELL_M))
    points = np.ascontiguousarray(points_m, dtype=np.float64)
    start = expected[:2] - np.array(grid.origin_m)
    nowhere = np.array([0, 0, -1, 0, 0], dtype=np.int64)
    found, score = _searched(grid.levels, points, start, heading, half, least_score, nowhere)
    if found[2] < 0:
        return None
    pose = np.array(
        [
            expected[0] + found[0] * CELL_M,
            expected[1] + found[1] * CELL_M,
            heading[found[2]],
        ]
    )
    rival = 0.0
    if rival_beyond_m is not None:
        away = np.array(
            [*found, int(rival_beyond_m / CELL_M), int(rival_beyond_rad / step)], dtype=np.int64
        )
        floor = 0.5 * score
        other, rival = _searched(grid.levels, points, start, heading, half, floor, away)
        rival = rival if other[2] >= 0 else floor
    return Placement(pose, score, rival)


@njit(cache=True, nogil=True)
def _stamp(base: ByteArray, cells: NDArray[np.int64], stamp: ByteArray) -> None:
    rows, columns = base.shape
    reach = len(stamp) // 2
    for k in range(len(cells)):
        column, row = cells[k]
        if not (-reach <= column < columns + reach and -reach <= row < rows + reach):
            continue
        if 0 <= row < rows and 0 <= column < columns and base[row, column] == 255:
            continue  # stamped before
        for a in range(max(row - reach, 0), min(row + reach + 1, rows)):
            for b in range(max(column - reach, 0), min(column + reach + 1, columns)):
                value = stamp[a - row + reach, b - column + reach]
                if value > base[a, b]:
                    base[a, b] = value


@njit(cache=True, nogil=True)
def _pooled(base: ByteArray, count: int) -> NDArray[np.uint8]:
    rows, columns = base.shape
    levels = np.empty((count, rows, columns), dtype=np.uint8)
    levels[0] = base
    for level in range(1, count):
        half = 1 << (level - 1)
        for a in range(rows):
            below = min(a + half, rows - 1)
            for b in range(columns):
                right = min(b + half, columns - 1)
                one = max(levels[level - 1, a, b], levels[level - 1, below, b])
                two = max(levels[level - 1, a, right], levels[level - 1, below, right])
                levels[level, a, b] = max(one, two)
    return levels


@njit(cache=True, nogil=True)
def _bound(
    levels: NDArray[np.uint8],
    level: int,
    cells: NDArray[np.int32],
    shift_column: int,
    shift_row: int,
) -> float:
    """Greatest score of any shift in a block; a block may begin outside the grid."""
    rows, columns = levels.shape[1:]
    size = 1 << level
    total = 0
    for k in range(len(cells)):
        column, row = cells[k, 0] + shift_column, cells[k, 1] + shift_row
        if -size < column < columns and -size < row < rows:
            total += levels[level, max(row, 0), max(column, 0)]
    return total / (255.0 * len(cells))


def _searched(
    levels: NDArray[np.uint8],
    points: FloatArray,
    start: FloatArray,
    heading: FloatArray,
    half: int,
    least: float,
    away: NDArray[np.int64],
) -> tuple[NDArray[np.int64], float]:
    """Best column shift, row shift and heading index; away from a given one if it is set."""
    cells = _turned_cells(points, start, heading)
    top = min(len(levels) - 1, (2 * half + 1).bit_length() - 1)
    bounds = _top_bounds(levels, top, cells, half)
    # Sorting by compiled code would take seconds to compile.
    order = np.argsort(-bounds, axis=None, kind="stable")
    return _descended(levels, top, cells, half, bounds, order, least, away)


@njit(cache=True, nogil=True)
def _turned_cells(points: FloatArray, start: FloatArray, heading: FloatArray) -> NDArray[np.int32]:
    """Column and row of each return at each heading, shape (headings, P, 2)."""
    cells = np.empty((len(heading), len(points), 2), dtype=np.int32)
    for turn in range(len(heading)):
        cos, sin = np.cos(heading[turn]), np.sin(heading[turn])
        for k in range(len(points)):
            x = start[0] + cos * points[k, 0] - sin * points[k, 1]
            y = start[1] + sin * points[k, 0] + cos * points[k, 1]
            cells[turn, k, 0] = int(np.floor(x / CELL_M))
            cells[turn, k, 1] = int(np.floor(y / CELL_M))
    return cells


@njit(cache=True, nogil=True)
def _top_bounds(
    levels: NDArray[np.uint8], top: int, cells: NDArray[np.int32], half: int
) -> FloatArray:
    """Bound of every block of the top level at every heading, shape (headings, rows, columns)."""
    size = 1 << top
    blocks = (2 * half + size) // size
    bounds = np.empty((len(cells), blocks, blocks))
    for turn in range(len(cells)):
        for a in range(blocks):
            for b in range(blocks):
                bounds[turn, a, b] = _bound(
                    levels, top, cells[turn], b * size - half, a * size - half
                )
    return bounds


@njit(cache=True, nogil=True)
def _descended(
    levels: NDArray[np.uint8],
    top: int,
    cells: NDArray[np.int32],
    half: int,
    bounds: FloatArray,
    order: NDArray[np.int64],
    least: float,
    away: NDArray[np.int64],
) -> tuple[NDArray[np.int64], float]:
    """Best shift and heading: blocks are halved, the most promising first."""
    size, blocks = 1 << top, bounds.shape[1]
    best = np.array([0, 0, -1], dtype=np.int64)
    score = least
    stack = np.empty((4 * (top + 2), 3), dtype=np.int64)
    promise = np.empty(len(stack))
    for index in order:
        turn = index // (blocks * blocks)
        a, b = (index // blocks) % blocks, index % blocks
        if bounds[turn, a, b] <= score:
            break
        stack[0, 0], stack[0, 1], stack[0, 2] = b * size - half, a * size - half, top
        promise[0] = bounds[turn, a, b]
        depth = 1
        while depth > 0:
            depth -= 1
            if promise[depth] <= score:
                continue
            column, row, level = stack[depth]
            if level == 0:
                near = (
                    abs(column - away[0]) <= away[3]
                    and abs(row - away[1]) <= away[3]
                    and abs(turn - away[2]) <= away[4]
                )
                if abs(column) <= half and abs(row) <= half and not (away[2] >= 0 and near):
                    score = promise[depth]
                    best[0], best[1], best[2] = column, row, turn
                continue
            step = 1 << (level - 1)
            base = depth
            for child in range(4):
                c, r = column + step * (child % 2), row + step * (child // 2)
                bound = _bound(levels, level - 1, cells[turn], c, r)
                if bound <= score:
                    continue
                place = depth
                while place > base and promise[place - 1] > bound:
                    stack[place] = stack[place - 1]
                    promise[place] = promise[place - 1]
                    place -= 1
                stack[place, 0], stack[place, 1], stack[place, 2] = c, r, level - 1
                promise[place] = bound
                depth += 1
    return best, score
