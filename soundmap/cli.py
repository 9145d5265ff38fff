"""The command line: parse, call, print. What is slow to load is loaded inside the commands."""

from __future__ import annotations

import os
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from soundmap import __version__, cli_map, cli_runs
from soundmap.errors import DataLossError, SoundmapError
from soundmap.kernel_cache import kernel_cache_folder
from soundmap.outputs.picture_format import PictureFormat
from soundmap.terminal import (
    ConfigOption,
    FiguresOption,
    ForceOption,
    JsonOption,
    QuietOption,
    StartPoseOption,
    hush_libraries,
    parsed_start_pose,
    print_result,
    resolved_config,
    show_error,
)

EPILOG = """\b
Examples:
  soundmap info run1.mcap
  soundmap process run1.mcap
  soundmap process run1.mcap run3.mcap --map map.yaml --config robot.toml
  soundmap diff run1 run3
  soundmap view run1

\b
Exit codes: 0 done, 1 failed, 2 wrong usage or configuration, 3 unreadable
input, 4 nothing usable in the log, 5 --strict and data was lost.
"""


class Commands(TyperGroup):
    """All commands, with the one place where the errors that a user can mend are caught."""

    def make_context(self, *args: Any, **keywords: Any) -> Any:
        """Parse what was asked for."""
        with _clear_endings():
            return super().make_context(*args, **keywords)

    def invoke(self, ctx: Any) -> Any:
        """Run the command that was asked for."""
        with _clear_endings():
            return super().invoke(ctx)


@contextmanager
def _clear_endings() -> Iterator[None]:
    """What a user can mend, or wants, ends the program with a line of text and no traceback."""
    try:
        yield
    except SoundmapError as error:
        show_error(error)
        raise typer.Exit(error.exit_code) from None
    except MemoryError as error:
        show_error(SoundmapError(f"memory ran out ({error or 'no more is known'})."))
        raise typer.Exit(SoundmapError.exit_code) from None
    except KeyboardInterrupt:
        print("soundmap: stopped; nothing was left half written.", file=sys.stderr)
        raise typer.Exit(130) from None


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    epilog=EPILOG,
)

LogArgument = Annotated[
    Path, typer.Argument(metavar="LOG", help="Recorded log: an .mcap file or a rosbag2 folder.")
]
LogsArgument = Annotated[
    list[Path],
    typer.Argument(metavar="LOG", help="Recorded logs: .mcap files or rosbag2 folders."),
]


def _version(wanted: bool) -> None:
    if wanted:
        print(f"soundmap {__version__}")
        raise typer.Exit


@app.callback()
def soundmap(
    *,
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    """Find where noise comes from, how loud it is, and what has changed, from a robot's logs."""


@app.command()
def info(log: LogArgument, config: ConfigOption = None, *, as_json: JsonOption = False) -> None:
    """Show what a log holds and what of it would be used.

    Topics, clocks, gaps, mounts, and the problems that processing it would meet.
    """
    from soundmap.logs.summary import log_summary
    from soundmap.outputs.summary import log_view

    summary = log_summary(log, resolved_config(config)).as_dict()
    print_result(summary, log_view, as_json=as_json)


@app.command()
def process(
    logs: LogsArgument,
    map_file: Annotated[
        Path | None,
        typer.Option(
            "--map",
            metavar="MAP.yaml",
            help="Geometric map of the site: a map_server YAML file, which names its image. "
            "Default: it is built from the log, with its origin at the robot's first pose.",
        ),
    ] = None,
    config: ConfigOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder to write. With several logs, the folder in which each gets its own. "
            "Default: a folder here with the name of the log.",
        ),
    ] = None,
    start_pose: StartPoseOption = None,
    figures: FiguresOption = PictureFormat.PNG,
    *,
    rerun: Annotated[
        bool,
        typer.Option(
            "--rerun", help="Write a recording for the Rerun viewer, too; see soundmap view."
        ),
    ] = False,
    jobs: Annotated[
        int,
        typer.Option(
            min=1,
            metavar="N",
            help="Logs that are processed at a time, each by a process of its own. The results are "
            "the same.",
        ),
    ] = 1,
    force: ForceOption = False,
    strict: Annotated[
        bool,
        typer.Option(
            "--strict",
            help="Exit with code 5 if any data of the log was lost. The results are written all "
            "the same.",
        ),
    ] = False,
    no_cache: Annotated[
        bool,
        typer.Option(
            "--no-cache",
            help="Read, map, localize and beamform again even if an earlier run has done so with "
            "the same settings, and keep nothing for later ones.",
        ),
    ] = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Locate the noise sources of one log or several.

    Writes a folder a log: sources, power map, trajectory, pictures, report.
    """
    from soundmap.jobs import Job
    from soundmap.jobs import outcomes as job_outcomes

    start = parsed_start_pose(start_pose)
    if map_file is None and start is not None:
        raise typer.BadParameter(
            "a start pose is one in a given map: add --map MAP.yaml, or leave --start-pose out",
            param_hint="'--start-pose'",
        )
    folders = _run_folders(logs, out)
    settings = resolved_config(config)
    work = [
        Job(
            log,
            folder,
            map_file,
            settings,
            start,
            figures,
            rerun=rerun,
            force=force,
            use_cache=not no_cache,
        )
        for log, folder in zip(logs, folders, strict=True)
    ]
    outcomes: list[dict[str, Any]] = [{} for _ in work]
    for number, outcome in job_outcomes(work, at_a_time=jobs, quiet=quiet or as_json):
        log, folder = logs[number], folders[number]
        if not isinstance(outcome, SoundmapError):
            outcomes[number] = {**outcome, "folder": str(folder)}
            continue
        if len(logs) == 1:
            raise outcome
        show_error(outcome)
        outcomes[number] = {
            "log": log.name,
            "error": str(outcome),
            "exit_code": outcome.exit_code,
        }
    _show_runs(outcomes, quiet=quiet, as_json=as_json)
    _exit_unless_good(outcomes, strict=strict)


app.command("map")(cli_map.map_log)
app.command("localize")(cli_map.localize_log)
app.command()(cli_runs.diff)
app.command()(cli_runs.evaluate)
app.command()(cli_runs.view)


@app.command()
def simulate(
    scene: Annotated[
        Path, typer.Argument(metavar="SCENE.toml", help="Room, sources, robot and route.")
    ],
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder for the log, its map and its truth.")
    ],
    run: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Which of the scene's runs. Default: the first."),
    ] = None,
    *,
    force: Annotated[
        bool,
        typer.Option(
            "--force",
            help="Write into a folder that is not empty; files of the same names are replaced.",
        ),
    ] = False,
    quiet: QuietOption = False,
) -> None:
    """Simulate the log of a drive past noise sources, with its truth.

    Writes an MCAP log, the geometric map, the true sources and trajectory, and robot.toml, which
    process takes as --config.
    """
    from soundmap.outputs.progress import chosen_progress
    from soundmap.simulate.simulation import simulated_run

    with chosen_progress(quiet=quiet).stage("simulate", total=1.0) as stage:
        done = simulated_run(scene, out, run=run, force=force, progress=stage.advance_to)
    if not quiet:
        sounding = ", ".join(done.sources) or "none"
        print(f"{done.log}: {done.duration_s:.1f} s, sources that sound: {sounding}")
        print(f"soundmap process {done.log} --map {out / 'map.yaml'}", end=" ")
        print(f"--config {out / 'robot.toml'}")


def main() -> None:
    """Run the command line."""
    # Small products gain nothing from threads of the linear algebra, and on a busy machine lose
    # several-fold to their waiting for one another. Read when numpy is first imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    # Threads of compiled kernels would spin for a while after each, in case another one follows.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    home = os.path.expanduser("~")
    folder = kernel_cache_folder(
        Path(__file__).parent, os.environ, Path(home) if os.path.isabs(home) else None
    )
    if folder is not None:
        os.environ["NUMBA_CACHE_DIR"] = str(folder)
    signal.signal(signal.SIGTERM, _stop)
    hush_libraries()
    try:
        app(prog_name="soundmap")
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done: there is nothing to stop


def _stop(number: int, _frame: object) -> None:
    raise SystemExit(128 + number)


def _run_folders(logs: list[Path], out: Path | None) -> list[Path]:
    """One folder a log, in the order of the logs."""
    from soundmap.outputs.new_folder import folder_for

    if out is not None and len(logs) == 1:
        return [out]
    folders = [folder_for(log) for log in logs]
    if out is not None:
        folders = [out / folder.name for folder in folders]
    if shared := [str(folder) for folder, count in Counter(folders).items() if count > 1]:
        raise typer.BadParameter(
            f"more than one log would be written to {', '.join(shared)}: process them one by one "
            "with --out",
            param_hint="'LOG...'",
        )
    return folders


def _show_runs(outcomes: list[dict[str, Any]], *, quiet: bool, as_json: bool) -> None:
    from soundmap.outputs.summary import run_view

    if as_json and len(outcomes) > 1:
        print_result({"runs": outcomes}, run_view, as_json=True)
    elif as_json or not quiet:
        for outcome in outcomes:
            if "error" not in outcome:
                print_result(outcome, run_view, as_json=as_json)


def _exit_unless_good(outcomes: list[dict[str, Any]], *, strict: bool) -> None:
    """Exit with the worst code of several logs; a failure is worse than a loss."""
    failures = [outcome["exit_code"] for outcome in outcomes if "error" in outcome]
    if strict:
        for outcome in outcomes:
            lost = [loss for loss in outcome.get("losses", ()) if loss["data_lost"]]
            if lost:
                error = DataLossError(
                    f"{outcome['log']}: data was lost ({lost[0]['where']}: {lost[0]['what']}"
                    f"{' and more' if len(lost) > 1 else ''}) and --strict was given. "
                    f"The results are in {outcome['folder']}/."
                )
                show_error(error)
                failures.append(0)
    if failures:
        raise typer.Exit(max(failures) or DataLossError.exit_code)
