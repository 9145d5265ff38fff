"""The Rerun viewer, as a program of its own beside this one."""

from __future__ import annotations

import importlib.metadata
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

from soundmap.errors import OutputError

PROGRAM = "rerun"
ON_THIS_MACHINE = "127.0.0.1"


def has_display() -> bool:
    """Whether a window can be opened: always supposed but on Linux, where it shows."""
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def show(file: Path) -> None:
    """Open a recording in the viewer and wait until it is closed.

    The viewer takes data from this machine alone.

    Raises
    ------
    OutputError
        The viewer is not installed, or ended badly.
    """
    program = _program()
    if program is None:
        raise OutputError(
            f"{file}: the Rerun viewer is not installed. Install it with `pip install {_package()}`"
            f", then `rerun {file}`."
        )
    command = [program, str(file), "--bind", ON_THIS_MACHINE]
    code = subprocess.run(command, check=False).returncode  # noqa: S603
    if code != 0:
        raise OutputError(
            f"{file}: the Rerun viewer ended with code {code}. The recording is whole; "
            f"{elsewhere(file)}"
        )


def elsewhere(file: Path) -> str:
    """How to look at a recording on another machine."""
    full = Path(os.path.realpath(file))
    return (
        "to look at it on a machine with a screen:\n"
        f"  scp {socket.gethostname()}:{full} .\n"
        f"  pip install {_package()}\n"
        f"  rerun {full.name}"
    )


def _program() -> str | None:
    """The viewer that came with this Python, or else any on the path."""
    beside = Path(sys.executable).parent / PROGRAM
    return str(beside) if beside.is_file() else shutil.which(PROGRAM)


def _package() -> str:
    """What to install elsewhere: recordings are read by viewers of the same minor version."""
    major, minor, *_ = importlib.metadata.version("rerun-sdk").split(".")
    return f"'rerun-sdk~={major}.{minor}.0'"
