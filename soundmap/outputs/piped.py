"""A file that another library writes, and that is an error, not a standstill, on a full disk."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

OPEN_FILES = Path("/dev/fd")
PART_BYTES = 2**20


@contextmanager
def piped(file: Path) -> Iterator[str]:
    """The name to write to so that all of it comes to lie in a file, part by part.

    It names a pipe that a thread empties into the file. Where the disk is full it empties the pipe
    all the same, so that the writer does not wait for ever. The writer has to be done in the end.
    Where the system has no names for pipes it is the file's own.

    Raises
    ------
    OSError
        At the end: not all could be written.
    """
    if not OPEN_FILES.is_dir():
        yield str(file)
        return
    source, sink = os.pipe()
    problems: list[OSError] = []
    thread = threading.Thread(target=_emptied, args=(source, file, problems), daemon=True)
    thread.start()
    try:
        yield str(OPEN_FILES / str(sink))
    finally:
        os.close(sink)
        thread.join()
    if problems:
        raise problems[0]


def _emptied(source: int, file: Path, problems: list[OSError]) -> None:
    with open(source, "rb", buffering=0) as pipe:
        try:
            with file.open("wb") as content:
                while part := pipe.read(PART_BYTES):
                    content.write(part)
        except OSError as problem:
            problems.append(problem)
            while pipe.read(PART_BYTES):
                pass
