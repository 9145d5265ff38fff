"""A folder that appears whole or not at all.

Files are written to a hidden folder beside the wanted one, which takes its place in a single
renaming when all is done. Whatever stops the work before that leaves what was there untouched.
"""

from __future__ import annotations

import glob
import json
import os
import re
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
        _tidy_up(target)
        _refuse_to_replace(folder, target, force=force, inputs=inputs)
    partial = target.with_name(f".{target.name}.partial-{secrets.token_hex(4)}")
    parents = [parent for parent in target.parents if not parent.exists()]
    lock = None
    try:
        with writing(folder):
            target.parent.mkdir(parents=True, exist_ok=True)
            lock = _locked_folder(partial)
        yield partial
        with writing(folder):
            _flush(partial)
            _refuse_to_replace(folder, target, force=force, inputs=inputs)
            _swap_in(partial, target)
    finally:
        if lock is not None:
            os.close(lock)
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
        name = str(error.filename or "")
        # Whoever wrote to the hidden folder means the one that it was to become.
        hidden = re.fullmatch(r"\.(.+)\.partial-[0-9a-f]{8}", folder.name)
        if hidden:
            name, folder = name.replace(folder.name, hidden[1]), folder.with_name(hidden[1])
        place = f"{name}: " if name else ""
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


def _locked_folder(partial: Path) -> int | None:
    """Make a folder; the open, locked handle shows that its maker still lives.

    It gets its name once it is locked, so that nobody takes it for an abandoned one.
    """
    unnamed = partial.with_name(f".{secrets.token_hex(8)}")
    unnamed.mkdir()
    lock = _lock(unnamed)
    try:
        unnamed.rename(partial)
    except OSError:
        unnamed.rmdir()
        raise
    return lock


def _lock(folder: Path) -> int | None:
    """A handle that holds the only lock on a folder; None if it is taken, or there are no locks."""
    try:
        import fcntl
    except ImportError:  # not a Unix
        return None
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(handle)
        return None
    return handle


def _tidy_up(target: Path) -> None:
    """Remove what killed runs left beside the target; bring back what one was about to replace."""
    for old in target.parent.glob(f".{glob.escape(target.name)}.old-*"):
        if target.exists():
            shutil.rmtree(old, ignore_errors=True)
        else:
            old.rename(target)
    for partial in target.parent.glob(f".{glob.escape(target.name)}.partial-*"):
        lock = _lock(partial)
        if lock is not None:
            shutil.rmtree(partial, ignore_errors=True)
            os.close(lock)


def _flush(folder: Path) -> None:
    """Wait until all files are on the disk: only then does a full disk always show."""
    for path in [*folder.rglob("*"), folder]:
        if path.is_file() or os.name == "posix":
            handle = os.open(path, os.O_RDONLY)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)


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
