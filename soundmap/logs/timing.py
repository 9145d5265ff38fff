"""How regularly the messages of a topic come, and how well its clock goes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.logs.coverage import GAP_PERIODS, GAP_S
from soundmap.logs.stamps import DAMAGED

MIN_DRIFT_SPAN_S = 10.0
"""A shorter time cannot tell parts per million: messages are logged some milliseconds late."""


@dataclass(frozen=True)
class Timing:
    """Regularity of a topic.

    Attributes
    ----------
    rate_hz : float
        Mean rate; 0 for fewer than two messages.
    gaps : int
        How often it was silent for both half a second and five periods.
    longest_gap_s : float
        Longest time between two messages.
    jitter_s : float
        Standard deviation of the time between messages, by their median deviation.
    drift_ppm : float or None
        How much faster the clock of the stamps goes than the log's; None if nobody can tell.
    """

    rate_hz: float
    gaps: int
    longest_gap_s: float
    jitter_s: float
    drift_ppm: float | None


def timing(log_time_ns: NDArray[np.int64], stamp_ns: NDArray[np.int64] | None) -> Timing:
    """Regularity of messages by their times of logging, and by their stamps where they have any.

    Parameters
    ----------
    log_time_ns : ndarray of int64, shape (M,)
    stamp_ns : ndarray of int64, shape (M,), or None
        0 where no stamp was set, ``DAMAGED`` where a message makes no sense.
    """
    logged = np.sort(log_time_ns)
    if len(logged) < 2 or logged[-1] == logged[0]:
        return Timing(0.0, 0, 0.0, 0.0, None)
    silent_s = np.diff(logged) * 1e-9
    gaps = silent_s > max(GAP_S, GAP_PERIODS * float(np.quantile(silent_s, 0.95)))
    between_s, drift_ppm = silent_s, None
    if stamp_ns is not None:
        stamped = (stamp_ns != DAMAGED) & (stamp_ns != 0)
        if np.count_nonzero(stamped) > 2:
            between_s = np.diff(np.sort(stamp_ns[stamped])) * 1e-9
            drift_ppm = _drift_ppm(log_time_ns[stamped], stamp_ns[stamped])
    deviation = np.abs(between_s - np.median(between_s))
    return Timing(
        rate_hz=(len(logged) - 1) / (float(logged[-1] - logged[0]) * 1e-9),
        gaps=int(np.count_nonzero(gaps)),
        longest_gap_s=float(silent_s.max()),
        jitter_s=float(1.4826 * np.median(deviation)),
        drift_ppm=drift_ppm,
    )


def _drift_ppm(log_time_ns: NDArray[np.int64], stamp_ns: NDArray[np.int64]) -> float | None:
    """From the median lead of the stamps in the first and in the last third."""
    ahead_s = (stamp_ns - log_time_ns - (stamp_ns[0] - log_time_ns[0])) * 1e-9
    third = len(ahead_s) // 3
    at_s = (log_time_ns - log_time_ns[0]) * 1e-9
    if third < 5 or at_s[-1] < MIN_DRIFT_SPAN_S:
        return None
    span_s = float(np.median(at_s[-third:]) - np.median(at_s[:third]))
    if span_s <= 0.0:
        return None
    return 1e6 * float(np.median(ahead_s[-third:]) - np.median(ahead_s[:third])) / span_s
