"""Pictures over time: on which bearings it was loud, and how loud."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, Trajectory, wrapped_angle
from soundmap.outputs.figures import (
    BLUE,
    VERMILION,
    not_below,
    say_nothing_measured,
    shown_range,
    written,
)
from soundmap.outputs.floor import DOTS_PER_INCH, shortened
from soundmap.sound import AudioScans, decibels

WIDTH, HEIGHT = 7.4, 5.2
"""Size of the picture [inches]."""
AUDIO_COLUMNS = 1000


def audio_scan_figure(scans: AudioScans, trajectory: Trajectory, title: str) -> Figure:
    """Level on every bearing over time (Sect. 2.3), and below it the loudest and the mean."""
    figure = Figure(figsize=(WIDTH, HEIGHT), dpi=DOTS_PER_INCH)
    FigureCanvasAgg(figure)
    upper = figure.add_axes((0.13, 0.45, 0.71, 0.48))
    lower = figure.add_axes((0.13, 0.15, 0.71, 0.26), sharex=upper)
    figure.text(
        0.48,
        0.985,
        shortened(title, 75),
        ha="center",
        va="top",
        fontsize=11,
        parse_math=False,
    )
    upper.set_ylabel("bearing in the array's frame [°]")
    upper.set_ylim(-180.0, 180.0)
    upper.set_yticks(np.arange(-180, 181, 90))
    upper.tick_params(labelbottom=False)
    lower.set_ylabel(f"[{written(scans)}]")
    lower.set_xlabel("time since the first audio scan [s]")
    if len(scans) == 0:
        for axes in (upper, lower):
            axes.set_xticks([])
            axes.set_yticks([])
            say_nothing_measured(axes)
        return figure
    total_s, power = _columns_in_time(scans)
    _draw_bearings(figure, upper, scans, total_s, power)
    _draw_levels(lower, total_s, power)
    _shade(lower, unlocalized(trajectory, scans), "robot not localized")
    lower.set_xlim(0.0, total_s)
    lower.grid(color="0.9", linewidth=0.6)
    handles, labels = lower.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="lower center", ncols=3, frameon=False, fontsize=9, borderaxespad=0.45
    )
    return figure


def unlocalized(trajectory: Trajectory, scans: AudioScans) -> list[tuple[float, float]]:
    """Spans of time without a trusted pose, from the first audio scan on [s].

    Examples
    --------
    >>> from soundmap.sound import LevelReference
    >>> time_ns = np.arange(4) * 1_000_000_000
    >>> track = Trajectory(time_ns, np.zeros((4, 3)), np.array([True, False, True, True]))
    >>> scans = AudioScans(time_ns, np.zeros(1), np.zeros((4, 1), "f4"), LevelReference.FULL_SCALE)
    >>> unlocalized(track, scans)
    [(0.0, 2.0)]
    """
    if len(scans) == 0:
        return []
    lost: NDArray[np.bool_] = ~trajectory.usable
    edges = np.diff(np.concatenate([[0], lost.astype(np.int8), [0]]))
    since = (trajectory.time_ns - scans.time_ns[0]) * 1e-9
    spans = []
    for start, end in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
        first, last = since[max(start - 1, 0)], since[min(end, len(since) - 1)]
        spans.append((float(first), float(last)))
    return spans


def _draw_bearings(
    figure: Figure, axes: Axes, scans: AudioScans, total_s: float, power: FloatArray
) -> None:
    angle = np.degrees(wrapped_angle(scans.bearing_rad))
    order = np.argsort(angle, kind="stable")
    level = decibels(power[:, order]).T
    low, high = shown_range(level)
    half = 180.0 / len(angle)
    image = axes.imshow(
        not_below(level, low),
        origin="lower",
        aspect="auto",
        extent=(0.0, total_s, angle[order[0]] - half, angle[order[-1]] + half),
        cmap="viridis",
        vmin=low,
        vmax=high,
        interpolation="nearest",
    )
    bar = figure.add_axes((0.855, 0.45, 0.022, 0.48))
    figure.colorbar(image, cax=bar, label=f"power [{written(scans)}]")


def _draw_levels(axes: Axes, total_s: float, power: FloatArray) -> None:
    """The loudest bearing and the mean over all; lines break at gaps, lone scans are dots."""
    middle = (np.arange(len(power)) + 0.5) * total_s / len(power)
    marker = "." if len(power) < 100 else None
    style: dict[str, Any] = {"linewidth": 1.2, "marker": marker, "markersize": 3.0}
    loudest, mean = power.max(axis=1), power.mean(axis=1)
    axes.plot(middle, decibels(loudest), color=VERMILION, label="loudest bearing", **style)
    axes.plot(middle, decibels(mean), color=BLUE, label="mean of all bearings", **style)


def _shade(axes: Axes, spans: list[tuple[float, float]], label: str) -> None:
    for number, (start, end) in enumerate(spans):
        axes.axvspan(start, end, color="0.85", label=label if number == 0 else None)


def _columns_in_time(scans: AudioScans) -> tuple[float, FloatArray]:
    """Total time [s] and mean power in equal steps of it, shape (steps, N); NaN in gaps."""
    since = (scans.time_ns - scans.time_ns[0]) * 1e-9
    typical = float(np.median(np.diff(since))) if len(scans) > 1 else 0.1
    total = float(since[-1]) + typical
    steps = int(np.clip(round(total / typical), 1, AUDIO_COLUMNS))
    column = np.minimum((since / total * steps + 1e-6).astype(np.int64), steps - 1)
    power = np.full((steps, len(scans.bearing_rad)), np.nan)
    starts = np.flatnonzero(np.diff(column, prepend=-1))
    counts = np.diff(starts, append=len(column))
    sums = np.add.reduceat(scans.power.astype(np.float64), starts, axis=0)
    power[column[starts]] = sums / counts[:, None]
    return total, power
