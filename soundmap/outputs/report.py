"""What was done, with what, at which cost: ``report.json``, and the rows of ``sources.csv``."""

from __future__ import annotations

import csv
import dataclasses
import importlib.metadata
import io
import json
import math
import platform
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from soundmap import __version__
from soundmap.change import Change, PowerRatio
from soundmap.config import DiffConfig
from soundmap.geometry import Trajectory
from soundmap.losses import Loss
from soundmap.run import Run
from soundmap.sensors import ArrayOffsets
from soundmap.sound import Source, SourceList, decibels

SCHEMA_VERSION = 1
SOURCE_COLUMNS = (
    "id", "x_m", "y_m", "power_db", "visits", "power_reference",
    "level_1m_db", "level_sigma_db", "var_x_m2", "cov_xy_m2", "var_y_m2",
    "false_alarm_probability", "arc_deg", "flags",
)  # fmt: skip
REFLECTION_COLUMNS = ("id", "x_m", "y_m", "level_1m_db", "source")
CHANGE_COLUMNS = (
    "id", "x_m", "y_m", "ratio_db", "visits", "kind", "ratio_sigma_db", "false_alarm_probability",
    "id_in_run", "id_in_background",
)  # fmt: skip
LIBRARIES = ("numpy", "scipy", "numba", "matplotlib", "mcap", "rosbags", "pydantic", "rerun-sdk")


def run_report(run: Run, timings_s: Mapping[str, float]) -> dict[str, Any]:
    """Everything about a run but its arrays, in the order in which a person asks.

    Parameters
    ----------
    run : Run
    timings_s : mapping
        Wall time of each stage, writing included [s].
    """
    spent = sum(timings_s.values())
    return {
        **provenance(),
        "log": run.log.name,
        "log_path": str(run.log.absolute()),
        "fingerprint": run.fingerprint,
        "duration_s": run.duration_s,
        "speed": run.duration_s / spent if spent > 0 and not run.from_cache else None,
        "level_reference": str(run.sources.reference),
        "sources": source_rows(run.sources),
        "reflections": reflection_rows(run.sources),
        "trajectory": trajectory_summary(run.trajectory),
        "array": offsets_summary(run.offsets),
        "counts": dict(run.counts),
        "losses": [dataclasses.asdict(loss) for loss in run.losses],
        "timings_s": dict(timings_s),
        "from_cache": run.from_cache,
        "config": run.config.model_dump(mode="json", exclude_none=True),
    }


def diff_report(
    ratio: PowerRatio,
    *,
    run: Path,
    background: Path,
    config: DiffConfig,
    timings_s: Mapping[str, float],
    notes: Sequence[Loss] = (),
) -> dict[str, Any]:
    """Everything about a comparison of two runs but its arrays."""
    measured = np.isfinite(ratio.ratio_db)
    rows = change_rows(ratio.changes)
    return {
        **provenance(),
        "run": run.resolve().name,
        "background": background.resolve().name,
        "sources": rows[: len(ratio.louder)],
        "changes": rows,
        "losses": [dataclasses.asdict(note) for note in notes],
        "counts": {
            "cells_compared": int(measured.sum()),
            "cells_without_background": int((measured & ~ratio.background_measured).sum()),
        },
        "timings_s": dict(timings_s),
        "config": {"diff": config.model_dump(mode="json", exclude_none=True)},
    }


def source_rows(sources: SourceList) -> list[dict[str, Any]]:
    """One row a source, loudest first, named S1, S2, ...; as in the CSV and in the report."""
    return [
        {
            "id": f"S{number}",
            "x_m": round(source.x_m, 4),
            "y_m": round(source.y_m, 4),
            "power_db": _finite(round(float(decibels(source.power)), 3)),
            "visits": source.visits,
            "power_reference": str(sources.reference),
            **_fit_row(source),
        }
        for number, source in enumerate(sources, start=1)
    ]


def reflection_rows(sources: SourceList) -> list[dict[str, Any]]:
    """One row a mirror image, with the id of the source that it belongs to, if one is known."""
    return [
        {
            "id": f"R{number}",
            "x_m": round(image.x_m, 4),
            "y_m": round(image.y_m, 4),
            "level_1m_db": _finite(round(float(decibels(image.power)), 3)),
            "source": _name(image.source),
        }
        for number, image in enumerate(sources.reflections, start=1)
    ]


def _fit_row(source: Source) -> dict[str, Any]:
    """What a fit tells of a source; empty for a mere maximum of the power map."""
    fit = source.fit
    if fit is None:
        return {}
    (var_x, cov_xy), (_, var_y) = fit.covariance_m2.tolist()
    return {
        "level_1m_db": _finite(round(float(decibels(fit.power_1m)), 3)),
        "level_sigma_db": None if fit.level_sigma_db is None else round(fit.level_sigma_db, 3),
        "var_x_m2": round(var_x, 7),
        "cov_xy_m2": round(cov_xy, 7),
        "var_y_m2": round(var_y, 7),
        "false_alarm_probability": _three_digits(fit.false_alarm_probability),
        "arc_deg": round(math.degrees(fit.arc_rad), 1),
        "flags": " ".join(fit.flags),
    }


def change_rows(changes: Sequence[Change]) -> list[dict[str, Any]]:
    """One row a change, named S1, S2, ... in the order given; missing values are None."""
    return [
        {
            "id": f"S{number}",
            "x_m": round(change.x_m, 4),
            "y_m": round(change.y_m, 4),
            "ratio_db": _finite(round(change.ratio_db, 3)),
            "visits": change.visits,
            "kind": str(change.kind),
            "ratio_sigma_db": None if change.sigma_db is None else round(change.sigma_db, 3),
            "false_alarm_probability": _three_digits(change.false_alarm_probability),
            "id_in_run": _name(change.run_source),
            "id_in_background": _name(change.background_source),
        }
        for number, change in enumerate(changes, start=1)
    ]


def _three_digits(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.3g}")


def _name(source: int | None) -> str:
    return "" if source is None else f"S{source + 1}"


def csv_text(columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """A table with a header row; missing values are empty, lines end in a newline alone."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def json_text(content: Mapping[str, Any]) -> str:
    """Strict JSON: numpy's scalars as numbers, paths as text, what is not finite as null."""
    return json.dumps(_plain(content), indent=2, allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Path):
        return str(value)
    return _finite(value) if isinstance(value, float) else value


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def provenance() -> dict[str, Any]:
    """Versions of the program, of what it writes, and of what it was made with."""
    versions = {"python": platform.python_version()}
    for library in LIBRARIES:
        versions[library] = importlib.metadata.version(library)
    return {"schema_version": SCHEMA_VERSION, "soundmap": __version__, "versions": versions}


def trajectory_summary(trajectory: Trajectory) -> dict[str, Any]:
    """Poses of laser scans, way driven [m], and the share of poses to be trusted."""
    steps = np.diff(trajectory.pose[:, :2], axis=0)
    return {
        "poses": len(trajectory.of_scans()),
        "length_m": float(np.hypot(steps[:, 0], steps[:, 1]).sum()),
        "usable_share": float(trajectory.usable.mean()) if len(trajectory) else None,
    }


def offsets_summary(offsets: ArrayOffsets | None) -> dict[str, Any] | None:
    """How far the array's clock and yaw were off and what came of it; None if nobody asked."""
    if offsets is None:
        return None
    return {
        "clock_offset_s": _finite(offsets.clock.value),
        "clock_sigma_s": _finite(offsets.clock.sigma),
        "clock_verdict": str(offsets.clock.verdict),
        "yaw_offset_deg": _finite(math.degrees(offsets.yaw.value)),
        "yaw_sigma_deg": _finite(math.degrees(offsets.yaw.sigma)),
        "yaw_verdict": str(offsets.yaw.verdict),
        "explained_share": offsets.explained,
        "fixed_places": offsets.places,
        "why": offsets.why,
    }
