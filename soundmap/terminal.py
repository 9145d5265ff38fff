"""What every command shares: its options, and how results and errors are printed."""

from __future__ import annotations

import logging
import math
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from soundmap.errors import SoundmapError
from soundmap.outputs.picture_format import PictureFormat

if TYPE_CHECKING:
    from rich.console import RenderableType

    from soundmap.config import Config

ConfigOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--config",
        metavar="FILE",
        help="Settings to use instead of the defaults, as TOML. May be repeated: a later file "
        "overrides an earlier one key by key. Default: configs/default.toml's values.",
    ),
]
ForceOption = Annotated[
    bool,
    typer.Option(
        "--force",
        help="Replace the folder of an earlier run, with all that is in it, once the new one is "
        "complete. Without it, a folder that is not empty is refused.",
    ),
]
FiguresOption = Annotated[
    PictureFormat,
    typer.Option(
        "--figures",
        metavar="FORMAT",
        help="Format of the pictures: png, pdf, svg, or none for no pictures.",
    ),
]
QuietOption = Annotated[
    bool, typer.Option("--quiet", "-q", help="Print nothing but errors: no progress, no summary.")
]
JsonOption = Annotated[
    bool,
    typer.Option("--json", help="Print one JSON object on the standard output and nothing else."),
]


StartPoseOption = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,DEG",
        help="Where in the map the robot starts: x and y in metres, heading in degrees "
        "counter-clockwise from the x axis. Default: it is searched for in the whole map.",
    ),
]


def resolved_config(files: list[Path] | None) -> Config:
    """The settings of the files given, over the defaults."""
    from soundmap.config import loaded_config

    return loaded_config(files or [])


def print_result(
    content: Mapping[str, Any],
    view: Callable[[Mapping[str, Any]], RenderableType],
    *,
    as_json: bool,
) -> None:
    """Print a result for a program or for a person."""
    if as_json:
        from soundmap.outputs.report import json_text

        print(json_text(content))
    else:
        from rich.console import Console

        Console(highlight=False).print(view(_printable(content)))


def _printable(content: Any) -> Any:
    """A result whose texts a terminal can be given, at any depth."""
    from soundmap.outputs.wording import printable

    if isinstance(content, str):
        return printable(content)
    if isinstance(content, Mapping):
        return {_printable(key): _printable(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_printable(value) for value in content]
    return content


def show_error(error: SoundmapError) -> None:
    """One panel on a terminal; plain, unbroken lines anywhere else."""
    from soundmap.outputs.wording import printable

    told = re.sub(r"\S{300,}", lambda word: f"{word[0][:200]}...", printable(str(error)))
    if not sys.stderr.isatty():
        print(f"soundmap: error: {told}", file=sys.stderr)
        return
    from rich.console import Console
    from rich.panel import Panel
    from rich.text import Text

    panel = Panel(Text(told), title="soundmap: error", border_style="red")
    Console(stderr=True).print(panel)


def parsed_start_pose(text: str | None) -> tuple[float, float, float] | None:
    """X,Y,DEG as metres and radians."""
    if text is None:
        return None
    try:
        x, y, degrees = (float(part) for part in text.split(","))
    except ValueError:
        x = y = degrees = math.nan
    if not all(math.isfinite(number) for number in (x, y, degrees)):
        raise typer.BadParameter(
            f"{text!r} is no start pose: give x and y in metres and the heading in degrees, "
            "separated by commas, as in --start-pose 1.2,-0.5,90",
            param_hint="'--start-pose'",
        )
    return x, y, math.radians(degrees)


def hush_libraries() -> None:
    """Keep the terminal free of what libraries have to say."""
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it tells of its font cache otherwise
