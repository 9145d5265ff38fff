r"""Running mean of emitted power and number of visits of every cell. Eqs. (4)-(5).

The mean is kept as a sum and a count, which is the same number and lets the maps of two runs be
merged exactly.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from soundmap.grid import GridFrame
from soundmap.sound import LevelReference, PowerMap


def neighbourhood(size_m: float, resolution_m: float) -> NDArray[np.int64]:
    r"""Cells over which one estimate is spread: a disc of diameter :math:`\Delta\theta\rho`.

    Parameters
    ----------
    size_m : float
        :math:`\Delta\theta\rho_n(k)`, width of the beam at the surface [m].
    resolution_m : float
        Edge of a cell [m].

    Returns
    -------
    ndarray of int64, shape (N, 2)
        Offsets row, column of the cells whose centre lies in the disc about the centre of the
        cell hit; that cell itself is always among them.

    Examples
    --------
    >>> [len(neighbourhood(np.radians(3.0) * rho, 0.05)) for rho in (0.3, 2.0, 3.0)]
    [1, 5, 9]
    """
    radius = max(0.5 * size_m / resolution_m, 0.0)
    reach = int(radius)
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    inside = rows**2 + columns**2 <= radius**2 + 1e-9
    return np.stack([rows[inside], columns[inside]], axis=-1)


class PowerAccumulator:
    """The power map as it grows, one estimate after another.

    Parameters
    ----------
    frame : GridFrame
    reference : LevelReference
    """

    def __init__(self, frame: GridFrame, reference: LevelReference) -> None:
        self._frame, self._reference = frame, reference
        self._power_sum = np.zeros(frame.shape)
        self._square_sum = np.zeros(frame.shape)
        self._visits = np.zeros(frame.shape, dtype=np.int64)

    def add(self, point_m: ArrayLike, power: float, *, size_m: float) -> bool:
        r"""Spread one estimate over the neighbourhood of the cell that it falls in, Eqs. (4)-(5).

        Each of the N cells receives the share :math:`C_m(k) / N` and one visit:

        .. math:: P_{ij} \leftarrow (P_{ij} K_{ij} + C_m / N) / (K_{ij} + 1), \quad
                  K_{ij} \leftarrow K_{ij} + 1

        Parameters
        ----------
        point_m : array_like, shape (2,)
            Where the strongest candidate lies in the map frame [m].
        power : float
            :math:`C_m(k)` [linear].
        size_m : float
            :math:`\Delta\theta\rho`, size of the neighbourhood [m].

        Returns
        -------
        bool
            False if the point lies outside the grid; nothing is added then. Shares that fall
            over the grid's edge are lost, those of the other cells stay as they are.
        """
        cell = self._frame.cells(point_m)
        if not self._frame.contains(cell):
            return False
        cells = cell + neighbourhood(size_m, self._frame.resolution_m)
        share = power / len(cells)
        row, column = cells[self._frame.contains(cells)].T
        self._power_sum[row, column] += share
        self._square_sum[row, column] += share**2
        self._visits[row, column] += 1
        return True

    def power_map(self) -> PowerMap:
        """The power map so far, as a copy that does not grow."""
        return PowerMap(
            self._frame,
            self._power_sum.copy(),
            self._visits.copy(),
            self._reference,
            self._square_sum.copy(),
        )
