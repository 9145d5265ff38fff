"""What a person reads at the end of a command, on a terminal of 80 columns or in a pipe."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from soundmap.losses import when
from soundmap.outputs.wording import (
    NOTHING,
    array_text,
    chance_text,
    flags_text,
    level_text,
    number_text,
    place_error_text,
    ratio_text,
)

SHOWN_ROWS = 10


def run_view(report: Mapping[str, Any]) -> RenderableType:
    """Sources, trajectory, losses, time and files of one run.

    Parameters
    ----------
    report : mapping
        As in ``report.json``, and ``folder``, where all is.
    """
    spent_s = sum(report["timings_s"].values())
    speed = f", {report['speed']:.3g} x real time" if report["speed"] else ""
    way = report["trajectory"]
    usable = "none" if way["usable_share"] is None else f"{100 * way['usable_share']:.1f} %"
    return Group(
        Text(f"{report['log']}: {report['duration_s']:.1f} s of log in {spent_s:.1f} s{speed}"),
        _source_table(report),
        _lines(
            {
                "Trajectory": f"{way['length_m']:.2f} m, {way['poses']} poses, {usable} usable",
                "Array": array_text(report.get("array")),
                "Used": ", ".join(f"{count} {_words(name)}" for name, count in _counts(report)),
                "Time": _times(report["timings_s"]) + _cached(report),
                "Files": f"{report['folder']}/, to begin with report.html",
            }
        ),
        *_losses(report["losses"]),
    )


def _cached(report: Mapping[str, Any]) -> str:
    kept = "; scans, map and trajectory are those of an earlier run (--no-cache measures again)"
    return kept if report.get("from_cache") else ""


def diff_view(report: Mapping[str, Any]) -> RenderableType:
    """Changes and files of a difference of two runs."""
    counts = report["counts"]
    return Group(
        Text(f"{report['run']} against {report['background']}"),
        _change_table(report["changes"]),
        _lines(
            {
                "Cells": f"{counts['cells_compared']} compared, "
                f"{counts['cells_without_background']} of them with the background's median",
                "Time": _times(report["timings_s"]),
                "Files": f"{report['folder']}/, to begin with report.html",
            }
        ),
        *(_losses(report["losses"]) if report["losses"] else ()),
    )


def localization_view(report: Mapping[str, Any]) -> RenderableType:
    """Trajectory, losses, time and files of a log that was localized in a map."""
    spent_s = sum(report["timings_s"].values())
    speed = f", {report['speed']:.3g} x real time" if report["speed"] else ""
    way = report["trajectory"]
    return Group(
        Text(f"{report['log']}: {report['duration_s']:.1f} s of log in {spent_s:.1f} s{speed}"),
        _lines(
            {
                "Trajectory": f"{way['length_m']:.2f} m, {way['poses']} poses, "
                f"{100 * way['usable_share']:.1f} % usable",
                "Used": ", ".join(f"{count} {_words(name)}" for name, count in _counts(report)),
                "Time": _times(report["timings_s"]),
                "Files": f"{report['folder']}/",
            }
        ),
        *_losses(report["losses"]),
    )


def map_view(report: Mapping[str, Any]) -> RenderableType:
    """Map, odometry, losses, time and files of a map that was built."""
    spent_s = sum(report["timings_s"].values())
    speed = f", {report['speed']:.3g} x real time" if report["speed"] else ""
    way, room = report["trajectory"], report["map"]
    millimetres, degrees = 1e3 * room["residual_m"], math.degrees(room["residual_rad"])
    return Group(
        Text(f"{report['log']}: {report['duration_s']:.1f} s of log in {spent_s:.1f} s{speed}"),
        _lines(
            {
                "Map": f"{room['columns']} x {room['rows']} cells of {room['resolution_m']:g} m, "
                f"{room['free_m2']:.0f} m² free",
                "Trajectory": f"{way['length_m']:.2f} m, {way['poses']} poses",
                "Loops": f"{room['loops_closed']} closed of {room['loops_recognised']} recognised",
                "Agreement": f"pairs of scans within {millimetres:.1f} mm, {degrees:.2f} degrees",
                "Odometry": f"distance x {room['odometry_distance_scale']:.4f}, turn "
                f"x {room['odometry_turn_scale']:.4f}, "
                f"{math.degrees(room['odometry_turn_per_metre']):+.2f} degrees a metre",
                "Used": ", ".join(f"{count} {_words(name)}" for name, count in _counts(report)),
                "Time": _times(report["timings_s"]),
                "Files": f"{report['folder']}/",
            }
        ),
        *_losses(report["losses"]),
    )


def log_view(summary: Mapping[str, Any]) -> RenderableType:
    """What a log holds and what of it would be used, from the summary's plain form."""
    right = ("count", "[Hz]", "jitter [ms]", "gaps")
    topics = _table("topic", align_right=right, left=("schema", "used as"))
    for topic in summary["topics"]:
        topics.add_row(
            Text(topic["name"], overflow="fold"),
            str(topic["messages"]),
            number_text(topic["rate_hz"], 1),
            number_text(1e3 * topic["jitter_s"], 2),
            str(topic["gaps"]),
            Text(topic["schema"].replace("/msg/", "/"), overflow="fold"),
            topic["kind"] if topic["used"] else "-",
        )
    lasers = enumerate(summary["lasers"], start=1)
    mounts = summary["mounts"].items()
    found = {
        "Audio": _audio_described(summary["audio"]),
        **{f"Laser {number}": _described(laser) for number, laser in lasers},
        "Odometry": _described(summary["odometry"]),
        "Base frame": _value(summary["base_frame"]),
        **{f"Mount of {frame}": _placed(mount) for frame, mount in mounts},
    }
    problems = [Text(f"- {problem}") for problem in summary["problems"]]
    ready = [command for command, yes in summary["ready_for"].items() if yes]
    return Group(
        Text(
            f"{summary['path']}: {summary['duration_s']:.1f} s, "
            f"{summary['size_bytes'] / 1e6:.1f} MB, "
            f"ready for {', '.join(ready) or 'nothing'}"
        ),
        topics,
        _lines(found),
        *_losses(summary["losses"]),
        *([Text(""), Text("Problems", style="bold"), *problems] if problems else []),
    )


def _source_table(report: Mapping[str, Any]) -> RenderableType:
    rows = report["sources"]
    if not rows:
        return Text("\n  no sources found\n")
    fitted = any(place_error_text(row) != NOTHING for row in rows)
    flagged = any(flags_text(row) for row in rows)
    right = ["x [m]", "y [m]", *(["95 % [cm]"] if fitted else []), "level [dB]", "visits"]
    table = _table("id", align_right=right, left=["remarks"] if flagged else [])
    for row in rows[:SHOWN_ROWS]:
        cells = [row["id"], f"{row['x_m']:.3f}", f"{row['y_m']:.3f}"]
        cells += [place_error_text(row)] if fitted else []
        cells += [level_text(row), str(row["visits"])]
        table.add_row(*cells, *([flags_text(row)] if flagged else []))
    note = f"  levels in {report['level_reference']}"
    note += ", 95 %: half the axes of the ellipse" if fitted else ""
    return Group(table, Text(f"{note}{_more(rows, 'sources.csv')}\n"))


def _change_table(rows: Sequence[Mapping[str, Any]]) -> RenderableType:
    if not rows:
        return Text("\n  nothing differs\n")
    right = ("x [m]", "y [m]", "louder by [dB]", "by chance")
    table = _table("id", align_right=right, left=("change",))
    for row in rows[:SHOWN_ROWS]:
        place = (f"{row['x_m']:.3f}", f"{row['y_m']:.3f}")
        chance = chance_text(row.get("false_alarm_probability"))
        table.add_row(row["id"], *place, ratio_text(row), chance, row["kind"])
    more = _more(rows, "changes.csv")
    return Group(table, Text(f" {more}\n")) if more else table


def _more(rows: Sequence[Mapping[str, Any]], file: str) -> str:
    more = len(rows) - SHOWN_ROWS
    return f" and {more} more in {file}" if more > 0 else ""


def _losses(losses: Sequence[Mapping[str, Any]]) -> list[RenderableType]:
    if not losses:
        return [Text("Nothing was lost.")]
    table = Table(box=box.SIMPLE, title_justify="left", pad_edge=False)
    for title in ("", "times", "when", "what", "where", "what was done"):
        table.add_column(Text(title), justify="right" if title == "times" else "left")
    for loss in losses:
        kind = "lost" if loss["data_lost"] else "note"
        span = when(loss.get("first_s"), loss.get("last_s"))
        cells = (kind, str(loss["count"]), span, loss["what"], loss["where"], loss["effect"])
        table.add_row(*(Text(cell, overflow="fold") for cell in cells))
    return [Text(""), Text("Losses and notes", style="bold"), table]


def _table(first: str, *, align_right: Sequence[str], left: Sequence[str] = ()) -> Table:
    table = Table(box=box.SIMPLE, pad_edge=False)
    table.add_column(Text(first))
    for title in align_right:
        table.add_column(Text(title), justify="right")
    for title in left:
        table.add_column(Text(title))
    return table


def _lines(lines: Mapping[str, str]) -> Table:
    grid = Table.grid(padding=(0, 2))
    for title, content in lines.items():
        if content:
            grid.add_row(Text(title, style="bold"), Text(content, overflow="fold"))
    return grid


def _described(thing: Mapping[str, Any] | None) -> str:
    """Names and values of something's fields on one line."""
    if thing is None:
        return "none"
    fields = {name: value for name, value in thing.items() if name != "mount"}
    return ", ".join(f"{_words(name)} {_value(value)}" for name, value in fields.items())


def _audio_described(audio: Mapping[str, Any] | None) -> str:
    """The microphones on one line, with the span of their levels."""
    if audio is None:
        return "none"
    lists = ("level_db", "unsound_channels")
    known = [level for level in audio["level_db"] if level is not None]
    texts = [_described({name: value for name, value in audio.items() if name not in lists})]
    if known:
        texts.append(f"levels {min(known):.1f} to {max(known):.1f} dB re (full scale)^2")
    unsound = ", ".join(str(channel) for channel in audio["unsound_channels"])
    return ", ".join([*texts, f"channels left out: {unsound or 'none'}"])


def _placed(mount: Sequence[float]) -> str:
    x, y, z, yaw = mount
    return f"x {x:.3f}, y {y:.3f}, z {z:.3f} m, yaw {math.degrees(yaw):.1f} degrees"


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    return "-" if value is None else str(value)


def _times(timings_s: Mapping[str, float]) -> str:
    return ", ".join(f"{_words(stage)} {seconds:.2f} s" for stage, seconds in timings_s.items())


def _counts(report: Mapping[str, Any]) -> list[tuple[str, int]]:
    return list(report["counts"].items())


def _words(name: str) -> str:
    return name.replace("_", " ")
