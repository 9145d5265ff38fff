"""What is louder in one run than in another: difference of two power maps in dB. Sects. 4-5."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from soundmap.change import Change, ChangeKind
from soundmap.detect.peaks import local_maxima
from soundmap.geometry import FloatArray, transformed
from soundmap.grid import GridFrame
from soundmap.sound import PowerMap, decibels

VISITS_ALIKE = 5.0
"""Scans one after the other, half a second of them, tell of a cell as much as one does: they
share the pose, its error, and the way to the cell."""
DECIBELS_PER_SHARE = 10.0 / np.log(10.0)


@dataclass(frozen=True)
class CellLevels:
    """Levels of the cells of one run.

    Attributes
    ----------
    level_db : ndarray, shape (H, W)
        NaN where not measured, or visited too rarely.
    sigma_db : ndarray, shape (H, W)
        Standard error of it; NaN where unknown.
    freedom : ndarray, shape (H, W)
        Degrees of freedom that the standard error rests on.
    is_limit : ndarray of bool, shape (H, W), or None
        Where the level is only the most that can be there; None: nowhere.
    """

    level_db: FloatArray
    sigma_db: FloatArray
    freedom: FloatArray
    is_limit: NDArray[np.bool_] | None = None

    @property
    def scatter_db(self) -> float:
        """How the levels of the measured cells scatter, without those that stand out [dB]."""
        finite = self.level_db[np.isfinite(self.level_db)]
        if len(finite) < 2:
            return float("nan")
        return float(1.4826 * np.median(np.abs(finite - np.median(finite))))


def cell_levels(power_map: PowerMap, *, min_visit_share: float) -> CellLevels:
    """Level of each cell, and its standard error from how the cell's shares scatter."""
    power = power_map.power(min_visit_share=min_visit_share)
    independent = power_map.visits / VISITS_ALIKE
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = power_map.spread() / power / np.sqrt(independent)
    freedom = np.maximum(independent - 1.0, 0.0)
    sigma = np.where(freedom > 0.0, DECIBELS_PER_SHARE * relative, np.nan)
    return CellLevels(decibels(power), sigma, freedom, power_map.is_limit)


def power_ratio(
    run: CellLevels,
    frame: GridFrame,
    background: CellLevels,
    background_frame: GridFrame,
    pose: ArrayLike = (0.0, 0.0, 0.0),
) -> tuple[CellLevels, NDArray[np.bool_]]:
    """Ratio of two power maps in dB, on the grid of the first.

    The grids need not coincide: each cell is compared with the background's cell that holds its
    centre. Where the background run measured nothing, nothing
    there was the strongest candidate of any of its scans, so the place was no louder than what
    was: the median of the background's measured cells stands in, and their scatter is its error.
    Where the run itself measured nothing, there is no ratio. Where both only know the most that
    can be there, they tell of no difference: the ratio is 0 dB.

    Parameters
    ----------
    run : CellLevels
        Of shape (H, W).
    frame : GridFrame
    background : CellLevels
        Of shape (H', W').
    background_frame : GridFrame
    pose : array_like, shape (3,)
        Of the run's map frame in that of the background [m], [rad]: nothing if both have one map.

    Returns
    -------
    ratio : CellLevels
        [dB]; NaN where the run did not measure.
    background_measured : ndarray of bool, shape (H, W)

    Raises
    ------
    ValueError
        If the background measured nothing at all.
    """
    known = background.level_db[~np.isnan(background.level_db)]
    if not len(known):
        raise ValueError("the background power map holds no measurement")
    centres = frame.centres(np.moveaxis(np.indices(frame.shape), 0, -1))
    cells = background_frame.cells(transformed(pose, centres))
    inside = background_frame.contains(cells)
    row, column = np.where(inside, cells[..., 0], 0), np.where(inside, cells[..., 1], 0)

    def beneath(values: FloatArray | NDArray[np.bool_]) -> FloatArray:
        return np.where(inside, values[row, column], np.nan)

    level = beneath(background.level_db)
    measured = ~np.isnan(level)
    reference = np.where(measured, level, np.median(known))
    sigma = np.where(measured, beneath(background.sigma_db), background.scatter_db)
    freedom = np.where(measured, beneath(background.freedom), max(len(known) - 1, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = run.level_db - reference
        variance = run.sigma_db**2 + sigma**2
        shares = run.sigma_db**4 / run.freedom + sigma**4 / freedom
        together = np.where(variance > 0.0, variance**2 / shares, np.inf)
    if run.is_limit is not None and background.is_limit is not None:
        untold = run.is_limit & (~measured | beneath(background.is_limit).astype(bool))
        ratio = np.where(untold & np.isfinite(ratio), 0.0, ratio)
    return CellLevels(ratio, np.sqrt(variance), together), measured


def chance(ratio: CellLevels) -> FloatArray:
    """Probability that a cell of an unchanged site differs as much, shape (H, W).

    Student's t with Welch's degrees of freedom; NaN where the error of the ratio is not known.
    """
    from scipy.special import stdtr

    with np.errstate(invalid="ignore", divide="ignore"):
        t = np.abs(ratio.level_db) / ratio.sigma_db
    return np.asarray(2.0 * stdtr(ratio.freedom, -t), dtype=np.float64)


def changed_cells(
    ratio: CellLevels,
    visits: NDArray[np.int64],
    background_measured: NDArray[np.bool_],
    frame: GridFrame,
    *,
    separation_m: float,
    min_ratio_db: float,
) -> tuple[Change, ...]:
    """Local maxima of the ratio above a threshold, greatest first.

    The probability of a false alarm counts every place of the map that could have been a maximum.

    Parameters
    ----------
    ratio : CellLevels
    visits, background_measured : ndarray, shape (H, W)
        As in `PowerRatio`.
    frame : GridFrame
    separation_m : float
        A maximum is the greatest cell within this distance [m].
    min_ratio_db : float
        Least ratio reported [dB].
    """
    cells = local_maxima(ratio.level_db, radius_cells=separation_m / frame.resolution_m)
    by_chance = chance(ratio)
    changes = []
    for (x, y), (row, column) in zip(frame.centres(cells), cells, strict=True):
        if ratio.level_db[row, column] > min_ratio_db:
            met = background_measured[row, column]
            changes.append(
                Change(
                    float(x),
                    float(y),
                    float(ratio.level_db[row, column]),
                    int(visits[row, column]),
                    ChangeKind.LOUDER if met else ChangeKind.APPEARED,
                    _known(ratio.sigma_db[row, column]),
                    family_chance(by_chance[row, column], len(cells)),
                )
            )
    return tuple(changes)


def seen_from_the_other_side(change: Change, pose: ArrayLike = (0.0, 0.0, 0.0)) -> Change:
    """The change that the background run would have undergone, told of the run.

    Parameters
    ----------
    change : Change
    pose : array_like, shape (3,)
        Of the background's map frame in that of the run [m], [rad].
    """
    turned = {ChangeKind.LOUDER: ChangeKind.QUIETER, ChangeKind.APPEARED: ChangeKind.GONE}
    x, y = transformed(pose, (change.x_m, change.y_m)).tolist()
    kind = turned.get(change.kind, change.kind)
    return dataclasses.replace(change, x_m=x, y_m=y, ratio_db=-change.ratio_db, kind=kind)


def family_chance(probability: float, trials: int) -> float | None:
    """Probability that any of several trials shows what one shows with a probability.

    Examples
    --------
    >>> round(family_chance(0.01, 5), 4)
    0.049
    """
    if np.isnan(probability):
        return None
    return float(-np.expm1(trials * np.log1p(-min(probability, 1.0 - 1e-16))))


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
