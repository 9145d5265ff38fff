"""Pictures of places: what a person looks at first. Figs. 2, 6 and 7 of the paper."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from soundmap.change import Change, ChangeKind, PowerRatio
from soundmap.geometry import FloatArray, Trajectory
from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.outputs.area import area_of_interest
from soundmap.outputs.floor import DOUBTFUL, FOUND, FloorPlan, Mark, Places
from soundmap.run import Run
from soundmap.sound import PowerMap, SourceList, decibels

# Okabe and Ito's colours, told apart with any kind of colour vision.
BLUE, VERMILION, GREEN = "#0072B2", "#D55E00", "#009E73"
SHOWN_RANGE_DB = 30.0
LEAST_RATIO_DB, GREATEST_RATIO_DB = 3.0, 20.0
SURE, PALE = 0.01, 0.3
"""A cell whose difference is less probable than this by chance has its full colour; others have
this opacity."""
ARROWS = 10
CHANGED = {
    ChangeKind.APPEARED: Mark("appeared", marker="P", size=12.0),
    ChangeKind.LOUDER: Mark("louder", marker="^", size=12.0),
    ChangeKind.QUIETER: Mark("quieter", marker="v", size=12.0),
    ChangeKind.GONE: Mark("gone", marker="X", size=12.0),
    ChangeKind.UNCHANGED: Mark("unchanged", colour="0.35", size=10.0),
    ChangeKind.UNTOLD: Mark("cannot be told", marker="s", colour="0.35", size=9.0),
}


def trajectory_figure(run: Run) -> Figure:
    """Fig. 2: geometric map, way of the robot, sources."""
    title = f"{run.log.stem}: geometric map and trajectory"
    return map_figure(run.room, run.trajectory, title, sources=run.sources)


def map_figure(
    room: OccupancyGrid, trajectory: Trajectory, title: str, *, sources: SourceList | None = None
) -> Figure:
    """Fig. 2: geometric map and way of the robot, with sources if there are any."""
    places = [(source.x_m, source.y_m) for source in sources or ()]
    area = area_of_interest([trajectory.pose[:, :2], _points(places)], room)
    plan = FloorPlan(area, room, title)
    _draw_trajectory(plan.axes, trajectory)
    if sources is not None:
        _draw_sources(plan, sources)
    return plan.finished()


def power_map_figure(run: Run, *, truth: Places = ()) -> Figure:
    """Fig. 6: power map in dB over the geometric map, with its local maxima.

    Parameters
    ----------
    run : Run
    truth : sequence of tuple
        Where the sources truly are, if known: x, y [m].
    """
    power_map, share = run.power_map, run.config.detect.min_visit_share
    level = decibels(power_map.power(min_visit_share=share))
    places = [(source.x_m, source.y_m) for source in run.sources]
    seen = [_measured_points(level, power_map.frame), run.trajectory.pose[:, :2]]
    area = area_of_interest([*seen, _points(places), _points(truth)], run.room)
    found = "" if places else " (no source found)"
    plan = FloorPlan(area, run.room, f"{run.log.stem}: power map{found}")
    low, high = shown_range(level)
    part, extent = plan.blocks(not_below(level, low), power_map.frame, _greatest)
    image = plan.axes.imshow(
        part,
        origin="lower",
        extent=extent,
        alpha=_opacity_of_limits(plan, power_map),
        cmap="viridis",
        vmin=low,
        vmax=high,
        interpolation="nearest",
    )
    if np.isnan(level).all():
        say_nothing_measured(plan.axes)
    else:
        what = "mean emitted power" if power_map.is_limit is None else "power at 1 m"
        label = f"{what}{_blocks(plan, power_map.frame)} [{written(power_map)}]"
        plan.add_colour_bar(image, label, "min" if np.any(level < low) else "neither")
    plan.draw_wall_outlines()
    if power_map.is_limit is not None:
        pale = image.to_rgba(np.array([0.5 * (low + high)]), alpha=PALE)[0]
        plan.axes.plot([], [], "s", color=pale, label="pale: at most so loud")
    plan.axes.plot(*run.trajectory.pose[:, :2].T, color="0.45", linewidth=0.8, label="trajectory")
    _draw_sources(plan, run.sources)
    plan.draw_truth(truth)
    return plan.finished()


def power_ratio_figure(ratio: PowerRatio, *, room: OccupancyGrid | None, title: str) -> Figure:
    """Fig. 7: difference of two power maps in dB; red is louder than the background.

    Cells whose difference chance would often show are pale.
    """
    level = ratio.ratio_db
    places = [(change.x_m, change.y_m) for change in ratio.changes]
    area = area_of_interest([_measured_points(level, ratio.frame), _points(places)], room)
    plan = FloorPlan(area, room, f"{title}: difference of power maps", dimmed=True)
    ratios = np.array([change.ratio_db for change in ratio.changes])
    shown = np.abs(np.concatenate([level.ravel(), ratios]))
    finite = shown[np.isfinite(shown)]
    reach = float(np.clip(finite.max(initial=0.0), LEAST_RATIO_DB, GREATEST_RATIO_DB))
    part, extent = plan.blocks(level, ratio.frame, _farthest_from_zero)
    image = plan.axes.imshow(
        np.clip(part.astype(np.float64), -reach, reach),
        origin="lower",
        extent=extent,
        alpha=_opacity(plan, ratio),
        cmap="RdBu_r",
        vmin=-reach,
        vmax=reach,
        interpolation="nearest",
    )
    if np.isnan(level).all():
        say_nothing_measured(plan.axes)
    else:
        every = np.concatenate([level.ravel(), ratios])
        plan.add_colour_bar(image, "louder than the background by [dB]", _open_ends(every, reach))
    without = np.argwhere(np.isfinite(level) & ~ratio.background_measured)
    if len(without):
        plan.axes.plot(
            *ratio.frame.centres(without).T,
            linestyle="none",
            marker=".",
            markersize=2.0,
            color="black",
            label="against the background's median",
        )
    plan.draw_wall_outlines()
    fills = image.to_rgba(ratios)
    if ratio.chance is not None:
        fills[[not _is_sure(change) for change in ratio.changes], 3] = PALE
    plan.draw_places(places, [CHANGED[change.kind] for change in ratio.changes], list(fills))
    return plan.finished()


def _draw_sources(plan: FloorPlan, sources: SourceList) -> None:
    """Sources with what is known of their places, and mirror images."""
    places = [(source.x_m, source.y_m) for source in sources]
    fitted = [source for source in sources if source.fit is not None]
    plan.draw_images([(image.x_m, image.y_m) for image in sources.reflections], places)
    plan.draw_ellipses(
        [(source.x_m, source.y_m) for source in fitted],
        [source.fit.covariance_m2 for source in fitted if source.fit is not None],
    )
    doubtful = [source.fit is not None and bool(source.fit.flags) for source in sources]
    plan.draw_places(places, [DOUBTFUL if doubt else FOUND for doubt in doubtful])


def _is_sure(change: Change) -> bool:
    chance = change.false_alarm_probability
    return chance is not None and chance < SURE


def _opacity_of_limits(plan: FloorPlan, power_map: PowerMap) -> FloatArray | None:
    """Of each square of a power map: pale where it only shows the most that can be there."""
    if power_map.is_limit is None:
        return None
    limit, _ = plan.blocks(power_map.is_limit, power_map.frame, np.min)
    return np.where(limit, PALE, 1.0)


def _opacity(plan: FloorPlan, ratio: PowerRatio) -> FloatArray | None:
    """Of each square of a difference: full where it is significant; None if nobody knows."""
    if ratio.chance is None:
        return None
    sure, _ = plan.blocks(ratio.chance < SURE, ratio.frame, np.max)
    return np.where(sure, 1.0, PALE)


def shown_range(level: FloatArray) -> tuple[float, float]:
    """Least and greatest level of the colours [dB]: all there is, within limits."""
    finite = level[np.isfinite(level)]
    if not len(finite):
        return -1.0, 0.0
    high = float(finite.max())
    return min(max(float(finite.min()), high - SHOWN_RANGE_DB), high - 1.0), high


def not_below(level: FloatArray, low: float) -> FloatArray:
    """Silent cells (-inf) drawn as the lowest colour; unmeasured ones (NaN) left out."""
    return np.where(np.isnan(level), np.nan, np.maximum(level, low))


def written(levels: Any) -> str:
    """The reference of the levels of a power map, of audio scans or of sources, in print."""
    return str(levels.reference).replace("^2", "²").replace("uPa", "µPa")


def say_nothing_measured(axes: Axes) -> None:
    """Words in the middle of an empty picture."""
    axes.text(
        0.5,
        0.5,
        "nothing measured",
        transform=axes.transAxes,
        ha="center",
        va="center",
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8},
    )


def _draw_trajectory(axes: Axes, trajectory: Trajectory) -> None:
    if len(trajectory) == 0:
        say_nothing_measured(axes)
        return
    points = trajectory.pose[:, :2]
    trusted = trajectory.usable[:-1] & trajectory.usable[1:]
    axes.add_collection(
        LineCollection(_stretches(points, trusted), colors=BLUE, linewidths=1.8, label="trajectory")
    )
    if not trusted.all() or not trajectory.usable.all():
        axes.add_collection(
            LineCollection(
                _stretches(points, ~trusted),
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
            arrowprops={"arrowstyle": "-|>", "color": BLUE, "mutation_scale": 14},
        )
    axes.plot(*points[0], "o", color=GREEN, markersize=8, linestyle="none", label="start")
    axes.plot(*points[-1], "s", color="black", markersize=7, linestyle="none", label="end")


def _stretches(points: FloatArray, wanted: Any) -> list[FloatArray]:
    """Unbroken parts of a way whose steps are wanted; ``wanted`` has one flag a step."""
    edges = np.diff(np.concatenate([[0], wanted.astype(np.int8), [0]]))
    starts, ends = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    return [points[start : end + 1] for start, end in zip(starts, ends, strict=True)]


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


def _greatest(values: FloatArray, axis: int) -> FloatArray:
    """The greatest along an axis; NaN only where all are."""
    return np.asarray(np.fmax.reduce(values, axis=axis))


def _farthest_from_zero(values: FloatArray, axis: int) -> FloatArray:
    """What differs most from zero along an axis; NaN only where all are."""
    high = np.asarray(np.fmax.reduce(values, axis=axis))
    low = np.asarray(np.fmin.reduce(values, axis=axis))
    return np.asarray(np.where(high >= -low, high, low))


def _blocks(plan: FloorPlan, frame: GridFrame) -> str:
    """How much one square of the picture stands for, if it is more than a cell."""
    edge = plan.block_m(frame)
    return "" if edge <= frame.resolution_m else f", greatest of each {edge:.3g} m"


def _open_ends(level: FloatArray, reach: float) -> str:
    above, below = bool(np.any(level > reach)), bool(np.any(level < -reach))
    return {(True, True): "both", (True, False): "max", (False, True): "min"}.get(
        (above, below), "neither"
    )


def _measured_points(level: FloatArray, frame: GridFrame) -> FloatArray:
    return frame.centres(np.argwhere(~np.isnan(level)))


def _points(places: Places) -> FloatArray:
    return np.array(places, dtype=np.float64).reshape(-1, 2)
