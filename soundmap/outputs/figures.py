"""Pictures of a run: what a person looks at first. Figs. 2, 6 and 7 of the paper."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from soundmap.geometry import FloatArray, Trajectory, wrapped_angle
from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.outputs.floor import (
    area_of_interest,
    cropped,
    draw_places,
    draw_wall_outlines,
    floor_plan,
)
from soundmap.run import Run
from soundmap.sound import AudioScans, LevelReference, PowerMap, PowerRatio, decibels

# Okabe and Ito's colours, told apart with any kind of colour vision.
BLUE, VERMILION, GREEN = "#0072B2", "#D55E00", "#009E73"
SHOWN_RANGE_DB = 30.0
LEAST_RATIO_DB, GREATEST_RATIO_DB = 3.0, 20.0
ARROWS = 10
DOTS_PER_INCH = 120
AUDIO_COLUMNS = 1200
BESIDE = (1.02, 0.0, 0.03, 1.0)
"""Place of a colour bar as tall as the axes, in their own coordinates."""


def trajectory_figure(run: Run) -> Figure:
    """Fig. 2: geometric map, way of the robot, sources."""
    trajectory = run.trajectory
    places = [(source.x_m, source.y_m) for source in run.sources]
    area = area_of_interest([trajectory.pose[:, :2], _points(places)], run.room)
    figure, axes = floor_plan(area, run.room, f"{run.log.stem}: geometric map and trajectory")
    _draw_trajectory(axes, trajectory)
    draw_places(axes, places, area)
    _add_legend(figure, axes)
    return figure


def power_map_figure(run: Run) -> Figure:
    """Fig. 6: power map in dB over the geometric map, with its local maxima."""
    power_map, share = run.power_map, run.config.detect.min_visit_share
    level = decibels(power_map.power(min_visit_share=share))
    places = [(source.x_m, source.y_m) for source in run.sources]
    area = area_of_interest(
        [_measured_points(level, power_map.frame), run.trajectory.pose[:, :2], _points(places)],
        run.room,
    )
    figure, axes = floor_plan(area, run.room, f"{run.log.stem}: power map")
    low, high = _shown_range(level)
    part, extent = cropped(_not_below(level, low), power_map.frame, area)
    image = axes.imshow(
        part,
        origin="lower",
        extent=extent,
        cmap="viridis",
        vmin=low,
        vmax=high,
        interpolation="nearest",
    )
    if np.isnan(level).all():
        _say_nothing_measured(axes)
    else:
        below = bool(np.any(level < low))
        figure.colorbar(
            image,
            cax=axes.inset_axes(BESIDE),
            label=f"mean emitted power [{_written(power_map)}]",
            extend="min" if below else "neither",
        )
    draw_wall_outlines(axes, run.room, area)
    axes.plot(*run.trajectory.pose[:, :2].T, color="0.45", linewidth=0.8, label="trajectory")
    draw_places(axes, places, area)
    _add_legend(figure, axes)
    return figure


def power_ratio_figure(ratio: PowerRatio, *, room: OccupancyGrid | None, title: str) -> Figure:
    """Fig. 7: difference of two power maps in dB; red is louder than the background."""
    level = ratio.ratio_db
    places = [(change.x_m, change.y_m) for change in ratio.changes]
    area = area_of_interest([_measured_points(level, ratio.frame), _points(places)], room)
    figure, axes = floor_plan(area, room, f"{title}: difference of power maps", dimmed=True)
    finite = np.abs(level[np.isfinite(level)])
    reach = float(np.clip(finite.max(initial=0.0), LEAST_RATIO_DB, GREATEST_RATIO_DB))
    part, extent = cropped(level, ratio.frame, area)
    image = axes.imshow(
        np.clip(part.astype(np.float64), -reach, reach),
        origin="lower",
        extent=extent,
        cmap="RdBu_r",
        vmin=-reach,
        vmax=reach,
        interpolation="nearest",
    )
    if np.isnan(level).all():
        _say_nothing_measured(axes)
    else:
        bar = figure.colorbar(image, cax=axes.inset_axes(BESIDE), extend=_open_ends(level, reach))
        bar.set_label("power of the run over that of the background [dB]")
    without = np.argwhere(np.isfinite(level) & ~ratio.background_measured)
    if len(without):
        axes.plot(
            *ratio.frame.centres(without).T,
            linestyle="none",
            marker=".",
            markersize=2.0,
            color="black",
            label="not measured in the background: against its median",
        )
    if room is not None:
        draw_wall_outlines(axes, room, area)
    draw_places(axes, places, area)
    _add_legend(figure, axes)
    return figure


def audio_scan_figure(run: Run) -> Figure:
    """Level on every bearing over time, as the array heard it (Sect. 2.3)."""
    scans = run.scans
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_xlabel("time since the first audio scan [s]")
    axes.set_ylabel("bearing in the array's frame [degrees]")
    axes.set_title(f"{run.log.stem}: audio scans", parse_math=False)
    axes.set_ylim(-180.0, 180.0)
    axes.set_yticks(np.arange(-180, 181, 45))
    if len(scans) == 0:
        _say_nothing_measured(axes)
    else:
        times_s, power = _columns_in_time(scans)
        angle = np.degrees(wrapped_angle(scans.bearing_rad))
        order = np.argsort(angle, kind="stable")
        level = decibels(power[:, order]).T
        low, high = _shown_range(level)
        half = 180.0 / len(angle)
        image = axes.imshow(
            _not_below(level, low),
            origin="lower",
            aspect="auto",
            extent=(0.0, times_s, angle[order[0]] - half, angle[order[-1]] + half),
            cmap="viridis",
            vmin=low,
            vmax=high,
            interpolation="nearest",
        )
        figure.colorbar(image, ax=axes, label=f"power [{_written(scans)}]")
    return figure


def write_png(figure: Figure, file: Path) -> None:
    """Write a picture; equal pictures give equal bytes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a log's name may hold letters that the font lacks
        figure.savefig(file, format="png", dpi=DOTS_PER_INCH, bbox_inches="tight")


def _draw_trajectory(axes: Axes, trajectory: Trajectory) -> None:
    if len(trajectory) == 0:
        _say_nothing_measured(axes)
        return
    points = trajectory.pose[:, :2]
    pieces = np.stack([points[:-1], points[1:]], axis=1)
    sound = trajectory.usable[:-1] & trajectory.usable[1:]
    axes.add_collection(
        LineCollection(list(pieces[sound]), colors=BLUE, linewidths=1.8, label="trajectory")
    )
    if not sound.all() or not trajectory.usable.all():
        axes.add_collection(
            LineCollection(
                list(pieces[~sound]),
                colors=VERMILION,
                linewidths=3.5,
                capstyle="round",
                label="not to be trusted",
            )
        )
    for tail, tip in _direction_arrows(points):
        axes.annotate(
            "",
            xy=tuple(tip),
            xytext=tuple(tail),
            arrowprops={"arrowstyle": "-|>", "color": BLUE, "mutation_scale": 16},
        )
    axes.plot(*points[0], "o", color=GREEN, markersize=9, linestyle="none", label="start")
    axes.plot(*points[-1], "s", color="black", markersize=8, linestyle="none", label="end")


def _direction_arrows(points: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Tail and tip of arrows along a way, evenly spread over its length; none on a short one."""
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    count = min(ARROWS, int(length[-1] / 0.5))
    arrows = []
    for wanted in (np.arange(count) + 0.5) / max(count, 1) * length[-1]:
        tip = np.array([np.interp(wanted, length, points[:, axis]) for axis in (0, 1)])
        tail = np.array([np.interp(wanted - 0.05, length, points[:, axis]) for axis in (0, 1)])
        arrows.append((tail, tip))
    return arrows


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


def _shown_range(level: FloatArray) -> tuple[float, float]:
    """Least and greatest level of the colours [dB]: all there is, within limits."""
    finite = level[np.isfinite(level)]
    if not len(finite):
        return -1.0, 0.0
    high = float(finite.max())
    return min(max(float(finite.min()), high - SHOWN_RANGE_DB), high - 1.0), high


def _not_below(level: FloatArray, low: float) -> FloatArray:
    """Silent cells (-inf) drawn as the lowest colour; unmeasured ones (NaN) left out."""
    return np.where(np.isnan(level), np.nan, np.maximum(level, low))


def _open_ends(level: FloatArray, reach: float) -> Any:
    above, below = bool(np.any(level > reach)), bool(np.any(level < -reach))
    return {(True, True): "both", (True, False): "max", (False, True): "min"}.get(
        (above, below), "neither"
    )


def _measured_points(level: FloatArray, frame: GridFrame) -> FloatArray:
    return frame.centres(np.argwhere(~np.isnan(level)))


def _points(places: list[tuple[float, float]]) -> FloatArray:
    return np.array(places, dtype=np.float64).reshape(-1, 2)


def _written(levels: PowerMap | AudioScans) -> str:
    reference: LevelReference = levels.reference
    return str(reference).replace("^2", "²").replace("uPa", "µPa")


def _say_nothing_measured(axes: Axes) -> None:
    axes.text(0.5, 0.5, "nothing measured", transform=axes.transAxes, ha="center", va="center")


def _add_legend(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False)
