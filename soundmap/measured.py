"""What the slow half of a run yields, and a place to keep it until the same is asked for again.

Reading a log, beamforming, mapping and localizing take nearly all the time of a run and do not
depend on how sound is fused and sources are found. A later run on the same log with the same
settings for these stages takes their results from the user's cache.
"""

from __future__ import annotations

import dataclasses
import enum
import hashlib
import json
import os
import time
import types
import typing
import zipfile
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from soundmap import __version__
from soundmap.config import Config
from soundmap.geometry import Trajectory
from soundmap.grid import OccupancyGrid
from soundmap.losses import Loss
from soundmap.sensors import MicArray
from soundmap.sound import AudioScans
from soundmap.surroundings import Surroundings

MAX_CACHE_BYTES = 2 * 2**30
"""What has not been used for longest is removed when the cache grows beyond this."""

ABANDONED_S = 3600.0
"""Nobody takes that long to write a file here."""

_SLOW_STAGES = ("array", "topics", "mounts", "audio", "map", "localize", "scan")
_UNREADABLE = (
    OSError, ValueError, TypeError, KeyError, EOFError, MemoryError, NotImplementedError,
    zipfile.BadZipFile, zlib.error, RuntimeError,
)  # fmt: skip


@dataclass(frozen=True)
class Measured:
    """What calibration, fusion and detection work on.

    Attributes
    ----------
    room : OccupancyGrid
        The geometric map, given or built.
    trajectory : Trajectory
        Base frame in the map frame.
    scans : AudioScans
    surroundings : Surroundings
    array : MicArray
        The microphones used.
    losses : tuple of Loss
        So far.
    scanners, odometry_poses : int
        How many there were.
    fingerprint : str
        Identifies the log's content.
    duration_s : float
        From the first to the last message of the log [s].
    """

    room: OccupancyGrid
    trajectory: Trajectory
    scans: AudioScans
    surroundings: Surroundings
    array: MicArray
    losses: tuple[Loss, ...]
    scanners: int
    odometry_poses: int
    fingerprint: str
    duration_s: float


def measured_key(
    files: Iterable[Path],
    fingerprint: str,
    config: Config,
    room: OccupancyGrid | None,
    start_pose: tuple[float, float, float] | None,
) -> str:
    """What results depend on, as one word: the log, the settings, the map and this program.

    Parameters
    ----------
    files : iterable of Path
        Of the log. Their times of change count, too: the fingerprint is one of samples.
    fingerprint : str
        Of the log's content.
    config : Config
        Only what the slow stages look at counts.
    room : OccupancyGrid or None
        The map, if one is given.
    start_pose : tuple of float or None
    """
    settings = config.model_dump(mode="json", include=set(_SLOW_STAGES))
    told = {
        "soundmap": __version__,
        "program": _program(),
        "numpy": np.__version__,
        "log": [fingerprint, *((file.name, file.stat().st_mtime_ns) for file in files)],
        "settings": settings,
        "sharp": config.calibrate.mode != "off",
        "start": start_pose,
    }
    digest = hashlib.sha256(json.dumps(told, sort_keys=True).encode())
    if room is not None:
        digest.update(repr(room.frame).encode() + room.occupied.tobytes() + room.free.tobytes())
    return digest.hexdigest()


def cache_folder() -> Path:
    """``soundmap`` in ``$XDG_CACHE_HOME``, else in ``~/.cache``."""
    told = os.environ.get("XDG_CACHE_HOME", "")
    base = Path(told) if os.path.isabs(told) else Path.home() / ".cache"
    return base / "soundmap"


class MeasuredCache:
    """A folder of results, one file each; whatever is wrong with it only costs time.

    Parameters
    ----------
    folder : Path
        Is made when it is needed.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(self, key: str) -> Measured | None:
        """What was kept under that key; None if nothing was, or not all of it can be read."""
        file = self.folder / f"{key}.npz"
        try:
            with file.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
                if stored["key"].item() != key:
                    return None
                plain = json.loads(stored["plain"].item())
                arrays = {name: stored[name] for name in stored.files}
            found: Measured = _rebuilt(Measured, "measured", arrays, plain)
            os.utime(file)  # used last now
        except _UNREADABLE:
            return None
        return found

    def put(self, key: str, measured: Measured) -> None:
        """Keep results under a key, if there is room and the folder can be written."""
        arrays: dict[str, Any] = {}
        plain: dict[str, Any] = {}
        _taken_apart(measured, "measured", arrays, plain)
        partial = self.folder / f".{key}.{os.getpid()}"
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with partial.open("wb") as stream:
                np.savez(stream, key=key, plain=json.dumps(plain), **arrays)
            partial.replace(self.folder / f"{key}.npz")
            self._make_room()
        except OSError:
            return
        finally:
            _removed(partial)

    def _make_room(self) -> None:
        files = sorted(self.folder.glob("*.npz"), key=lambda file: -file.stat().st_mtime_ns)
        for file in self.folder.glob(".*"):  # what killed runs left
            if file.stat().st_mtime < time.time() - ABANDONED_S:
                _removed(file)
        total = 0
        for file in files:
            total += file.stat().st_size
            if total > MAX_CACHE_BYTES:
                _removed(file)


def _removed(file: Path) -> None:
    try:
        file.unlink(missing_ok=True)
    except OSError:
        return


@cache
def _program() -> str:
    """Digest of this program's own text: a changed program does not use what an older one kept."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


# Dataclasses as named arrays and plain values


def _taken_apart(value: Any, name: str, arrays: dict[str, Any], plain: dict[str, Any]) -> None:
    if isinstance(value, np.ndarray):
        arrays[name] = value
    elif dataclasses.is_dataclass(value):
        plain[name] = {}
        for field in dataclasses.fields(value):
            _taken_apart(getattr(value, field.name), f"{name}.{field.name}", arrays, plain)
    elif isinstance(value, tuple) and value and dataclasses.is_dataclass(value[0]):
        plain[name] = [dataclasses.asdict(item) for item in value]
    else:
        plain[name] = value.value if isinstance(value, enum.Enum) else value


def _rebuilt(kind: Any, name: str, arrays: dict[str, Any], plain: dict[str, Any]) -> Any:
    if name in arrays:
        return arrays[name]
    value = plain[name]
    if value is None:
        return None
    if isinstance(kind, types.UnionType):
        kind = next(one for one in typing.get_args(kind) if one is not types.NoneType)
    if dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        return typing.cast(type, kind)(
            **{
                field.name: _rebuilt(hints[field.name], f"{name}.{field.name}", arrays, plain)
                for field in dataclasses.fields(kind)
            }
        )
    if isinstance(value, list):
        item = typing.get_args(kind)[0]
        return tuple(item(**one) if isinstance(one, dict) else one for one in value)
    return kind(value) if isinstance(kind, type) else value
