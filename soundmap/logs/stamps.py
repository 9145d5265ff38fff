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


def stream_times(
    stamp_ns: Iterable[int], log_time_ns: Iterable[int], topic: str, losses: LossLedger
) -> tuple[Times, int]:
    """Times of the messages of a stream, and how far they are ahead of the log's own time.

    Parameters
    ----------
    stamp_ns, log_time_ns : iterables of int, M each
        Stamps, 0 if never set, ``DAMAGED`` if the message is; and times of logging [ns].
    topic, losses
        Where to count what is wrong.

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
    ahead = times - log_time
    usual = int(np.median(ahead[whole]))
    far = whole & (np.abs(ahead - usual) > FAR_OFF_NS)
    if 0 < np.count_nonzero(far) <= FEW * np.count_nonzero(whole):
        losses.add(
            "stamp far from the time of logging",
            topic,
            count=int(np.count_nonzero(far)),
            effect="message left out",
        )
        times[far] = DAMAGED
    return times, usual


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
