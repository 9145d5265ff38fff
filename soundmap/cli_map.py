"""The commands that need no audio: build a map, localize in one."""

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
    StartPoseOption,
    parsed_start_pose,
    print_result,
    resolved_config,
)

LogArgument = Annotated[
    Path, typer.Argument(metavar="LOG", help="Recorded log: an .mcap file or a rosbag2 folder.")
]
OutOption = Annotated[Path, typer.Option(metavar="DIR", help="Folder to write.")]


def map_log(
    log: LogArgument,
    out: OutOption,
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
    from soundmap.outputs.illustrator import illustrator
    from soundmap.outputs.new_folder import new_folder
    from soundmap.outputs.progress import chosen_progress
    from soundmap.outputs.summary import map_view

    settings = resolved_config(config)
    with (
        new_folder(out, force=force, inputs=[log]) as new,
        illustrator(figures) as pictures,
    ):
        from soundmap.map_log import mapped
        from soundmap.outputs.map_folder import write_map_run

        run = mapped(log, settings, progress=chosen_progress(quiet=quiet or as_json))
        report = write_map_run(run, new, pictures)
    if not quiet or as_json:
        print_result({**report, "folder": str(out)}, map_view, as_json=as_json)


def localize_log(
    log: LogArgument,
    map_file: Annotated[
        Path,
        typer.Option(
            "--map",
            metavar="MAP.yaml",
            help="Geometric map of the site: a map_server YAML file, which names its image.",
        ),
    ],
    out: OutOption,
    start_pose: StartPoseOption = None,
    config: ConfigOption = None,
    figures: FiguresOption = PictureFormat.PNG,
    *,
    force: ForceOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find the trajectory of a log in a map. Needs no audio.

    Writes a folder with the trajectory, the map, a picture of both and a report.
    """
    from soundmap.outputs.illustrator import illustrator
    from soundmap.outputs.new_folder import new_folder
    from soundmap.outputs.progress import chosen_progress
    from soundmap.outputs.summary import localization_view

    settings, start = resolved_config(config), parsed_start_pose(start_pose)
    with (
        new_folder(out, force=force, inputs=[log, map_file]) as new,
        illustrator(figures) as pictures,
    ):
        from soundmap.map_log import localized
        from soundmap.outputs.map_folder import write_map_run

        progress = chosen_progress(quiet=quiet or as_json)
        run = localized(log, map_file, settings, start_pose=start, progress=progress)
        report = write_map_run(run, new, pictures)
    if not quiet or as_json:
        print_result({**report, "folder": str(out)}, localization_view, as_json=as_json)
