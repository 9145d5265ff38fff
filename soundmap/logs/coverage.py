"""Where a sensor is silent while others go on: gaps, a late begin, an early end."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from soundmap.losses import LossLedger

GAP_S, GAP_PERIODS = 0.5, 5.0
"""A stream has a gap where it is silent for both this time and this many of its periods."""

EARLY_END_S = 1.0
LATE_BEGIN_S = 3.0
"""Recorders need a moment to find all topics."""


class Stream(Protocol):
    """What a sensor has to say, as far as it is sound."""

    @property
    def name(self) -> str:
        """The topic."""

    @property
    def logged_ns(self) -> NDArray[np.int64]:
        """Times of logging of the sound messages, rising."""

    @property
    def counts_gaps(self) -> bool:
        """Whether its gaps are counted elsewhere."""


def count_silences(streams: Iterable[Stream], losses: LossLedger) -> None:
    """Count stretches of a log in which one of its sensors says nothing."""
    heard = [stream for stream in streams if len(stream.logged_ns)]
    if not heard:
        return
    start = min(int(stream.logged_ns[0]) for stream in heard)
    end = max(int(stream.logged_ns[-1]) for stream in heard)
    for stream in heard:
        _count_ends(stream.name, stream.logged_ns, start, end, losses)
        if not stream.counts_gaps:
            _count_gaps(stream.name, stream.logged_ns, losses)


def _count_ends(
    topic: str, times: NDArray[np.int64], start: int, end: int, losses: LossLedger
) -> None:
    shortest_s = GAP_PERIODS * _period_s(times)
    missing_s = (end - int(times[-1])) * 1e-9
    if missing_s > max(EARLY_END_S, shortest_s):
        losses.add(
            "ends before the other sensors do",
            topic,
            effect=f"{missing_s:.1f} s cannot be used",
            time_ns=times[-1],
        )
    missing_s = (int(times[0]) - start) * 1e-9
    if missing_s > max(LATE_BEGIN_S, shortest_s):
        losses.add(
            "begins after the other sensors do",
            topic,
            effect=f"{missing_s:.1f} s cannot be used",
            time_ns=times[0],
        )


def _count_gaps(topic: str, times: NDArray[np.int64], losses: LossLedger) -> None:
    silent_s = np.diff(times) * 1e-9
    gaps = silent_s > max(GAP_S, GAP_PERIODS * _period_s(times))
    losses.add(
        "sensor silent for a while",
        topic,
        count=int(np.count_nonzero(gaps)),
        effect=f"{float(np.sum(silent_s[gaps])):.1f} s in all; nothing is guessed",
        time_ns=times[:-1][gaps],
    )


def _period_s(times: NDArray[np.int64]) -> float:
    """Period of a stream, or a long one of a stream that has none; nought of a single message."""
    return float(np.quantile(np.diff(times), 0.95)) * 1e-9 if len(times) > 1 else 0.0
