"""Local maxima of a map, where cells may be missing and neighbours may be equal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray


def local_maxima(values: FloatArray, *, radius_cells: float) -> NDArray[np.int64]:
    """Cells that no cell within a radius exceeds, the greatest first.

    One estimate gives all the cells of its neighbourhood the same value (Sect. 2.4), so equal
    neighbours are common: a plateau counts as one maximum, at its cell nearest to the centroid.

    Parameters
    ----------
    values : ndarray, shape (H, W)
        NaN where not measured; such cells neither are maxima nor hinder others.
    radius_cells : float
        Radius of the comparison [cells]; at least 1.5, the eight neighbours, is used.

    Returns
    -------
    ndarray of int64, shape (K, 2)
        Row and column; equal values in the order of rows, then columns.

    Examples
    --------
    >>> ridge = np.array([[1.0, 5.0, 2.0, 3.0, np.nan]])
    >>> local_maxima(ridge, radius_cells=1.5).tolist()
    [[0, 1], [0, 3]]
    """
    from scipy.ndimage import label, maximum_filter

    filled = np.where(np.isfinite(values), values, -np.inf)
    reach = int(max(radius_cells, 1.5))
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc = rows**2 + columns**2 <= max(radius_cells, 1.5) ** 2
    highest = maximum_filter(filled, footprint=disc, mode="constant", cval=-np.inf)
    candidates = np.isfinite(values) & (filled >= highest)
    plateaus, count = label(candidates, structure=np.ones((3, 3)))
    tops = [_middle(np.argwhere(plateaus == index)) for index in range(1, count + 1)]
    if not tops:
        return np.empty((0, 2), dtype=np.int64)
    cells = np.array(tops, dtype=np.int64)
    order = np.lexsort((cells[:, 1], cells[:, 0], -values[cells[:, 0], cells[:, 1]]))
    return _apart(cells[order], radius_cells)


def _middle(plateau: NDArray[np.int64]) -> NDArray[np.int64]:
    """The cell of a plateau nearest to its centroid."""
    offset = plateau - plateau.mean(axis=0)
    return plateau[np.argmin(np.sum(offset**2, axis=1))]


def _apart(cells: NDArray[np.int64], radius_cells: float) -> NDArray[np.int64]:
    """Of maxima nearer to each other than the radius (equal ones), only the first."""
    kept: list[NDArray[np.int64]] = []
    for cell in cells:
        if all(np.sum((cell - other) ** 2) > radius_cells**2 for other in kept):
            kept.append(cell)
    return np.array(kept)
