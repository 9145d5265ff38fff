"""The part of the map frame that a picture shows, and grids cut down to it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray
from soundmap.grid import GridFrame, OccupancyGrid

MARGIN_M, MARGIN_SHARE = 0.75, 0.04
LEAST_SIDE_M = 2.0
GREATEST_ASPECT = 4.0


@dataclass(frozen=True)
class Area:
    """A rectangle of the map frame.

    Attributes
    ----------
    left, right, bottom, top : float
        Edges [m].
    """

    left: float
    right: float
    bottom: float
    top: float

    @property
    def width(self) -> float:
        """Extent along x [m]."""
        return self.right - self.left

    @property
    def height(self) -> float:
        """Extent along y [m]."""
        return self.top - self.bottom


def area_of_interest(points_m: Iterable[FloatArray], room: OccupancyGrid | None) -> Area:
    """The part of the map to show: where the run took place, as far as the map reaches.

    Parameters
    ----------
    points_m : iterable of ndarray, shapes (..., 2)
        Everything that must be seen [m]. Without any, the whole known map is shown.
    room : OccupancyGrid or None
    """
    known = None if room is None else _bounds(_known_corners(room))
    run = _bounds(np.concatenate([np.zeros((0, 2)), *points_m]))
    if run is None:
        low, high = known if known is not None else (np.zeros(2), np.zeros(2))
    else:
        low, high = run
        if known is not None:  # some surroundings, but not beyond the edge of the known map
            around = max(2.0, 0.1 * float(np.max(high - low)))
            low = np.minimum(low, np.maximum(low - around, known[0]))
            high = np.maximum(high, np.minimum(high + around, known[1]))
    margin = max(MARGIN_M, MARGIN_SHARE * float(np.max(high - low)))
    low, high = low - margin, high + margin
    side = np.maximum(high - low, LEAST_SIDE_M)
    side = np.maximum(side, side.max() / GREATEST_ASPECT)
    left, bottom = (low + high - side) / 2.0
    return Area(float(left), float(left + side[0]), float(bottom), float(bottom + side[1]))


def cropped(
    values: NDArray[np.generic], frame: GridFrame, area: Area
) -> tuple[NDArray[np.generic], tuple[float, float, float, float]]:
    """The cells of a grid that reach into an area, and the edges of that part [m].

    A site may have a hundred million cells, of which a picture shows a corner.
    """
    step, (x, y), (rows, columns) = frame.resolution_m, frame.origin_m, frame.shape
    first_column, last_column = _span(area.left - x, area.right - x, step, columns)
    first_row, last_row = _span(area.bottom - y, area.top - y, step, rows)
    part = values[first_row:last_row, first_column:last_column]
    left, right = x + first_column * step, x + last_column * step
    return part, (left, right, y + first_row * step, y + last_row * step)


def coarsened(
    values: NDArray[np.generic],
    extent: tuple[float, float, float, float],
    block: int,
    reduce: Any,
) -> tuple[Any, tuple[float, float, float, float]]:
    """Blocks of ``block`` x ``block`` cells, and the edges of what they cover [m].

    Examples
    --------
    >>> coarsened(np.array([[1, 2, 3]]), (0.0, 3.0, 0.0, 1.0), 2, np.max)
    (array([[2, 3]]), (0.0, 4.0, 0.0, 2.0))
    """
    if block == 1:
        return values, extent
    rows, columns = values.shape
    tall, wide = -rows % block, -columns % block
    left, right, bottom, top = extent
    step = (right - left) / columns
    full = np.pad(values, ((0, tall), (0, wide)), mode="edge")
    cut = full.reshape(full.shape[0] // block, block, full.shape[1] // block, block)
    grown = (left, right + wide * step, bottom, top + tall * step)
    return reduce(reduce(cut, axis=3), axis=1), grown


def _span(start_m: float, end_m: float, step: float, count: int) -> tuple[int, int]:
    first = min(max(int(np.floor(start_m / step)), 0), count - 1)
    last = min(max(int(np.ceil(end_m / step)), first + 1), count)
    return first, last


def _known_corners(room: OccupancyGrid) -> FloatArray:
    """Corners of the rectangle around everything that is not unknown, shape (2, 2) or (0, 2)."""
    known = room.occupied | room.free
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    if not len(rows):
        return np.zeros((0, 2))
    return room.frame.centres([[rows[0], columns[0]], [rows[-1], columns[-1]]])


def _bounds(points: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    return (points.min(axis=0), points.max(axis=0)) if len(points) else None
