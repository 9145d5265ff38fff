"""A run as a Rerun recording: the way it unfolded in time, and what came of it.

What came of the run is static, so it is seen whatever the time cursor;
what happened lies on the log's own time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType

import numpy as np
import rerun as rr
from numpy.typing import ArrayLike, NDArray

from soundmap.change import ChangeKind
from soundmap.geometry import FloatArray
from soundmap.grid import GridFrame
from soundmap.outputs.area import Area, area_of_interest, cropped
from soundmap.outputs.figures import PALE, SURE, not_below, shown_range
from soundmap.outputs.markdown import difference_markdown, run_markdown
from soundmap.outputs.piped import piped
from soundmap.outputs.recording_layout import difference_layout, run_layout
from soundmap.outputs.recording_shapes import (
    BLUE,
    DARK,
    GREEN,
    GREY,
    LINE_Z,
    POWER_Z,
    PURPLE,
    VERMILION,
    as_points,
    circle,
    coloured,
    draw_ellipses,
    draw_floor,
    draw_images,
    draw_places,
    draw_robot,
    floor_picture,
    raised,
)
from soundmap.outputs.report import change_rows, source_rows
from soundmap.outputs.stored_run import StoredDifference
from soundmap.outputs.wording import (
    flags_text,
    level_text,
    ratio_text,
)
from soundmap.run import Run
from soundmap.sound import PowerMap, decibels

APPLICATION = "soundmap"
TIMELINE = "time"
SCANNER_COLOURS = MappingProxyType({0: (86, 180, 233), 1: (230, 159, 0), 2: (204, 121, 167)})
LEAST_LOBE_M, GREATEST_LOBE_M = 0.25, 1.0
"""Radius at which the polar curve of an audio scan shows the quietest and the loudest level."""
TRAJECTORY_STEPS, TRAJECTORY_POINTS = 200, 400
ROWS_A_BATCH = 256
ELLIPSE_SIGMAS = 2.0


@contextmanager
def recording(file: Path, blueprint: rr.blueprint.Blueprint) -> Iterator[rr.RecordingStream]:
    """A stream whose content becomes a complete file, whatever happens in between.

    It is piped there because a stream that meets a full disk itself waits for ever.
    """
    stream = rr.RecordingStream(APPLICATION)
    with piped(file) as name:
        stream.save(name)
        stream.send_blueprint(blueprint, make_active=False, make_default=True)
        try:
            stream.log("/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            yield stream
        finally:
            stream.flush()
            stream.disconnect()


class RunRecording:
    """What a run yields, drawn into a stream; what the log tells is added as it comes.

    Parameters
    ----------
    stream : rerun.RecordingStream
    run : Run
    """

    def __init__(self, stream: rr.RecordingStream, run: Run) -> None:
        self._stream, self._run = stream, run
        self._lasers: dict[int, list[tuple[int, FloatArray]]] = {}
        self._hits: list[tuple[int, FloatArray, FloatArray]] = []
        self._matches: list[tuple[int, float]] = []
        share = run.config.detect.min_visit_share
        self._level = decibels(run.power_map.power(min_visit_share=share))
        self._low, self._high = shown_range(self._level)
        measured = run.power_map.frame.centres(np.argwhere(run.power_map.visits > 0))
        self._measured = _bounding_area(measured, run.power_map.frame)
        draw_floor(stream, run.room)
        self._draw_results()
        self._draw_trajectory()
        self._draw_scans()
        stream.log(
            "/summary", rr.TextDocument(run_markdown(run), media_type="text/markdown"), static=True
        )

    def add_laser(self, time_ns: int, scanner: int, points_m: FloatArray, match: float) -> None:
        """Points of a laser scan in the map frame, shape (P, 2), and the share on its walls."""
        waiting = self._lasers.setdefault(scanner, [])
        waiting.append((time_ns, points_m))
        self._matches.append((time_ns, match))
        if len(waiting) >= ROWS_A_BATCH:
            self._send_lasers(scanner)

    def add_hit(self, time_ns: int, array_m: FloatArray, point_m: FloatArray) -> None:
        """The bearing chosen: from the array to the surface it meets, x, y in the map frame [m]."""
        self._hits.append((time_ns, array_m, point_m))
        if len(self._hits) >= ROWS_A_BATCH:
            self._send_hits()

    def add_power_map(self, time_ns: int, power_map: PowerMap) -> None:
        """The power map as it was at a time; every cell measured so far."""
        level = decibels(power_map.power())
        self._send_grid("/world/run/power", level, power_map, time_ns)

    @property
    def power_map_bytes(self) -> int:
        """Size of the power map at one time, before compression."""
        part, _ = cropped(self._level, self._run.power_map.frame, self._measured)
        return 4 * part.size

    def finish(self) -> None:
        """Send what is still waiting."""
        for scanner in sorted(self._lasers):
            self._send_lasers(scanner)
        self._send_hits()
        if self._matches:
            time_ns, match = zip(*self._matches, strict=True)
            self._send_series("/plots/pose/laser_points_on_walls", time_ns, match, BLUE)

    def _draw_results(self) -> None:
        run, stream = self._run, self._stream
        self._send_grid("/world/result/power", self._level, run.power_map, None)
        rows = source_rows(run.sources)
        places = [(source.x_m, source.y_m) for source in run.sources]
        labels = [f"{row['id']}  {level_text(row)} dB" for row in rows]
        remarks = map(flags_text, rows)
        labels = [
            f"{label} ({remark})" if remark else label
            for label, remark in zip(labels, remarks, strict=True)
        ]
        draw_places(stream, places, labels, [VERMILION] * len(places))
        draw_ellipses(stream, run.sources)
        draw_images(stream, run.sources)

    def _draw_trajectory(self) -> None:
        trajectory, stream = self._run.trajectory, self._stream
        if len(trajectory) == 0:
            return
        points = raised(trajectory.pose[:, :2], LINE_Z)
        for name, wanted, colour in (
            ("trajectory", trajectory.usable, BLUE),
            ("trajectory_not_to_be_trusted", ~trajectory.usable, VERMILION),
        ):
            strips = [points[piece] for piece in _stretches(wanted)]
            if strips:
                lines = rr.LineStrips3D(strips, colors=[colour], radii=rr.Radius.ui_points(1.5))
                stream.log(f"/world/result/{name}", lines, static=True)
        self._send_way_so_far(points)
        time_ns = trajectory.time_ns
        half = trajectory.pose[:, 2] / 2.0
        zero = np.zeros_like(half)
        turn = np.stack([zero, zero, np.sin(half), np.cos(half)], axis=-1)
        at = raised(trajectory.pose[:, :2], 0.0)
        columns = rr.Transform3D.columns(translation=at, quaternion=turn)
        self._send("/world/robot", time_ns, columns)
        draw_robot(stream)
        trusted = trajectory.usable.astype(np.float64)
        self._send_series("/plots/pose/trusted", time_ns, trusted, GREEN)
        self._draw_uncertainty()

    def _draw_uncertainty(self) -> None:
        """The ellipse that holds the robot's place with two standard deviations."""
        trajectory = self._run.trajectory
        covariance = trajectory.covariance
        if covariance is None:
            return
        values, axes = np.linalg.eigh(covariance[:, :2, :2])
        reach = ELLIPSE_SIGMAS * np.sqrt(np.maximum(values, 0.0))

        def ellipses(some: slice) -> FloatArray:
            own = (circle(1.0)[:, :2] * reach[some, None, :]) @ np.swapaxes(axes[some], 1, 2)
            return raised(own + trajectory.pose[some, None, :2], LINE_Z)

        self._send_curves("/world/run/pose_uncertainty", trajectory.time_ns, ellipses, GREEN)
        spread = np.sqrt(np.maximum(values.sum(axis=1), 0.0))
        self._send_series("/plots/pose/spread_m", trajectory.time_ns, spread, VERMILION)

    def _send_way_so_far(self, points: FloatArray) -> None:
        """The way driven up to a time, at a limited number of times and points."""
        count = len(points)
        steps = np.unique(np.linspace(0, count - 1, min(count, TRAJECTORY_STEPS)).astype(int))
        stride = max(1, count // TRAJECTORY_POINTS)
        strips = [np.vstack([points[:step:stride], points[step]]) for step in steps if step > 0]
        if not strips:
            return
        columns = rr.LineStrips3D.columns(strips=strips)
        self._send("/world/run/trajectory", self._run.trajectory.time_ns[steps[steps > 0]], columns)
        style = rr.LineStrips3D.from_fields(colors=[BLUE], radii=rr.Radius.ui_points(2.0))
        self._stream.log("/world/run/trajectory", style, static=True)

    def _draw_scans(self) -> None:
        scans = self._run.scans
        if len(scans) == 0:
            return
        loudest, mean = decibels(scans.power.max(axis=1)), decibels(scans.power.mean(axis=1))
        for name, values, colour in (
            ("loudest_bearing", loudest, VERMILION),
            ("mean_of_all_bearings", mean, BLUE),
        ):
            time_ns, shown = _broken_at_gaps(scans.time_ns, np.asarray(values, dtype=np.float64))
            self._send_series(f"/plots/level/{name}", time_ns, shown, colour)
        mount = scans.mount
        if mount is None:
            return
        sounding = (scans.power > 0.0) & np.isfinite(scans.power)
        extremes = [np.min(scans.power, where=sounding, initial=np.inf)]
        extremes += [np.max(scans.power, where=sounding, initial=0.0)]
        low, high = shown_range(decibels(np.array(extremes, dtype=np.float64)))
        bearing = mount.base_bearing(scans.bearing_rad)
        towards = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)

        def curves(some: slice) -> FloatArray:
            level = decibels(scans.power[some].astype(np.float64))
            share = (np.maximum(level, low) - low) / (high - low)
            radius = LEAST_LOBE_M + (GREATEST_LOBE_M - LEAST_LOBE_M) * share
            around = mount.translation_m[:2] + radius[:, :, None] * towards
            around = np.concatenate([around, around[:, :1]], axis=1)
            return raised(around, float(mount.translation_m[2]))

        self._send_curves("/world/robot/audio_scan", scans.time_ns, curves, PURPLE)

    def _send_lasers(self, scanner: int) -> None:
        waiting, self._lasers[scanner] = self._lasers[scanner], []
        if not waiting:
            return
        time_ns = [time for time, _ in waiting]
        counts = [len(points) for _, points in waiting]
        points = raised(np.concatenate([points for _, points in waiting]), 2.0 * LINE_Z)
        columns = rr.Points3D.columns(positions=points).partition(counts)
        name = f"/world/run/laser_{scanner + 1}"
        self._send(name, time_ns, columns)
        colour = SCANNER_COLOURS[scanner % len(SCANNER_COLOURS)]
        style = rr.Points3D.from_fields(colors=[colour], radii=rr.Radius.ui_points(1.5))
        self._stream.log(name, style, static=True)

    def _send_hits(self) -> None:
        hits, self._hits = self._hits, []
        if not hits:
            return
        time_ns = [time for time, _, _ in hits]
        ends = raised(np.array([pair[1:] for pair in hits]), 3.0 * LINE_Z)
        self._send_curves("/world/run/chosen_bearing", time_ns, lambda some: ends[some], DARK)
        columns = rr.Points3D.columns(positions=ends[:, 1])
        self._send("/world/run/laser_hit", time_ns, columns.partition([1] * len(ends)))
        style = rr.Points3D.from_fields(colors=[VERMILION], radii=rr.Radius.ui_points(6.0))
        self._stream.log("/world/run/laser_hit", style, static=True)

    def _send_grid(
        self, name: str, level: FloatArray, power_map: PowerMap, time_ns: int | None
    ) -> None:
        frame = power_map.frame
        part, (left, _, bottom, _) = cropped(level, frame, self._measured)
        share = (not_below(part.astype(np.float64), self._low) - self._low) / (
            self._high - self._low
        )
        rgba = coloured(np.clip(share, 0.0, 1.0), "viridis")
        if power_map.is_limit is not None:
            limit, _ = cropped(power_map.is_limit, frame, self._measured)
            rgba[..., 3] = np.where(limit, PALE * rgba[..., 3], rgba[..., 3])
        grid = floor_picture(rgba, frame.resolution_m, (left, bottom), POWER_Z)
        if time_ns is None:
            self._stream.log(name, grid, static=True)
        else:
            self._stream.set_time(TIMELINE, timestamp=np.datetime64(time_ns, "ns"))
            self._stream.log(name, grid)
            self._stream.reset_time()

    def _send_curves(
        self,
        name: str,
        time_ns: ArrayLike,
        curves: Callable[[slice], FloatArray],
        colour: tuple[int, int, int],
    ) -> None:
        """One line a time; those of some times have the shape (times, points, 3)."""
        times = np.asarray(time_ns, dtype=np.int64)
        for start in range(0, len(times), ROWS_A_BATCH):
            some = slice(start, start + ROWS_A_BATCH)
            self._send(name, times[some], rr.LineStrips3D.columns(strips=list(curves(some))))
        style = rr.LineStrips3D.from_fields(colors=[colour], radii=rr.Radius.ui_points(1.5))
        self._stream.log(name, style, static=True)

    def _send_series(
        self, name: str, time_ns: ArrayLike, values: ArrayLike, colour: tuple[int, int, int]
    ) -> None:
        self._send(name, time_ns, rr.Scalars.columns(scalars=np.asarray(values, np.float64)))
        style = rr.SeriesLines(
            colors=[colour], names=[name.rsplit("/", 1)[1].replace("_", " ")], widths=[1.5]
        )
        self._stream.log(name, style, static=True)

    def _send(self, name: str, time_ns: ArrayLike, columns: rr.ComponentColumnList) -> None:
        times = np.asarray(time_ns, dtype=np.int64).astype("datetime64[ns]")
        self._stream.send_columns(name, [rr.TimeColumn(TIMELINE, timestamp=times)], columns)
        self._stream.flush()  # or all that is sent would wait in memory


@contextmanager
def run_recording(run: Run, file: Path) -> Iterator[RunRecording]:
    """A file with everything about a run; what the log tells is added in the ``with`` block."""
    seen = [run.trajectory.pose[:, :2], as_points([(s.x_m, s.y_m) for s in run.sources])]
    with recording(file, run_layout(area_of_interest(seen, run.room))) as stream:
        drawn = RunRecording(stream, run)
        yield drawn
        drawn.finish()


def write_difference_recording(difference: StoredDifference, file: Path) -> None:
    """A file with the difference of two runs on the map."""
    ratio = difference.ratio
    places = [(change.x_m, change.y_m) for change in ratio.changes]
    measured = ratio.frame.centres(np.argwhere(~np.isnan(ratio.ratio_db)))
    area = area_of_interest([measured, as_points(places)], difference.room)
    with recording(file, difference_layout(area)) as stream:
        if difference.room is not None:
            draw_floor(stream, difference.room)
        reach = float(np.clip(np.nanmax(np.abs(ratio.ratio_db), initial=0.0), 3.0, 20.0))
        shown = _bounding_area(measured, ratio.frame)
        part, (left, _, bottom, _) = cropped(ratio.ratio_db, ratio.frame, shown)
        share = np.clip(part.astype(np.float64) / (2.0 * reach) + 0.5, 0.0, 1.0)
        rgba = coloured(share, "RdBu_r")
        if ratio.chance is not None:
            sure, _ = cropped(ratio.chance < SURE, ratio.frame, shown)
            rgba[~sure.astype(bool), 3] = (PALE * rgba[~sure.astype(bool), 3]).astype(np.uint8)
        grid = floor_picture(rgba, ratio.frame.resolution_m, (left, bottom), POWER_Z)
        stream.log("/world/result/power_ratio", grid, static=True)
        labels = [
            f"{row['id']}  {row['kind']}"
            + ("" if change.kind == ChangeKind.UNTOLD else f"  {ratio_text(row)} dB")
            for row, change in zip(change_rows(ratio.changes), ratio.changes, strict=True)
        ]
        draw_places(stream, places, labels, [_change_colour(c.kind) for c in ratio.changes])
        text = difference_markdown(difference)
        stream.log("/summary", rr.TextDocument(text, media_type="text/markdown"), static=True)


def _change_colour(kind: ChangeKind) -> tuple[int, int, int]:
    return VERMILION if kind.is_louder else BLUE if kind.is_quieter else GREY


def _stretches(wanted: NDArray[np.bool_]) -> list[slice]:
    """Unbroken parts of a way between poses that are all wanted; a lone pose makes none."""
    edges = np.diff(np.concatenate([[0], wanted.astype(np.int8), [0]]))
    starts, ends = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    return [slice(s, e) for s, e in zip(starts, ends, strict=True) if e - s > 1]


def _broken_at_gaps(
    time_ns: NDArray[np.int64], values: FloatArray
) -> tuple[NDArray[np.int64], FloatArray]:
    """A NaN after each scan that is followed by a gap, so that no line is drawn over it."""
    if len(time_ns) < 3:
        return time_ns, values
    step = np.diff(time_ns)
    before = np.flatnonzero(step > 3 * np.median(step)) + 1
    return (
        np.insert(time_ns, before, time_ns[before - 1] + 1),
        np.insert(values, before, np.nan),
    )


def _bounding_area(points: FloatArray, frame: GridFrame) -> Area:
    """The rectangle round points, one cell wide at least."""
    if len(points) == 0:
        points = np.array([frame.origin_m]) + 0.5 * frame.resolution_m
    (left, bottom), (right, top) = points.min(axis=0), points.max(axis=0)
    return Area(float(left), float(right), float(bottom), float(top))
