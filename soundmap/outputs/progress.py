"""How far the work has come: bars on a terminal, silence anywhere else.

A stage reports in any unit it likes, as long as its total is in the same one::

    with progress.stage("scan", total=log.duration_s) as stage:
        for scan in scans:
            stage.advance_to(scan_end_s)
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as Bars
    from rich.progress import TaskID


class Stage(Protocol):
    """A piece of work under way."""

    def advance_to(self, done: float) -> None:
        """Report how much is done, in the unit of the stage's total."""


class Progress(Protocol):
    """Where a long computation reports how far it is."""

    def stage(self, name: str, total: float | None = None) -> AbstractContextManager[Stage]:
        """A stage of the work, which ends with the ``with`` block; stages may lie inside others.

        Parameters
        ----------
        name : str
            A word or two for the person who waits.
        total : float or None
            What `Stage.advance_to` will have reached at the end; None if nobody knows.
        """


class _SilentStage:
    def advance_to(self, done: float) -> None:
        """Nobody is told."""


class SilentProgress:
    """Says nothing: for ``--quiet``, for pipes and for tests."""

    @contextmanager
    def stage(self, name: str, total: float | None = None) -> Iterator[Stage]:  # noqa: ARG002
        """A stage that nobody hears of."""
        yield _SilentStage()


class _Bar:
    def __init__(self, bars: Bars, task: TaskID) -> None:
        self._bars, self._task = bars, task

    def advance_to(self, done: float) -> None:
        self._bars.update(self._task, completed=done)


class TerminalProgress:
    """One bar a stage, gone again when the outermost stage ends.

    Parameters
    ----------
    console : rich.console.Console
        Of the standard error stream.
    """

    def __init__(self, console: Console) -> None:
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        self._bars = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeRemainingColumn(),
            console=console,
            transient=True,
        )
        self._depth = 0

    @contextmanager
    def stage(self, name: str, total: float | None = None) -> Iterator[Stage]:
        """A stage with a bar of its own; the bar pulses where no total is known."""
        if self._depth == 0:
            self._bars.start()
        self._depth += 1
        task = self._bars.add_task(name, total=total)
        try:
            yield _Bar(self._bars, task)
        finally:
            self._depth -= 1
            if self._depth == 0:
                self._bars.stop()  # draws the last state before it wipes the line
            self._bars.remove_task(task)


def chosen_progress(*, quiet: bool) -> Progress:
    """Bars if a person sits before the standard error stream and wants them, else silence."""
    if quiet or not sys.stderr.isatty():
        return SilentProgress()
    from rich.console import Console

    return TerminalProgress(Console(stderr=True))
