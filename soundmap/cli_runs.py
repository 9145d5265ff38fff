"""Commands on finished run folders: compare, judge, look."""

from __future__ import annotations

import sys
from pathlib import Path
from time import perf_counter
from typing import Annotated

import typer

from soundmap.outputs.picture_format import PictureFormat
from soundmap.terminal import (
    ConfigOption,
    FiguresOption,
    ForceOption,
    JsonOption,
    QuietOption,
    print_result,
    resolved_config,
)


def diff(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of the run to be looked at.")],
    background: Annotated[
        Path,
        typer.Argument(
            metavar="BACKGROUND", help="Folder of a run of the same site to compare with."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder to write. Default: a folder here named RUN-BACKGROUND."
        ),
    ] = None,
    config: ConfigOption = None,
    figures: FiguresOption = PictureFormat.PNG,
    *,
    force: ForceOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show what is louder or quieter in one run than in another.

    Writes a folder with the difference of the two power maps in dB, what became of each source,
    and how sure that is.
    """
    from soundmap.outputs.illustrator import illustrator
    from soundmap.outputs.new_folder import folder_for_difference, new_folder
    from soundmap.outputs.summary import diff_view

    settings = resolved_config(config)
    folder = out if out is not None else folder_for_difference(run, background)
    compared_files = [run / "map.yaml", background / "map.yaml"]
    with (
        new_folder(folder, force=force, inputs=compared_files) as new,
        illustrator(figures) as pictures,
    ):
        from soundmap.comparison import compared
        from soundmap.outputs.run_folder import write_diff

        began = perf_counter()
        comparison = compared(run, background, settings.diff, settings.detect)
        timings_s = {"compare": perf_counter() - began}
        report = write_diff(
            comparison.ratio,
            new,
            pictures,
            room=comparison.room,
            run=run,
            background=background,
            config=settings.diff,
            timings_s=timings_s,
            notes=comparison.notes,
        )
    if not quiet or as_json:
        print_result({**report, "folder": str(folder)}, diff_view, as_json=as_json)


def evaluate(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Folder that process or diff has written.")
    ],
    sources: Annotated[
        Path,
        typer.Option(
            metavar="TRUTH.csv", help="Where the sources truly are: columns id,x_m,y_m, and more."
        ),
    ],
    trajectory: Annotated[
        Path | None,
        typer.Option(
            metavar="TRUTH.tum",
            help="Where the robot truly was, in the frame of the same map, in TUM format.",
        ),
    ] = None,
    figure: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Picture to write, as .png, .pdf or .svg: the power map with the truth as "
            "crosses.",
        ),
    ] = None,
    *,
    align: Annotated[
        bool,
        typer.Option(
            "--align",
            help="Lay the run's trajectory on the true one first: for runs that built a map.",
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Compare a run with the truth, as in the paper's Table 2.

    A source counts as detected when something was found within 0.5 m of it.
    """
    from soundmap.evaluate import evaluation, evaluation_view, read_places

    if align and figure is not None:
        raise typer.BadParameter("--figure draws the run in its own frame: leave --align out.")
    result = evaluation(run, sources, trajectory, align=align)
    if figure is not None:
        from soundmap.outputs.pictures import write_truth_picture
        from soundmap.outputs.stored_run import read_run

        places = [(place.x_m, place.y_m) for place in read_places(sources)]
        write_truth_picture(read_run(run), places, figure)
    print_result(result.as_dict(), lambda _: evaluation_view(result), as_json=as_json)


def view(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Folder that process or diff has written.")
    ],
    *,
    save: Annotated[
        bool, typer.Option("--save", help="Write the recording, but do not open the viewer.")
    ] = False,
    quiet: QuietOption = False,
) -> None:
    """Watch a run, or a difference of two, in the Rerun viewer.

    Makes the recording if it is missing: run.rrd, or diff.rrd, in the folder.
    """
    from soundmap.outputs.progress import chosen_progress
    from soundmap.outputs.viewer import elsewhere, has_display, show
    from soundmap.retelling import recording_of

    file, remark = recording_of(folder, progress=chosen_progress(quiet=quiet))
    if remark and not quiet:
        print(f"soundmap: note: {remark}", file=sys.stderr)
    if save or not has_display():
        if not quiet:
            reason = "" if save else "there is no display here; "
            print(f"{file}\n{reason}{elsewhere(file)}")
        return
    show(file)
