"""Verdict: whether an estimate of the array's offsets is of use, and clear enough to correct."""

from __future__ import annotations

import numpy as np

from soundmap.geometry import FloatArray
from soundmap.sensors import ArrayOffsets, Offset, OffsetVerdict

USEFUL = np.array([0.015, np.radians(1.5)])
"""Results less certain than this, as a standard deviation, are of no use [s, rad]."""
CLEAR_SIGMAS = 3.5
"""Offsets of more standard deviations than this are clear."""


def judged(
    state: FloatArray, sigma: FloatArray, explained: float, places: int, *, correct: bool
) -> ArrayOffsets:
    """Clock and yaw with their verdicts.

    Parameters
    ----------
    state, sigma : ndarray, shape (2,)
        Clock [s] and yaw [rad], and their standard deviations.
    explained : float
    places : int
        As in `ArrayOffsets`.
    correct : bool
        Whether clear offsets are corrected, not only told.
    """
    clock, yaw = (
        _offset(float(value), float(spread), float(useful), correct=correct)
        for value, spread, useful in zip(state, sigma, USEFUL, strict=True)
    )
    uncertain = OffsetVerdict.UNKNOWN in (clock.verdict, yaw.verdict)
    why = "turns and sources along the way leave it too uncertain" if uncertain else ""
    return ArrayOffsets(clock, yaw, explained, places, why)


def _offset(value: float, sigma: float, useful: float, *, correct: bool) -> Offset:
    if sigma > useful:
        return Offset(value, sigma, OffsetVerdict.UNKNOWN)
    if abs(value) <= CLEAR_SIGMAS * sigma:
        return Offset(value, sigma, OffsetVerdict.NOUGHT)
    return Offset(value, sigma, OffsetVerdict.CORRECTED if correct else OffsetVerdict.CLEAR)
