"""Which time each message of a stream stands for: its stamp, checked against the log's own time."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from soundmap.losses import LossLedger

Times = NDArray[np.int64]

DAMAGED = -(2**62)
"""Stands for the stamp of a message that cannot be used."""

FAR_OFF_NS = 60_000_000_000
"""A single stamp this far from where its neighbours are, by the log's time, is damaged ..."""

FEW = 0.1
"""... unless more than this share are: then a clock was set."""

OTHER_CLOCK_NS = 5_000_000_000
"""Streams whose stamps differ by more than this, by the log's time, are on different clocks."""


STEP_NS = 100_000_000
"""A clock was set if stamps step by more than this against the log's time, for good."""

STEP_WINDOW_NS, STEP_WINDOW = 1_000_000_000, 5
"""For good is for this time and this many messages."""

PROMPT = 0.8
"""Messages are logged late, never early: a high quantile of stamp less log time shows the clock."""


def stream_times(
    stamp_ns: Iterable[int],
    log_time_ns: Iterable[int],
    topic: str,
    losses: LossLedger,
    *,
    reference_ahead_ns: int | None = None,
) -> tuple[Times, int]:
    """Times of the messages of a stream, and how far they are ahead of the log's own time.

    Parameters
    ----------
    stamp_ns, log_time_ns : iterables of int, M each
        Stamps, 0 if never set, ``DAMAGED`` if the message is; and times of logging [ns].
    topic, losses
        Where to count what is wrong.
    reference_ahead_ns : int, optional
        How far another stream is ahead: where this one's clock was set, what is nearest to it is
        right. Default: the log's own time.

    Returns
    -------
    times : ndarray of int64, shape (M,)
        The time of logging where no stamp was set; ``DAMAGED`` where a stamp makes no sense.
    ahead_ns : int
        Median of time less time of logging.
    """
    stamp = np.fromiter(stamp_ns, dtype=np.int64)
    log_time = np.fromiter(log_time_ns, dtype=np.int64)
    whole = stamp != DAMAGED
    unset = stamp == 0
    losses.remark(
        "message without a stamp",
        topic,
        count=int(np.count_nonzero(unset)),
        effect="time of logging used instead",
    )
    times = np.where(unset, log_time, stamp)
    if not np.any(whole):
        return times, 0
    _undo_steps(times, log_time, whole, reference_ahead_ns or 0, topic, losses)
    ahead = times - log_time
    usual = int(np.median(ahead[whole]))
    far = whole & (np.abs(ahead - usual) > FAR_OFF_NS)
    if 0 < np.count_nonzero(far) <= FEW * np.count_nonzero(whole):
        losses.add(
            "stamp far from the time of logging",
            topic,
            count=int(np.count_nonzero(far)),
            effect="message left out",
            time_ns=log_time[far],
        )
        times[far] = DAMAGED
    return times, usual


def _undo_steps(
    times: Times,
    log_time: Times,
    whole: NDArray[np.bool_],
    reference_ns: int,
    topic: str,
    losses: LossLedger,
) -> None:
    """Bring stretches between which the clock of the stamps was set to one clock, in place."""
    index = np.flatnonzero(whole)
    ahead = (times - log_time)[index]
    begins = _step_places(ahead, log_time[index])
    if len(begins) < 2:
        return
    ends = [*begins[1:], len(index)]
    levels = [_prompt(ahead[a:b]) for a, b in zip(begins, ends, strict=True)]
    right = min(levels, key=lambda level: abs(level - reference_ns))
    for a, b, level in zip(begins, ends, levels, strict=True):
        times[index[a:b]] -= level - right
    losses.add(
        "clock of the stamps was set",
        topic,
        count=len(begins) - 1,
        effect="undone by the time of logging",
        time_ns=log_time[index[begins[1:]]],
    )


def _step_places(ahead: Times, log_time: Times) -> list[int]:
    """First message of every stretch in which stamps are ahead of the log's time by the same."""
    begins = [0]
    for i in (np.flatnonzero(np.abs(np.diff(ahead)) > STEP_NS) + 1).tolist():
        start = np.searchsorted(log_time, log_time[i] - STEP_WINDOW_NS)
        end = np.searchsorted(log_time, log_time[i] + STEP_WINDOW_NS)
        before = ahead[max(min(int(start), i - STEP_WINDOW), begins[-1]) : i]
        after = ahead[i : max(int(end), i + STEP_WINDOW)]
        if min(len(before), len(after)) < STEP_WINDOW:
            continue
        if abs(_prompt(after) - _prompt(before)) > STEP_NS:
            begins.append(i)
    return begins


def _prompt(ahead: Times) -> int:
    return int(np.quantile(ahead, PROMPT, method="nearest"))


def on_common_clock(
    times: Times, ahead_ns: int, reference_ahead_ns: int, topic: str, losses: LossLedger
) -> Times:
    """Times of a stream on the clock of another, where the two clocks are not the same.

    The log's own time, which all streams share, tells how far they are apart.
    """
    apart = ahead_ns - reference_ahead_ns
    if abs(apart) <= OTHER_CLOCK_NS:
        return times
    losses.remark(
        f"stamps are {apart * 1e-9:.1f} s off those of the odometry",
        topic,
        effect="brought together by the time of logging",
    )
    return np.where(times == DAMAGED, times, times - apart)


def increasing(time_ns: Times) -> NDArray[np.bool_]:
    """True where a time is later than all before it, shape (M,)."""
    latest = np.maximum.accumulate(time_ns) if len(time_ns) else time_ns
    rising = np.ones(len(time_ns), dtype=bool)
    rising[1:] = time_ns[1:] > latest[:-1]
    return rising
