"""The command that builds the geometric map."""

from __future__ import annotations

from pathlib import Path
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


def map_log(
    log: Annotated[
        Path, typer.Argument(metavar="LOG", help="Recorded log: an .mcap file or a rosbag2 folder.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write.")],
    config: ConfigOption = None,
    figures: FiguresOption = PictureFormat.PNG,
    *,
    force: ForceOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Build the geometric map of a site from laser scans and odometry alone.

    Writes a folder with the map (map_server's PGM and YAML), the trajectory in it, a picture and a
    report. The origin of the map is the first pose of the robot.
    """
    from soundmap.outputs.map_folder import write_map_run
    from soundmap.outputs.new_folder import new_folder
    from soundmap.outputs.progress import chosen_progress
    from soundmap.outputs.summary import map_view

    settings = resolved_config(config)
    with new_folder(out, force=force, inputs=[log]) as new:
        from soundmap.map_log import mapped

        run = mapped(log, settings, progress=chosen_progress(quiet=quiet or as_json))
        report = write_map_run(run, new, figures=figures)
    if not quiet or as_json:
        print_result({**report, "folder": str(out)}, map_view, as_json=as_json)
