"""Which MCAP files make up a log: one file, or the splits of a rosbag2 folder."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Any

from soundmap.errors import LogError

PACKED = {".zstd": "zstd -d", ".zst": "zstd -d", ".lz4": "lz4 -d -m", ".gz": "gunzip -k"}
"""Endings of files that are compressed as a whole, and what unpacks them."""


def log_files(path: Path) -> tuple[Path, ...]:
    """The MCAP files of a log in the order they were recorded.

    Parameters
    ----------
    path : Path
        An ``.mcap`` file, or a rosbag2 folder with ``metadata.yaml`` and the splits it names.

    Raises
    ------
    LogError
        Nothing is there, or the folder cannot be understood.
    """
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        raise LogError(f"{path}: no such file or folder. Check the path.") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise LogError(f"{path}: cannot be opened ({reason}). Check the path.") from None
    if stat.S_ISDIR(mode):
        return _splits(path)
    if not stat.S_ISREG(mode):
        raise LogError(f"{path}: neither a file nor a folder. Write what it gives to a file first.")
    return (path,)


def _splits(folder: Path) -> tuple[Path, ...]:
    metadata = folder / "metadata.yaml"
    if not metadata.is_file():
        found = sorted(file.name for file in folder.glob("*.mcap"))
        if not found:
            raise LogError(
                f"{folder}: a folder without metadata.yaml and without .mcap files. "
                "Give an .mcap file or a rosbag2 folder."
            )
        raise LogError(
            f"{folder}: a folder with {len(found)} .mcap file(s) but no metadata.yaml. Give one "
            f"file ({folder / found[0]}), or restore metadata.yaml: ros2 bag reindex -s mcap "
            f"{folder}"
        )
    information = _bag_information(metadata)
    _refuse_other_storage(folder, information)
    names = information.get("relative_file_paths")
    if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
        raise LogError(f"{metadata}: names no files (relative_file_paths). Is it a rosbag2 folder?")
    return tuple(_inside(folder, name) for name in names)


def _bag_information(metadata: Path) -> dict[str, Any]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        content = YAML(typ="safe", pure=True).load(metadata.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, YAMLError, ValueError, RecursionError) as error:
        first_line = (str(error) or type(error).__name__).splitlines()[0]
        raise LogError(f"{metadata}: cannot be read ({first_line}).") from None
    information = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    if not isinstance(information, dict):
        raise LogError(f"{metadata}: not a rosbag2 description (rosbag2_bagfile_information).")
    return information


def _refuse_other_storage(folder: Path, information: dict[str, Any]) -> None:
    storage = information.get("storage_identifier", "mcap")
    if not isinstance(storage, str):
        storage = "something else"
    if storage != "mcap":
        raise LogError(
            f"{folder}: stored as {storage!r}, expected 'mcap'. Convert it: ros2 bag convert, or "
            "mcap convert."
        )


def _inside(folder: Path, name: str) -> Path:
    """The file of that name, which must lie in the folder."""
    root = folder.resolve()
    # Old rosbag2 wrote the folder's own name in front.
    candidates = [root / name, root / Path(name).name]
    # Whoever has unpacked a compressed file need not change the description.
    candidates += [file.with_suffix("") for file in candidates if file.suffix in PACKED]
    for candidate in candidates:
        file = candidate.resolve()
        if not file.is_relative_to(root):
            raise LogError(f"{folder}/metadata.yaml: {name!r} lies outside the folder; refused.")
        if file.is_file() and file.suffix not in PACKED:
            return file
    if Path(name).suffix in PACKED:
        raise LogError(
            f"{folder}: its files are compressed as a whole. Unpack them beside the packed ones "
            f"and try again: {PACKED[Path(name).suffix]} {folder}/*{Path(name).suffix}"
        )
    raise LogError(f"{folder}: metadata.yaml names {name!r}, which is missing. Copy it there.")
