"""What is louder in one run than in another: difference of two power maps in dB. Sects. 4-5."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soundmap.detect.peaks import local_maxima
from soundmap.geometry import FloatArray
from soundmap.grid import GridFrame
from soundmap.sound import Change, PowerRatio, decibels


def power_ratio(
    power: FloatArray,
    frame: GridFrame,
    background: FloatArray,
    background_frame: GridFrame,
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Ratio of two power maps in dB, on the grid of the first.

    The grids need not coincide, only the map frame they lie in: each cell is compared with the
    background's cell that holds its centre. Where the background run measured nothing, nothing
    there was the strongest candidate of any of its scans, so the place was no louder than what
    was: the median of the background's measured cells stands in. Where the run itself measured
    nothing, there is no ratio.

    Parameters
    ----------
    power : ndarray, shape (H, W)
        Power map of the run [linear], NaN where not measured.
    frame : GridFrame
    background : ndarray, shape (H', W')
        Power map of the background run [linear], NaN where not measured.
    background_frame : GridFrame

    Returns
    -------
    ratio_db : ndarray, shape (H, W)
        [dB]; NaN where the run did not measure.
    background_measured : ndarray of bool, shape (H, W)

    Raises
    ------
    ValueError
        If the background measured nothing at all.
    """
    if not np.isfinite(background).any():
        raise ValueError("the background power map holds no measurement")
    centres = frame.centres(np.moveaxis(np.indices(frame.shape), 0, -1))
    cells = background_frame.cells(centres)
    inside = background_frame.contains(cells)
    row, column = np.where(inside, cells[..., 0], 0), np.where(inside, cells[..., 1], 0)
    beneath = np.where(inside, background[row, column], np.nan)
    measured = np.isfinite(beneath)
    reference = np.where(measured, beneath, np.nanmedian(background))
    with np.errstate(divide="ignore", invalid="ignore"):
        return decibels(power) - decibels(reference), measured


def changed_places(
    ratio_db: FloatArray,
    visits: NDArray[np.int64],
    background_measured: NDArray[np.bool_],
    frame: GridFrame,
    *,
    separation_m: float,
    min_ratio_db: float,
) -> PowerRatio:
    """Local maxima of the ratio above a threshold, greatest first, with the ratio itself.

    Parameters
    ----------
    ratio_db, visits, background_measured : ndarray, shape (H, W)
        As in `PowerRatio`.
    frame : GridFrame
    separation_m : float
        A maximum is the greatest cell within this distance [m].
    min_ratio_db : float
        Least ratio reported [dB].
    """
    cells = local_maxima(ratio_db, radius_cells=separation_m / frame.resolution_m)
    changes = tuple(
        Change(float(x), float(y), float(ratio_db[row, column]), int(visits[row, column]))
        for (x, y), (row, column) in zip(frame.centres(cells), cells, strict=True)
        if ratio_db[row, column] > min_ratio_db
    )
    return PowerRatio(frame, ratio_db, visits, background_measured, changes)
