"""The folder of a map that was built from a log."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from soundmap.config import config_toml
from soundmap.map_file import map_files
from soundmap.outputs.illustrator import Illustrator
from soundmap.outputs.new_folder import REPORT, writing
from soundmap.outputs.pictures import map_pictures
from soundmap.outputs.report import json_text, provenance, trajectory_summary
from soundmap.outputs.run_folder import trajectory_arrays, tum_text, write_arrays
from soundmap.run import MapRun


def write_map_run(run: MapRun, folder: Path, illustrator: Illustrator) -> dict[str, Any]:
    """Write map, trajectory, picture, report and settings into an empty folder.

    Parameters
    ----------
    run : MapRun
    folder : Path
    illustrator : Illustrator
        Who draws the map.

    Returns
    -------
    dict
        The report, as in ``report.json``.
    """
    start = time.perf_counter()
    with writing(folder):
        for name, content in map_files(run.room).items():
            (folder / name).write_bytes(content)
        (folder / "trajectory.tum").write_text(tum_text(run.trajectory), encoding="ascii")
        write_arrays(folder / "trajectory.npz", trajectory_arrays(run.trajectory))
        (folder / "config.toml").write_text(config_toml(run.config), encoding="utf-8")
        illustrator.write(map_pictures(run), folder)
        report = map_report(run, {**run.timings_s, "outputs": time.perf_counter() - start})
        (folder / REPORT).write_text(json_text(report) + "\n", encoding="utf-8")
    return report


def map_report(run: MapRun, timings_s: Mapping[str, float]) -> dict[str, Any]:
    """Everything about a map but its arrays, in the order in which a person asks.

    Parameters
    ----------
    run : MapRun
    timings_s : mapping
        Wall time of each stage, writing included [s].
    """
    spent = sum(timings_s.values())
    rows, columns = run.room.frame.shape
    area = run.room.frame.resolution_m**2
    return {
        **provenance(),
        "log": run.log.name,
        "fingerprint": run.fingerprint,
        "duration_s": run.duration_s,
        "speed": run.duration_s / spent if spent > 0 else None,
        "map": {
            "resolution_m": run.room.frame.resolution_m,
            "columns": columns,
            "rows": rows,
            "free_m2": float(run.room.free.sum()) * area,
            "occupied_cells": int(run.room.occupied.sum()),
            **run.facts,
        },
        "trajectory": trajectory_summary(run.trajectory),
        "counts": dict(run.counts),
        "losses": [dataclasses.asdict(loss) for loss in run.losses],
        "timings_s": dict(timings_s),
        "config": run.config.model_dump(mode="json", exclude_none=True),
    }
