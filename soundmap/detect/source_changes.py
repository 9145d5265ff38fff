"""What became of each source from a background run to a run, and how sure that is.

The sources of both runs are matched by their places. How loud each place was is then asked of the
scans of *both* runs, whether or not a source was found there: so a source that one run just missed
is not taken for one that went, and silence has an error, too.

A change is one if chance would hardly show it: the level has to differ by more than it may from
one way past an unchanged source to another (`DiffConfig.min_change_db`), by so many standard
errors, as measured within each run, that the probability of any false change among all places
stays below `DiffConfig.false_alarm_rate`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soundmap.change import Change, ChangeKind
from soundmap.config import DiffConfig
from soundmap.detect.difference import DECIBELS_PER_SHARE, family_chance
from soundmap.detect.place_levels import PlaceLevels
from soundmap.geometry import FloatArray
from soundmap.sound import Source, SourceList

SAME_PLACE = 13.8
"""Squared distance of two estimates of one place in units of their covariance: 99.9 %."""
SAME_PLACE_M = 0.25
"""Sources nearer to each other than this are one: the array hardly tells them apart."""
SILENT = 2.0
"""A level below this many standard errors is silence."""

Pair = tuple[int | None, int | None]


def matched_sources(run: SourceList, background: SourceList) -> list[Pair]:
    """Which source of the run is which of the background, nearest first, then those without one.

    Returns
    -------
    list of tuple
        Index in the run and in the background, either None.
    """
    distances = []
    for i, here in enumerate(run):
        for j, there in enumerate(background):
            step = np.array([here.x_m - there.x_m, here.y_m - there.y_m])
            square = step @ np.linalg.solve(_covariance(here) + _covariance(there), step)
            if square < SAME_PLACE or np.hypot(*step) < SAME_PLACE_M:
                distances.append((float(np.hypot(*step)), i, j))
    pairs: list[Pair] = []
    for _, i, j in sorted(distances):
        if all(i != a and j != b for a, b in pairs):
            pairs.append((i, j))
    here_only = set(range(len(run))) - {a for a, _ in pairs}
    there_only = set(range(len(background))) - {b for _, b in pairs}
    return [
        *pairs,
        *((i, None) for i in sorted(here_only)),
        *((None, j) for j in sorted(there_only)),
    ]


def paired_places(
    pairs: list[Pair], run: SourceList, background: SourceList
) -> tuple[FloatArray, FloatArray]:
    """Where each run has the place of each pair, (K, 2) both: its own estimate if it has one."""
    here, there = [], []
    for i, j in pairs:
        mine = None if i is None else run.sources[i]
        its = None if j is None else background.sources[j]
        one, other = mine or its, its or mine
        if one is None or other is None:
            raise ValueError("a pair needs a source")
        here.append((one.x_m, one.y_m))
        there.append((other.x_m, other.y_m))
    return np.array(here).reshape(-1, 2), np.array(there).reshape(-1, 2)


def source_changes(
    pairs: list[Pair],
    places_m: FloatArray,
    visits: list[int],
    run: PlaceLevels,
    background: PlaceLevels,
    config: DiffConfig,
) -> tuple[Change, ...]:
    """What became of each place.

    Parameters
    ----------
    pairs : list of tuple
        As `matched_sources` gives them.
    places_m : ndarray, shape (K, 2)
        Of the pairs [m].
    visits : list of int
        Of each place in the run.
    run, background : PlaceLevels
        Of the places of the pairs in either run.
    config : DiffConfig

    Returns
    -------
    tuple of Change
        In the order of the pairs.
    """
    probability = chance_of_change(run, background, margin_db=config.min_change_db)
    told = int(np.isfinite(probability).sum())
    loud, quiet = _at_most(run), _at_most(background)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = DECIBELS_PER_SHARE * np.log(loud / quiet)
        sigma = DECIBELS_PER_SHARE * np.hypot(run.sigma / loud, background.sigma / quiet)
    heard = _heard(run) & _heard(background)
    changes = []
    for index, (i, j) in enumerate(pairs):
        by_chance = family_chance(float(probability[index]), told)
        changes.append(
            Change(
                float(places_m[index, 0]),
                float(places_m[index, 1]),
                float(ratio[index]),
                visits[index],
                _kind(float(ratio[index]), by_chance, (i, j), config.false_alarm_rate),
                float(sigma[index]) if heard[index] else None,
                by_chance,
                i,
                j,
            )
        )
    return tuple(changes)


def chance_of_change(run: PlaceLevels, background: PlaceLevels, *, margin_db: float) -> FloatArray:
    """Probability that a place would differ as much had it changed by no more than a margin.

    Student's t with Welch's degrees of freedom, of the difference of the strengths beyond the
    margin.

    Returns
    -------
    ndarray, shape (K,)
        NaN where a run does not tell of the place.
    """
    from scipy.special import stdtr

    louder = run.power_1m > background.power_1m
    low = np.where(louder, background.power_1m, run.power_1m)
    high = np.where(louder, run.power_1m, background.power_1m)
    margin = np.where(low > 0.0, 10.0 ** (margin_db / 10.0), 1.0)
    low *= margin
    low_sigma = np.where(louder, background.sigma, run.sigma) * margin
    high_sigma = np.where(louder, run.sigma, background.sigma)
    low_freedom = np.where(louder, background.freedom, run.freedom)
    high_freedom = np.where(louder, run.freedom, background.freedom)
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = low_sigma**2 + high_sigma**2
        freedom = variance**2 / (low_sigma**4 / low_freedom + high_sigma**4 / high_freedom)
        t = np.maximum(high - low, 0.0) / np.sqrt(variance)
    return np.asarray(np.minimum(2.0 * stdtr(freedom, -t), 1.0), dtype=np.float64)


def _kind(ratio_db: float, chance: float | None, pair: Pair, rate: float) -> ChangeKind:
    if chance is None:
        return ChangeKind.UNTOLD
    if chance > rate:
        return ChangeKind.UNCHANGED
    here, there = pair
    if ratio_db > 0.0:
        return ChangeKind.APPEARED if there is None else ChangeKind.LOUDER
    return ChangeKind.GONE if here is None else ChangeKind.QUIETER


def _covariance(source: Source) -> FloatArray:
    least = 1e-6 * np.eye(2)
    return least if source.fit is None else source.fit.covariance_m2 + least


def _heard(levels: PlaceLevels) -> NDArray[np.bool_]:
    return np.asarray(levels.power_1m > SILENT * levels.sigma)


def _at_most(levels: PlaceLevels) -> FloatArray:
    """Strengths, and for silence what it may hide."""
    hidden = np.maximum(levels.power_1m, 0.0) + levels.sigma
    return np.where(_heard(levels), levels.power_1m, hidden)
