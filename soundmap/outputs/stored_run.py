"""Finished folders read back: the power map of a run, a whole run, a difference of two runs."""

from __future__ import annotations

import json
import math
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from soundmap.change import Change, ChangeKind, PowerRatio
from soundmap.config import stored_config
from soundmap.errors import LogError
from soundmap.geometry import Mount, Trajectory
from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.losses import Loss
from soundmap.map_file import read_map
from soundmap.outputs.new_folder import REPORT
from soundmap.outputs.report import SCHEMA_VERSION
from soundmap.run import Run
from soundmap.sound import (
    AudioScans,
    LevelReference,
    PowerMap,
    Reflection,
    Source,
    SourceFit,
    SourceList,
)

MAX_ARCHIVE_BYTES = 2 * 2**30
"""An archive that expands to more than this is not one of a run."""

POWER_MAP, POWER_RATIO = "power_map.npz", "power_ratio.npz"
AUDIO_SCANS, TRAJECTORY = "audio_scans.npz", "trajectory.npz"

Stored = Mapping[str, NDArray[Any]]
_Content = TypeVar("_Content")


def read_power_map(folder: Path) -> tuple[PowerMap, float]:
    """Power map of a run folder, and the share of the greatest visits that a cell has to exceed.

    Raises
    ------
    LogError
        Not a run folder, a damaged one, or one of a newer soundmap.
    """
    return _read(
        folder,
        POWER_MAP,
        lambda stored: (_power_map(stored), float(stored["min_visit_share"])),
    )


def read_run(folder: Path) -> Run:
    """Everything that a run folder holds.

    Raises
    ------
    SoundmapError
        Not a run folder, a damaged one, or one of a newer soundmap.
    """
    power_map, _ = read_power_map(folder)
    scans = _read(folder, AUDIO_SCANS, _audio_scans)
    trajectory = _read(folder, TRAJECTORY, _trajectory)
    report = read_report(folder)
    try:
        return Run(
            log=Path(report["log_path"]),
            fingerprint=report["fingerprint"],
            config=stored_config(folder / "config.toml"),
            room=read_map(folder / "map.yaml"),
            trajectory=trajectory,
            scans=scans,
            power_map=power_map,
            sources=_source_list(report),
            losses=tuple(Loss(**loss) for loss in report["losses"]),
            counts=report["counts"],
            timings_s=report["timings_s"],
            duration_s=float(report["duration_s"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise _damaged(folder / REPORT, f"{error!r}") from None


def tells_of_sources(folder: Path) -> bool:
    """Whether a run folder has sources of a fit, and all that they can be judged by."""
    needed = [folder / name for name in (REPORT, AUDIO_SCANS, TRAJECTORY, "config.toml")]
    if not all(file.is_file() for file in needed):
        return False
    report = read_report(folder)
    method = report.get("config", {}).get("detect", {}).get("method")
    scans = _read(folder, AUDIO_SCANS, _audio_scans)
    return method == "sparse" and scans.mount is not None and "reflections" in report


@dataclass(frozen=True)
class StoredDifference:
    """What a diff folder holds.

    Attributes
    ----------
    ratio : PowerRatio
    room : OccupancyGrid or None
        The geometric map, if it is there.
    title : str
        Names of both runs.
    """

    ratio: PowerRatio
    room: OccupancyGrid | None
    title: str


def read_difference(folder: Path) -> StoredDifference:
    """Everything that a diff folder holds.

    Raises
    ------
    SoundmapError
        Not a diff folder, a damaged one, or one of a newer soundmap.
    """
    report = read_report(folder)
    try:
        changes = tuple(map(_change, report.get("changes", report["sources"])))
        title = f"{report['run']} against {report['background']}"
    except (KeyError, TypeError, ValueError) as error:
        raise _damaged(folder / REPORT, f"{error!r}") from None

    def ratio(stored: Stored) -> PowerRatio:
        level = stored["ratio_db"].astype(np.float64)
        measured = stored["background_measured"].astype(bool)
        chance = stored["chance"].astype(np.float64) if "chance" in stored else None
        return PowerRatio(_frame(stored, level), level, stored["visits"], measured, changes, chance)

    map_yaml = folder / "map.yaml"
    room = read_map(map_yaml) if map_yaml.is_file() else None
    return StoredDifference(_read(folder, POWER_RATIO, ratio), room, title)


def read_report(folder: Path) -> dict[str, Any]:
    """``report.json`` of a folder.

    Raises
    ------
    LogError
        There is none, or it is damaged.
    """
    file = folder / REPORT
    try:
        report = json.loads(file.read_bytes())
    except OSError:
        raise _no_run_folder(folder, REPORT) from None
    except (ValueError, RecursionError) as error:
        raise _damaged(file, str(error)) from None
    if not isinstance(report, dict):
        raise _damaged(file, "no JSON object")
    return report


def _read(folder: Path, name: str, content: Callable[[Stored], _Content]) -> _Content:
    """What an archive of a folder holds, or one clear error."""
    file = folder / name
    if not file.is_file():
        raise _no_run_folder(folder, name)
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            expanded = sum(member.file_size for member in stored.zip.infolist())
            if expanded > MAX_ARCHIVE_BYTES:
                raise ValueError(f"it would expand to {expanded / 2**20:.0f} MiB")
            version = int(stored["schema_version"])
            if version > SCHEMA_VERSION:
                raise LogError(
                    f"{file}: written by a newer soundmap (schema {version}; this one reads up to "
                    f"{SCHEMA_VERSION}). Update soundmap, or process the log again."
                )
            return content(stored)
    except KeyError as error:
        raise _damaged(file, str(error.args[0])) from None
    except (OSError, ValueError, TypeError, EOFError, MemoryError) as error:
        raise _damaged(file, str(error)) from None
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError) as error:
        raise _damaged(file, f"damaged file ({error})") from None


def _no_run_folder(folder: Path, name: str) -> LogError:
    return LogError(
        f"{folder}: no run folder: it holds no {name}. Give the folder that "
        "`soundmap process` wrote."
    )


def _damaged(file: Path, what: str) -> LogError:
    kind = "a power map" if file.name == POWER_MAP else "part of a run"
    return LogError(f"{file}: cannot be read as {kind}: {what}. Process the log again.")


def _power_map(stored: Stored) -> PowerMap:
    visits, power_sum = stored["visits"], stored["power_sum"]
    if visits.ndim != 2 or not np.issubdtype(visits.dtype, np.integer):
        raise ValueError("visits should be whole numbers in two dimensions")
    if np.any(visits < 0) or not np.all(np.isfinite(power_sum)):
        raise ValueError("sums should be finite and visits not negative")
    reference = LevelReference(str(stored["reference"]))
    frame = _frame(stored, visits)
    squares = stored["square_sum"].astype(np.float64) if "square_sum" in stored else None
    limits = stored["is_limit"].astype(bool) if "is_limit" in stored else None
    power_sum, visits = power_sum.astype(np.float64), visits.astype(np.int64)
    return PowerMap(frame, power_sum, visits, reference, squares, limits)


def _audio_scans(stored: Stored) -> AudioScans:
    mount = None
    if "array_rotation" in stored:
        mount = Mount(stored["array_rotation"], stored["array_translation_m"])
    reference = LevelReference(str(stored["reference"]))
    time_ns, bearing = stored["time_ns"], stored["bearing_rad"]
    parts, edges = None, tuple[float, ...]()
    if "sub_band_power" in stored:
        parts = stored["sub_band_power"]
        edges = tuple(float(edge) for edge in stored["sub_band_hz"])
    return AudioScans(time_ns, bearing, stored["power"], reference, mount, parts, edges)


def _source_list(report: Mapping[str, Any]) -> SourceList:
    sources = tuple(
        Source(
            float(row["x_m"]),
            float(row["y_m"]),
            _power(row["power_db"]),
            int(row["visits"]),
            _fit(row),
        )
        for row in report["sources"]
    )
    images = tuple(
        Reflection(
            float(row["x_m"]), float(row["y_m"]), _power(row["level_1m_db"]), _index(row["source"])
        )
        for row in report.get("reflections", ())
    )
    return SourceList(sources, LevelReference(report["level_reference"]), images)


def _fit(row: Mapping[str, Any]) -> SourceFit | None:
    """What a fit told of a source; None where its row tells of none."""
    if row.get("var_x_m2") is None:
        return None
    covariance = [[row["var_x_m2"], row["cov_xy_m2"]], [row["cov_xy_m2"], row["var_y_m2"]]]
    return SourceFit(
        _power(row["level_1m_db"]),
        np.array(covariance, dtype=np.float64),
        float(row["false_alarm_probability"]),
        math.radians(row["arc_deg"]),
        tuple(row["flags"].split()),
        row.get("level_sigma_db"),
    )


def _change(row: Mapping[str, Any]) -> Change:
    """A row of a difference; in older folders it told of no kind, and only of louder places."""
    return Change(
        float(row["x_m"]),
        float(row["y_m"]),
        math.nan if row["ratio_db"] is None else float(row["ratio_db"]),
        int(row["visits"]),
        ChangeKind(row.get("kind", ChangeKind.LOUDER)),
        row.get("ratio_sigma_db"),
        row.get("false_alarm_probability"),
        _index(row.get("id_in_run", "")),
        _index(row.get("id_in_background", "")),
    )


def _power(level_db: float | None) -> float:
    return 0.0 if level_db is None else float(10.0 ** (level_db / 10.0))


def _index(name: str) -> int | None:
    """Index of a source from its name: 0 for S1."""
    return int(name.removeprefix("S")) - 1 if name else None


def _trajectory(stored: Stored) -> Trajectory:
    optional = (name for name in ("covariance", "is_scan") if name in stored)
    names = ("time_ns", "pose", "usable", *optional)
    return Trajectory(**{name: stored[name] for name in names})


def _frame(stored: Stored, cells: NDArray[Any]) -> GridFrame:
    x, y = (float(value) for value in stored["origin_m"])
    resolution = float(stored["resolution_m"])
    if not np.all(np.isfinite([x, y, resolution])):
        raise ValueError("the grid has no finite place")
    return GridFrame(resolution, (x, y), (cells.shape[0], cells.shape[1]))
