"""The folder of a run, and that of a difference of two runs, as they are written."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from soundmap.change import PowerRatio
from soundmap.config import DiffConfig, config_toml
from soundmap.geometry import FloatArray, Trajectory
from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.losses import Loss
from soundmap.map_file import map_files
from soundmap.outputs.html_report import report_html
from soundmap.outputs.illustrator import Illustrator
from soundmap.outputs.new_folder import REPORT, writing
from soundmap.outputs.pictures import difference_pictures, run_pictures
from soundmap.outputs.report import (
    CHANGE_COLUMNS,
    REFLECTION_COLUMNS,
    SCHEMA_VERSION,
    SOURCE_COLUMNS,
    csv_text,
    diff_report,
    json_text,
    run_report,
)
from soundmap.run import Run
from soundmap.sound import AudioScans, PowerMap


def write_run(run: Run, folder: Path, illustrator: Illustrator) -> dict[str, Any]:
    """Write everything that a run yields into an empty folder.

    Parameters
    ----------
    run : Run
    folder : Path
    illustrator : Illustrator
        Who draws the pictures, and may have begun to.

    Returns
    -------
    dict
        The report, as in ``report.json``.
    """
    start = time.perf_counter()
    share = run.config.detect.min_visit_share
    with writing(folder):
        (folder / "trajectory.tum").write_text(tum_text(run.trajectory), encoding="ascii")
        write_arrays(folder / "trajectory.npz", trajectory_arrays(run.trajectory))
        write_arrays(
            folder / "power_map.npz", power_map_arrays(run.power_map, min_visit_share=share)
        )
        write_arrays(folder / "audio_scans.npz", _audio_scan_arrays(run.scans))
        _write_map(folder, run.room)
        (folder / "config.toml").write_text(config_toml(run.config), encoding="utf-8")
        shown = illustrator.write(run_pictures(run), folder)
        report = run_report(run, {**run.timings_s, "outputs": time.perf_counter() - start})
        images = csv_text(REFLECTION_COLUMNS, report["reflections"])
        (folder / "reflections.csv").write_text(images, encoding="utf-8")
        _write_report(folder, SOURCE_COLUMNS, report, shown)
    return report


def write_diff(
    ratio: PowerRatio,
    folder: Path,
    illustrator: Illustrator,
    *,
    room: OccupancyGrid | None,
    run: Path,
    background: Path,
    config: DiffConfig,
    timings_s: Mapping[str, float],
    notes: Sequence[Loss] = (),
) -> dict[str, Any]:
    """Write the difference of two runs into an empty folder.

    Parameters
    ----------
    ratio : PowerRatio
    folder : Path
    room : OccupancyGrid or None
        The geometric map, if known.
    run, background : Path
        The run folders that were compared.
    config : DiffConfig
    timings_s : mapping
        Wall time of each stage so far [s].
    notes : sequence of Loss
        Why the two runs may not compare like with like.
    illustrator : Illustrator
        Who draws the picture.

    Returns
    -------
    dict
        The report, as in ``report.json``.
    """
    start = time.perf_counter()
    with writing(folder):
        write_arrays(folder / "power_ratio.npz", _power_ratio_arrays(ratio))
        if room is not None:
            _write_map(folder, room)
        title = f"{run.resolve().name} against {background.resolve().name}"
        shown = illustrator.write(difference_pictures(ratio, room=room, title=title), folder)
        report = diff_report(
            ratio,
            run=run,
            background=background,
            config=config,
            timings_s={**timings_s, "outputs": time.perf_counter() - start},
            notes=notes,
        )
        every = csv_text(CHANGE_COLUMNS, report["changes"])
        (folder / "changes.csv").write_text(every, encoding="utf-8")
        _write_report(folder, CHANGE_COLUMNS, report, shown)
    return report


def tum_text(trajectory: Trajectory) -> str:
    r"""One line a laser scan: ``timestamp tx ty tz qx qy qz qw``, seconds exact to the nanosecond.

    Examples
    --------
    >>> pose = np.array([[1.0, 2.0, np.pi]])
    >>> tum_text(Trajectory(np.array([1700000000000000007]), pose, np.array([True])))
    '1700000000.000000007 1.000000 2.000000 0 0 0 1.000000000 0.000000000\n'
    """
    trajectory = trajectory.of_scans()
    half = trajectory.pose[:, 2] / 2.0
    rows = zip(
        trajectory.time_ns.tolist(),
        trajectory.pose[:, :2].tolist(),
        np.sin(half).tolist(),
        np.cos(half).tolist(),
        strict=True,
    )
    return "".join(
        f"{_seconds(ns)} {x:z.6f} {y:z.6f} 0 0 0 {qz:z.9f} {qw:z.9f}\n"
        for ns, (x, y), qz, qw in rows
    )


def power_map_arrays(power_map: PowerMap, *, min_visit_share: float) -> dict[str, ArrayLike]:
    """Content of ``power_map.npz``: what people read, and the sums that merge exactly."""
    squares = {} if power_map.square_sum is None else {"square_sum": power_map.square_sum}
    limits = {} if power_map.is_limit is None else {"is_limit": power_map.is_limit}
    return {
        "power": power_map.power(min_visit_share=min_visit_share),
        "visits": power_map.visits,
        **_frame_arrays(power_map.frame),
        "power_sum": power_map.power_sum,
        **squares,
        **limits,
        "min_visit_share": min_visit_share,
        "reference": str(power_map.reference),
        "power_unit": str(power_map.reference).removeprefix("dB re "),
        "schema_version": SCHEMA_VERSION,
    }


def write_arrays(file: Path, arrays: Mapping[str, ArrayLike]) -> None:
    """Write an NPZ archive; equal arrays give equal bytes, whenever they are written."""
    content: dict[str, Any] = {name: np.asarray(array) for name, array in arrays.items()}
    np.savez_compressed(file, **content)


def _audio_scan_arrays(scans: AudioScans) -> dict[str, ArrayLike]:
    mount: dict[str, ArrayLike] = {}
    if scans.mount is not None:
        mount["array_rotation"] = scans.mount.rotation
        mount["array_translation_m"] = scans.mount.translation_m
    parts: dict[str, ArrayLike] = {}
    if scans.sub_bands is not None:
        parts["sub_band_power"] = scans.sub_bands
        parts["sub_band_hz"] = scans.sub_band_hz
    return {
        "time_ns": scans.time_ns,
        "bearing_rad": scans.bearing_rad,
        "power": scans.power.astype(np.float32, copy=False),
        "reference": str(scans.reference),
        **parts,
        **mount,
        "schema_version": SCHEMA_VERSION,
    }


def trajectory_arrays(trajectory: Trajectory) -> dict[str, ArrayLike]:
    """What the TUM format cannot say, too: which poses may be trusted, and how far."""
    known: dict[str, ArrayLike] = {}
    covariance = trajectory.covariance
    if covariance is not None:
        known["covariance"] = covariance
    if trajectory.is_scan is not None:
        known["is_scan"] = trajectory.is_scan
    return {
        "time_ns": trajectory.time_ns,
        "pose": trajectory.pose,
        "usable": trajectory.usable,
        **known,
        "schema_version": SCHEMA_VERSION,
    }


def _power_ratio_arrays(ratio: PowerRatio) -> dict[str, ArrayLike]:
    chance = {} if ratio.chance is None else {"chance": ratio.chance}
    return {
        "ratio_db": ratio.ratio_db,
        "visits": ratio.visits,
        "background_measured": ratio.background_measured,
        **chance,
        **_frame_arrays(ratio.frame),
        "schema_version": SCHEMA_VERSION,
    }


def _frame_arrays(frame: GridFrame) -> dict[str, ArrayLike]:
    origin: FloatArray = np.asarray(frame.origin_m, dtype=np.float64)
    return {"resolution_m": frame.resolution_m, "origin_m": origin}


def _seconds(time_ns: int) -> str:
    whole, rest = divmod(abs(time_ns), 1_000_000_000)
    return f"{'-' if time_ns < 0 else ''}{whole}.{rest:09d}"


def _write_map(folder: Path, room: OccupancyGrid) -> None:
    for name, content in map_files(room).items():
        (folder / name).write_bytes(content)


def _write_report(
    folder: Path, columns: tuple[str, ...], report: Mapping[str, Any], shown: Mapping[str, bytes]
) -> None:
    """The report, for programs and for people, and its sources as a table."""
    (folder / "sources.csv").write_text(csv_text(columns, report["sources"]), encoding="utf-8")
    plain = json_text(report)
    page = report_html(json.loads(plain), shown)
    # A name that is not UTF-8 must not cost the page.
    (folder / "report.html").write_text(page, encoding="utf-8", errors="backslashreplace")
    (folder / REPORT).write_text(plain + "\n", encoding="utf-8")
