"""Verdict: whether an estimate of the array's offsets is of use, and clear enough to correct."""

from __future__ import annotations

import numpy as np

from soundmap.geometry import FloatArray
from soundmap.sensors import ArrayOffsets, Offset, OffsetVerdict

USEFUL = np.array([0.015, np.radians(1.5)])
"""Results less certain than this, as a standard deviation, are of no use [s, rad]."""
CLEAR_SIGMAS, LIKELY_SIGMAS = 3.5, 1.0
"""Offsets of more standard deviations than the first are clear. An array that is clearly off in one
way is not as it was believed: the other offset is corrected, too, beyond the second, from where on
the estimate is likely to be the better of both."""


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
    clear = np.abs(state) > CLEAR_SIGMAS * sigma
    known = sigma <= USEFUL
    corrected = (np.abs(state) > LIKELY_SIGMAS * sigma) & np.any(clear & known) & correct
    clock, yaw = (
        Offset(float(value), float(spread), _verdict(*each))
        for value, spread, *each in zip(state, sigma, known, corrected, clear, strict=True)
    )
    uncertain = OffsetVerdict.UNKNOWN in (clock.verdict, yaw.verdict)
    why = "turns and sources along the way leave it too uncertain" if uncertain else ""
    return ArrayOffsets(clock, yaw, explained, places, why)


def _verdict(known: bool, corrected: bool, clear: bool) -> OffsetVerdict:
    if not known:
        return OffsetVerdict.UNKNOWN
    if corrected:
        return OffsetVerdict.CORRECTED
    return OffsetVerdict.CLEAR if clear else OffsetVerdict.NOUGHT
