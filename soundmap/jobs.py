"""One log or several processed into their folders; several at a time if wanted, one process each.

A process of its own has the log's memory to itself and gives it back at the end. What is shown of
its progress travels through a queue to the one process that has the terminal.
"""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from soundmap.cores import CORE_LIMIT, usable_cores
from soundmap.errors import SoundmapError
from soundmap.outputs.picture_format import PictureFormat
from soundmap.outputs.progress import Progress, Stage, chosen_progress

if TYPE_CHECKING:
    from multiprocessing.synchronize import Event as Stopping

    from soundmap.config import Config

REPORT_INTERVAL_S = 0.1
"""A process tells of its progress no more often than this."""

Event = tuple[int, str, Any]
"""Number of the job; what happened; the process's id, a stage's name and total, or how far it is.
"""


@dataclass(frozen=True)
class Job:
    """What to make of one log.

    Attributes
    ----------
    log, folder : Path
        What to read, and where to put the results.
    map_file : Path or None
        Geometric map.
    config : Config
    start_pose : tuple of float or None
        x [m], y [m], heading [rad].
    figures : PictureFormat
    rerun, force, use_cache : bool
        Whether to write a recording, whether to replace an earlier run, and whether to take what
        earlier runs have kept and to keep what this one measures.
    """

    log: Path
    folder: Path
    map_file: Path | None
    config: Config
    start_pose: tuple[float, float, float] | None
    figures: PictureFormat
    rerun: bool
    force: bool
    use_cache: bool = True


Outcome = dict[str, Any] | SoundmapError
"""The report of a log, or why there is none."""


def processed(job: Job, progress: Progress) -> dict[str, Any]:
    """Process one log into its folder and give the report.

    Raises
    ------
    SoundmapError
        It cannot be done; nothing is left behind.
    """
    from soundmap.outputs.illustrator import illustrator
    from soundmap.outputs.new_folder import new_folder

    with (
        new_folder(job.folder, force=job.force, inputs=[job.log]) as new,
        illustrator(job.figures) as pictures,
    ):
        from soundmap.measured import MeasuredCache, cache_folder
        from soundmap.outputs.pictures import place_pictures, sound_pictures
        from soundmap.outputs.run_folder import write_run
        from soundmap.replay import process

        run = process(
            job.log,
            job.map_file,
            job.config,
            start_pose=job.start_pose,
            cache=MeasuredCache(cache_folder()) if job.use_cache else None,
            heard=lambda *sound: pictures.begin(sound_pictures(job.log, *sound)),
            progress=progress,
        )
        pictures.begin(place_pictures(run))
        if job.rerun:
            from soundmap.retelling import recorded

            run = recorded(run, new, progress=progress)
        return write_run(run, new, pictures)


def outcomes(jobs: Sequence[Job], *, at_a_time: int, quiet: bool) -> Iterator[tuple[int, Outcome]]:
    """Results of all jobs and their numbers, each as soon as it is there.

    Parameters
    ----------
    jobs : sequence of Job
    at_a_time : int
        Processes; with 1 (or one job) all is done in this one.
    quiet : bool
        Whether to show no progress.
    """
    if min(at_a_time, len(jobs)) > 1:
        yield from _in_processes(jobs, min(at_a_time, len(jobs)), chosen_progress(quiet=quiet))
        return
    for number, job in enumerate(jobs):
        yield number, _attempted(job, chosen_progress(quiet=quiet))


def _attempted(job: Job, progress: Progress) -> Outcome:
    try:
        return processed(job, progress)
    except SoundmapError as error:
        return error


def _in_processes(
    jobs: Sequence[Job], processes: int, progress: Progress
) -> Iterator[tuple[int, Outcome]]:
    from concurrent.futures import ProcessPoolExecutor

    context = multiprocessing.get_context("spawn")
    events: multiprocessing.Queue[Event] = context.Queue()
    stopping = context.Event()
    waiting: dict[Future[Outcome], int] = {}
    with _Board(jobs, progress) as board, _shared_threads(processes):
        pool = ProcessPoolExecutor(
            processes, context, initializer=_begin, initargs=(events, stopping)
        )
        try:
            with _deaf_to_interrupts():  # until the new processes know what to do about them
                for number, job in enumerate(jobs):
                    waiting[pool.submit(_run, number, job)] = number
            while waiting:
                done, _ = wait(waiting, REPORT_INTERVAL_S, return_when=FIRST_COMPLETED)
                board.show(events)
                for future in done:
                    number = waiting.pop(future)
                    yield number, _outcome(future, jobs[number])
        except BaseException:
            stopping.set()
            for future in waiting:
                future.cancel()
            while wait([f for f in waiting if not f.cancelled()], REPORT_INTERVAL_S).not_done:
                board.show(events)
                _ask_to_stop(board.processes)
            raise
        finally:
            pool.shutdown(cancel_futures=True)


def _outcome(future: Future[Outcome], job: Job) -> Outcome:
    from concurrent.futures.process import BrokenProcessPool

    try:
        return future.result()
    except BrokenProcessPool:
        return SoundmapError(
            f"{job.log}: the process that worked on it, or one beside it, was ended from outside; "
            "most likely memory ran out. Try fewer --jobs."
        )


def _ask_to_stop(processes: set[int]) -> None:
    for process in processes:
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGTERM)


@contextmanager
def _deaf_to_interrupts() -> Iterator[None]:
    """Ctrl-C waits; processes begun meanwhile inherit that."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _shared_threads(processes: int) -> Iterator[None]:
    """Lets each process that begins meanwhile use its share of the cores."""
    before = os.environ.get(CORE_LIMIT)
    os.environ[CORE_LIMIT] = str(max(usable_cores() // processes, 1))
    try:
        yield
    finally:
        if before is None:
            del os.environ[CORE_LIMIT]
        else:
            os.environ[CORE_LIMIT] = before


class _Board:
    """Shows the stages of all processes."""

    def __init__(self, jobs: Sequence[Job], progress: Progress) -> None:
        self._jobs, self._progress = jobs, progress
        self._open: dict[int, list[tuple[ExitStack, Stage]]] = {}
        self.processes: set[int] = set()

    def __enter__(self) -> _Board:
        return self

    def __exit__(self, *_: object) -> None:
        for stages in self._open.values():
            while stages:
                stages.pop()[0].close()

    def show(self, events: multiprocessing.Queue[Event]) -> None:
        """Show what has happened since the last call."""
        while True:
            try:
                number, what, content = events.get_nowait()
            except queue.Empty:
                return
            if what == "process":
                self.processes.add(content)
                continue
            stages = self._open.setdefault(number, [])
            if what == "begin":
                name, total = content
                stack = ExitStack()
                title = f"{self._jobs[number].log.name}: {name}"
                stages.append((stack, stack.enter_context(self._progress.stage(title, total))))
            elif what == "at":
                stages[-1][1].advance_to(content)
            else:
                stages.pop()[0].close()


# What follows runs in the processes.


@dataclass
class _Process:
    """What a process knows of itself: where to report, whether to go on, whether it is at work."""

    events: multiprocessing.Queue[Event]
    stopping: Stopping
    at_work: bool = False


_own: list[_Process] = []


def _begin(events: multiprocessing.Queue[Event], stopping: Stopping) -> None:
    from soundmap.terminal import hush_libraries

    _own.append(_Process(events, stopping))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupted)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    hush_libraries()
    events.put((-1, "process", os.getpid()))


def _interrupted(_number: int, _frame: object) -> None:
    """Stop the work on a log, once; between two logs there is nothing to stop."""
    if _own[0].at_work:
        _own[0].at_work = False
        raise KeyboardInterrupt


def _run(number: int, job: Job) -> Outcome:
    own = _own[0]
    own.at_work = True
    try:
        if own.stopping.is_set():
            raise KeyboardInterrupt
        return _attempted(job, _Reporter(number, own.events))
    except KeyboardInterrupt:
        return SoundmapError(f"{job.log}: stopped.")
    finally:
        own.at_work = False


class _Reporter:
    """Progress that is shown by another process."""

    def __init__(self, number: int, events: multiprocessing.Queue[Event]) -> None:
        self._number, self._events = number, events

    @contextmanager
    def stage(self, name: str, total: float | None = None) -> Iterator[Stage]:
        """A stage that is shown with the name of the log."""
        self._events.put((self._number, "begin", (name, total)))
        try:
            yield _ReportedStage(self._number, self._events)
        finally:
            self._events.put((self._number, "end", None))


class _ReportedStage:
    def __init__(self, number: int, events: multiprocessing.Queue[Event]) -> None:
        self._number, self._events = number, events
        self._told_s = 0.0

    def advance_to(self, done: float) -> None:
        now_s = time.monotonic()
        if now_s - self._told_s >= REPORT_INTERVAL_S:
            self._told_s = now_s
            self._events.put((self._number, "at", done))
