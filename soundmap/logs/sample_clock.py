r"""When each sample was taken: a robust line through stamps against sample counts.

A stamp is made by a busy computer: it jitters, and now and then it comes late. The samples are
taken by a quartz that only drifts. So within a stretch of audio without a gap, block :math:`i` that
begins after :math:`k_i` samples was taken at

.. math:: t_i = t_0 + k_i / r + \delta(k_i)

with one rate :math:`r` for the log and a slow correction :math:`\delta`, continuous and piecewise
linear, that follows the drift of the quartz. All three are medians. Where the stamps step away from
the count for good, samples are missing or the clock was set: a new stretch begins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from soundmap.geometry import FloatArray

KNOT_SPACING_S = 10.0
"""The correction has one knot in this time: short against thermal drift, long against jitter."""

KNOT_MIN_BLOCKS = 16
"""... and at least this many blocks, so that a knot is a median of something."""

MIN_STEP_S = 2e-3
"""Stamps that step by less than this show no gap, however small their jitter."""

JITTER_FACTOR = 5.0
"""A step must exceed this many standard deviations of the jitter."""

WINDOW_S = 2.0
"""A step lasts for good if the level of the stamps over this time, late ones aside, shows it."""

LATE_QUANTILE = 0.2
"""Stamps come late, not early: a low quantile is the level without the late ones."""


@dataclass(frozen=True)
class SampleClock:
    """Times of the blocks of an audio stream.

    Attributes
    ----------
    start_ns : ndarray of int64, shape (B,)
        Time of the first sample of each block [ns since epoch].
    kept : ndarray of bool, shape (B,)
        False for a block that repeats or overlaps what came before.
    continues : ndarray of bool, shape (B,)
        True if the block follows the last kept one without a gap.
    overlaps : ndarray of bool, shape (B,)
        True if the block is kept but begins before the last kept one has ended.
    rate_hz : float
        Sample rate by the clock of the stamps [Hz].
    drift_ppm : float
        Of ``rate_hz`` against the nominal rate.
    jitter_s : float
        Standard deviation of the stamps about the line, by their median deviation [s].
    gaps : int
        How often samples are missing or the clock was set, overlaps included.
    lost_s : float
        Time of the missing samples [s].
    """

    start_ns: NDArray[np.int64]
    kept: NDArray[np.bool_]
    continues: NDArray[np.bool_]
    overlaps: NDArray[np.bool_]
    rate_hz: float
    drift_ppm: float
    jitter_s: float
    gaps: int
    lost_s: float


def sample_clock(
    stamp_ns: ArrayLike,
    frames: ArrayLike,
    nominal_rate_hz: float,
    *,
    stamp_is_start: bool,
    first_frame: ArrayLike | None = None,
) -> SampleClock:
    """Times of audio blocks from their stamps.

    Parameters
    ----------
    stamp_ns : array_like of int, shape (B,)
        Stamps in the order of the blocks [ns since epoch].
    frames : array_like of int, shape (B,)
        Samples of each channel in each block, > 0.
    nominal_rate_hz : float
        Sample rate as the recorder gives it [Hz], > 0.
    stamp_is_start : bool
        Whether a stamp is that of the first sample of a block or of its end.
    first_frame : array_like of int, shape (B,), optional
        The recorder's own count of samples before each block; shows gaps exactly.

    Raises
    ------
    ValueError
        Shapes differ, or there are no blocks.
    """
    stamps = np.asarray(stamp_ns, dtype=np.int64)
    lengths = np.asarray(frames, dtype=np.int64)
    if stamps.shape != lengths.shape or stamps.ndim != 1 or not len(stamps):
        raise ValueError("a sample clock needs one stamp a block, and at least one block")
    kept = _not_repeated(stamps)
    index = np.flatnonzero(kept)
    counts, breaks = _counts(lengths[index], None if first_frame is None else first_frame, index)
    marks = counts if stamp_is_start else counts + lengths[index]
    seconds = (stamps[index] - stamps[0]) * 1e-9
    rate = _measured_rate(seconds, marks, nominal_rate_hz)
    early = seconds - marks / rate
    jitter = _local_jitter(early)
    block_s = float(np.median(lengths[index])) / rate
    starts = _stretch_starts(early, breaks, jitter, block_s)
    rate = _refined_rate(seconds, marks, starts, rate)
    early = seconds - marks / rate
    level = np.concatenate(
        [_level(early[a:b], marks[a:b] / rate) for a, b in _pairs(starts, len(index))]
    )
    start_s = counts / rate + level
    in_order = _without_overlap(start_s, lengths[index] / rate)
    begins = np.zeros(len(index), dtype=bool)
    begins[starts] = True
    follows = _continuing(begins, in_order)
    gaps, lost = _gaps(start_s[in_order], lengths[index][in_order] / rate, ~follows[in_order])
    all_starts = np.full(len(stamps), stamps[0], dtype=np.int64)
    all_starts[index] = stamps[0] + np.rint(start_s * 1e9).astype(np.int64)
    continues = np.zeros(len(stamps), dtype=bool)
    continues[index] = follows
    kept[index] = in_order
    overlaps = np.zeros(len(stamps), dtype=bool)
    whole = index[in_order]
    ends_s = start_s[in_order] + lengths[whole] / rate
    overlaps[whole[1:]] = ~follows[in_order][1:] & (start_s[in_order][1:] < ends_s[:-1])
    residual = early - level
    return SampleClock(
        start_ns=all_starts,
        kept=kept,
        continues=continues & kept,
        overlaps=overlaps,
        rate_hz=rate,
        drift_ppm=(rate / nominal_rate_hz - 1.0) * 1e6,
        jitter_s=float(1.4826 * np.median(np.abs(residual))),
        gaps=gaps,
        lost_s=lost,
    )


def _not_repeated(stamps: NDArray[np.int64]) -> NDArray[np.bool_]:
    """False for every block that bears the stamp of the one before."""
    kept = np.ones(len(stamps), dtype=bool)
    kept[1:] = np.diff(stamps) != 0
    return kept


def _counts(
    lengths: NDArray[np.int64], first_frame: ArrayLike | None, index: NDArray[np.intp]
) -> tuple[FloatArray, list[int]]:
    """Samples before each block, and the blocks before which the recorder's counter jumps."""
    running = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    if first_frame is None:
        return running.astype(np.float64), []
    counter = np.asarray(first_frame, dtype=np.int64)[index]
    jumps = np.flatnonzero(np.diff(counter) != lengths[:-1]) + 1
    if len(jumps) > 0.5 * len(lengths):  # The field is not a counter of samples.
        return running.astype(np.float64), []
    forward = np.diff(counter) > 0
    # A counter that starts again says nothing about the time that passed: count on.
    steps = np.where(forward, np.diff(counter), lengths[:-1])
    return np.concatenate([[0], np.cumsum(steps)]).astype(np.float64), [int(j) for j in jumps]


def _measured_rate(seconds: FloatArray, marks: FloatArray, nominal: float) -> float:
    """Rate from the median slope over some twenty blocks; nominal if there are too few.

    The blocks are few against all, so that one gap touches few of the slopes.
    """
    span = min(20, len(marks) // 8)
    if span < 4:
        return nominal
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = (seconds[span:] - seconds[:-span]) / (marks[span:] - marks[:-span])
    rate = 1.0 / float(np.median(slope)) if np.median(slope) > 0 else nominal
    # Short of a grave mismatch the nominal rate is a better start than twenty jittering blocks.
    return rate if abs(rate / nominal - 1.0) > 2e-3 else nominal


def _local_jitter(early: FloatArray) -> float:
    if len(early) < 3:
        return 0.0
    return float(1.4826 * np.median(np.abs(np.diff(early))) / np.sqrt(2.0))


def _stretch_starts(
    early: FloatArray, breaks: list[int], jitter_s: float, block_s: float
) -> NDArray[np.intp]:
    """First block of every stretch without a gap: where stamps step away from the count for good.

    ``early`` is the stamp less the time by the count, shape (B,) [s].
    """
    tolerance = max(MIN_STEP_S, JITTER_FACTOR * jitter_s)
    window = int(np.clip(np.ceil(WINDOW_S / block_s), 16, 2000))
    known = set(breaks)
    step = np.diff(early, prepend=early[0])
    candidates = np.flatnonzero(np.abs(step) > 0.6 * tolerance)
    starts = [0]
    for i in sorted({int(c) for c in candidates} | known):
        if i in known or _steps_for_good(early, i, starts[-1], step[i], window, tolerance):
            starts.append(i)
    return np.unique(np.array(starts, dtype=np.intp))


def _steps_for_good(
    early: FloatArray, i: int, start: int, step: float, window: int, tolerance: float
) -> bool:
    before = early[max(start, i - window) : i]
    after = early[i : i + window]
    if not len(before) or not len(after):
        return False
    level = np.quantile(before, LATE_QUANTILE)
    lasting = np.quantile(after, LATE_QUANTILE) - level
    if step > 0:
        return bool(min(lasting, np.min(after[:8]) - level) > tolerance)
    return bool(max(lasting, np.median(after[:8]) - level) < -tolerance)


def _pairs(starts: NDArray[np.intp], count: int) -> list[tuple[int, int]]:
    ends = [*starts[1:].tolist(), count]
    return list(zip(starts.tolist(), ends, strict=True))


def _refined_rate(
    seconds: FloatArray, marks: FloatArray, starts: NDArray[np.intp], rate: float
) -> float:
    """Rate over whole stretches: weighted median of slopes from first to second halves."""
    slopes, weights = [], []
    for a, b in _pairs(starts, len(marks)):
        half = (b - a) // 2
        if half < 4:
            continue
        x, y = marks[a:b], seconds[a:b]
        dx = x[half : 2 * half] - x[:half]
        slopes.append((y[half : 2 * half] - y[:half]) / dx)
        weights.append(dx**2)
    if not slopes:
        return rate
    slope, weight = np.concatenate(slopes), np.concatenate(weights)
    order = np.argsort(slope)
    cumulative = np.cumsum(weight[order])
    middle = int(np.searchsorted(cumulative, 0.5 * cumulative[-1]))
    refined = 1.0 / float(slope[order[middle]])
    # A second of audio cannot tell parts per million.
    span_s = np.sqrt(weight.max()) / rate
    return refined if span_s > 5.0 else rate


def _level(early: FloatArray, count_s: FloatArray) -> FloatArray:
    """The slow correction within a stretch, shape (B,) [s]: knots are medians, lines between."""
    span = count_s[-1] - count_s[0]
    knots = int(np.clip(min(span / KNOT_SPACING_S, len(early) / KNOT_MIN_BLOCKS), 1, None))
    if knots < 2:
        return np.full(len(early), np.median(early))
    parts = np.array_split(np.arange(len(early)), knots)
    at = np.array([float(np.mean(count_s[part])) for part in parts])
    value = np.array([float(np.median(early[part])) for part in parts])
    level = np.interp(count_s, at, value)
    # The ends go on as the nearest two knots do, not flat.
    head, tail = count_s < at[0], count_s > at[-1]
    level[head] = value[0] + (count_s[head] - at[0]) * (value[1] - value[0]) / (at[1] - at[0])
    last = (value[-1] - value[-2]) / (at[-1] - at[-2])
    level[tail] = value[-1] + (count_s[tail] - at[-1]) * last
    return level


def _without_overlap(start_s: FloatArray, length_s: FloatArray) -> NDArray[np.bool_]:
    """False for blocks that begin well before the last kept one has ended."""
    kept = np.ones(len(start_s), dtype=bool)
    if len(start_s) < 2 or np.all(start_s[1:] >= start_s[:-1] + 0.5 * length_s[:-1]):
        return kept
    end = -np.inf
    for i, (start, length) in enumerate(zip(start_s.tolist(), length_s.tolist(), strict=True)):
        if start < end - max(0.5 * length, 0.0) or start + length <= end:
            kept[i] = False
        else:
            end = start + length
    return kept


def _continuing(begins: NDArray[np.bool_], in_order: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether a block follows the kept one before it in the same stretch."""
    continues = ~begins
    continues[1:] &= in_order[:-1]
    continues[:1] = False
    return continues


def _gaps(
    start_s: FloatArray, length_s: FloatArray, begins: NDArray[np.bool_]
) -> tuple[int, float]:
    """How many stretches follow the first, and the time between them."""
    missing = start_s[1:] - (start_s[:-1] + length_s[:-1])
    new = begins[1:]
    return int(np.count_nonzero(new)), float(np.sum(np.clip(missing[new], 0.0, None)))
