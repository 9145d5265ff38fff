"""Grids over the floor: metres to cells and back, and what is a wall."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from soundmap.geometry import FloatArray


@dataclass(frozen=True)
class GridFrame:
    """Where the cells of a grid lie in the map frame. Rows run along y, columns along x.

    Attributes
    ----------
    resolution_m : float
        Edge of a square cell [m].
    origin_m : tuple of float
        Lower-left corner of cell [0, 0] in the map frame, x and y [m].
    shape : tuple of int
        Rows and columns.
    """

    resolution_m: float
    origin_m: tuple[float, float]
    shape: tuple[int, int]

    def __post_init__(self) -> None:
        if not self.resolution_m > 0 or min(self.shape) < 1:
            raise ValueError("a grid needs a positive resolution and at least one cell")

    def cells(self, points_m: ArrayLike) -> NDArray[np.int64]:
        """Row and column of each point, shape (..., 2) from x, y of shape (..., 2) [m].

        Cells outside the grid have an index out of range; see `contains`.
        """
        points = np.asarray(points_m, dtype=np.float64)
        index = np.floor((points - np.asarray(self.origin_m)) / self.resolution_m)
        return index.astype(np.int64)[..., ::-1]

    def centres(self, cells: ArrayLike) -> FloatArray:
        """Centre x, y [m] of each cell, shape (..., 2) from row, column of shape (..., 2)."""
        index = np.asarray(cells, dtype=np.float64)[..., ::-1]
        return (index + 0.5) * self.resolution_m + np.asarray(self.origin_m)

    def contains(self, cells: ArrayLike) -> NDArray[np.bool_]:
        """Whether each row, column lies in the grid, shape (...) from (..., 2)."""
        index = np.asarray(cells)
        return np.asarray(np.all((index >= 0) & (index < np.asarray(self.shape)), axis=-1))

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """Left, right, bottom, top edge [m]."""
        (x, y), (rows, columns) = self.origin_m, self.shape
        return (x, x + columns * self.resolution_m, y, y + rows * self.resolution_m)


@dataclass(frozen=True)
class OccupancyGrid:
    """The geometric map of Sect. 2.1: what is wall, what is open, what nobody has seen.

    Attributes
    ----------
    frame : GridFrame
    occupied : ndarray of bool, shape (H, W)
        Walls and structures.
    free : ndarray of bool, shape (H, W)
        Open space. A cell that is neither is unknown.
    """

    frame: GridFrame
    occupied: NDArray[np.bool_]
    free: NDArray[np.bool_]

    def __post_init__(self) -> None:
        if self.occupied.shape != self.frame.shape or self.free.shape != self.frame.shape:
            raise ValueError("occupancy needs one value a cell")

    @cached_property
    def clearance_cells(self) -> NDArray[np.float32]:
        """Distance from the centre of each cell to that of the nearest occupied one [cells]."""
        from scipy.ndimage import distance_transform_edt

        if not self.occupied.any():
            return np.full(self.frame.shape, float(sum(self.frame.shape)), dtype=np.float32)
        return np.asarray(distance_transform_edt(~self.occupied), dtype=np.float32)
