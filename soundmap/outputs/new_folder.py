"""A folder that appears whole or not at all.

Files are written to a hidden folder beside the wanted one, which takes its place in a single
renaming when all is done. Whatever stops the work before that leaves what was there untouched.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from soundmap.errors import OutputError

REPORT = "report.json"


@contextmanager
def new_folder(folder: Path, *, force: bool, inputs: Iterable[Path] = ()) -> Iterator[Path]:
    """A hidden folder to write to, which becomes ``folder`` when the ``with`` block ends well.

    Open it before the long work: everything that forbids writing is found at the start.

    Parameters
    ----------
    folder : Path
        What shall appear. Parents are made.
    force : bool
        Replace an earlier run or diff folder, and nothing else.
    inputs : iterable of Path
        Files that are being read; they must not lie in a folder that is replaced.

    Raises
    ------
    OutputError
        The folder exists and may not be replaced, or cannot be written.
    """
    target = Path(os.path.realpath(folder))
    inputs = [Path(os.path.realpath(path)) for path in inputs]
    with writing(folder):
        _refuse_to_replace(folder, target, force=force, inputs=inputs)
    partial = target.with_name(f".{target.name}.partial-{secrets.token_hex(4)}")
    parents = [parent for parent in target.parents if not parent.exists()]
    try:
        with writing(folder):
            partial.mkdir(parents=True)
        yield partial
        with writing(folder):
            _refuse_to_replace(folder, target, force=force, inputs=inputs)
            _swap_in(partial, target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        _remove_if_empty(parents)


def folder_for(log: Path) -> Path:
    """Where the results of a log go unless the user says otherwise: here, named as the log.

    Examples
    --------
    >>> str(folder_for(Path("recordings/run1.mcap")))
    'run1'
    """
    log = Path(os.path.realpath(log))
    folder = Path(log.stem if log.suffix == ".mcap" else log.name)
    return folder if folder.absolute() != log else Path(f"{log.name}-soundmap")


def folder_for_difference(run: Path, background: Path) -> Path:
    """Where the difference of two run folders goes unless the user says otherwise.

    Examples
    --------
    >>> str(folder_for_difference(Path("runs/run1"), Path("runs/run3/")))
    'run1-run3'
    """
    return Path(f"{run.resolve().name}-{background.resolve().name}")


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """What the operating system forbids while results are written, as one clear `OutputError`."""
    try:
        yield
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        raise OutputError(
            f"{folder}: cannot be written ({place}{error.strerror or error}). "
            "Make room or name another folder with --out."
        ) from error


def _refuse_to_replace(folder: Path, target: Path, *, force: bool, inputs: list[Path]) -> None:
    in_the_way = next(path for path in (target, *target.parents) if path.exists())
    if not in_the_way.is_dir():
        raise OutputError(f"{folder}: {in_the_way} is a file. Name another folder with --out.")
    if in_the_way != target:
        return
    if target == Path.cwd() or target in Path.cwd().parents or target.is_mount():
        raise OutputError(
            f"{folder}: is in use as the working folder or a mount point and cannot be replaced. "
            "Name a folder inside it with --out."
        )
    if not any(target.iterdir()):
        return
    if not force:
        raise OutputError(
            f"{folder}: exists and is not empty. Name another folder with --out, or replace it "
            "with --force."
        )
    if not _is_of_soundmap(target):
        raise OutputError(
            f"{folder}: holds no {REPORT} of soundmap, so it is not replaced even with --force. "
            "Remove it yourself, or name another folder with --out."
        )
    if held := [path for path in inputs if target in path.parents]:
        raise OutputError(
            f"{folder}: holds {held[0].name}, which is being read, so it is not replaced. "
            "Name another folder with --out."
        )


def _is_of_soundmap(folder: Path) -> bool:
    try:
        report = json.loads((folder / REPORT).read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(report, dict) and "soundmap" in report


def _swap_in(partial: Path, target: Path) -> None:
    if not target.exists():
        partial.rename(target)
        return
    old = target.with_name(f".{target.name}.old-{secrets.token_hex(4)}")
    target.rename(old)
    try:
        partial.rename(target)
    except BaseException:
        old.rename(target)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _remove_if_empty(parents: list[Path]) -> None:
    for parent in parents:
        try:
            parent.rmdir()
        except OSError:
            return
