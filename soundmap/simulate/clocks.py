"""Clocks: when a sensor measures, what it stamps, and when that reaches the log."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray
from soundmap.simulate.scene import Clock


def measurement_times(
    duration_s: float, interval_s: float, *, drift_ppm: float, first_s: float = 0.0
) -> FloatArray:
    """True times [s] at which a sensor with a drifting clock begins each measurement.

    Measurements end by ``duration_s``.
    """
    interval = interval_s / (1.0 + 1e-6 * drift_ppm)
    count = int(np.floor((duration_s - first_s) / interval + 1e-9))
    return np.asarray(first_s + interval * np.arange(max(count, 0)))


def stamps_ns(
    time_s: FloatArray, clock: Clock, start_ns: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Stamps [ns since epoch] that a sensor gives to true times [s], never running backward."""
    stamped = time_s + clock.offset_s + clock.jitter_s * rng.standard_normal(len(time_s))
    stamps = start_ns + np.rint(stamped * 1e9).astype(np.int64)
    return np.maximum.accumulate(stamps) if len(stamps) else stamps


def arrivals_ns(
    end_s: FloatArray, clock: Clock, start_ns: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """When measurements that end at true times [s] are logged [ns since epoch], in order."""
    delay = clock.latency_s + clock.latency_jitter_s * rng.standard_exponential(len(end_s))
    arrivals = start_ns + np.rint((end_s + delay) * 1e9).astype(np.int64)
    return np.maximum.accumulate(arrivals) if len(arrivals) else arrivals


def kept(time_s: FloatArray, clock: Clock) -> NDArray[np.bool_]:
    """Which measurements at true times [s] fall in no gap."""
    keep = np.ones(len(time_s), dtype=bool)
    for gap in clock.gaps:
        keep &= ~((time_s >= gap.start_s) & (time_s < gap.start_s + gap.duration_s))
    return keep
