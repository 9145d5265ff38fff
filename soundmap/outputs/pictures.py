"""Which pictures a folder gets, in which format, and how they become files."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from soundmap.change import PowerRatio
from soundmap.errors import OutputError
from soundmap.grid import OccupancyGrid
from soundmap.outputs.picture_format import PictureFormat
from soundmap.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # slow to load: only where pictures are drawn


Pictures = Mapping[str, "Callable[[], Figure]"]
"""How to draw each picture, by the name of its file without ending."""


def run_pictures(run: Run) -> Pictures:
    """The pictures of a run, the most telling first."""
    from soundmap.outputs import figures, time_figures

    return {
        "power_map": lambda: figures.power_map_figure(run),
        "trajectory": lambda: figures.trajectory_figure(run),
        "audio_scans": lambda: time_figures.audio_scan_figure(run),
    }


def difference_pictures(ratio: PowerRatio, *, room: OccupancyGrid | None, title: str) -> Pictures:
    """The pictures of a difference of two runs."""
    from soundmap.outputs import figures

    return {"power_ratio": lambda: figures.power_ratio_figure(ratio, room=room, title=title)}


def write_pictures(
    pictures: Callable[[], Pictures], folder: Path, form: PictureFormat
) -> dict[str, bytes]:
    """Write pictures as files; equal pictures give equal bytes.

    Parameters
    ----------
    pictures : callable
        Gives the pictures. It is not called where none are wanted.
    folder : Path
    form : PictureFormat

    Returns
    -------
    dict
        What a browser can show of each, by name: SVG if that was asked for, else PNG.
    """
    if form == PictureFormat.NONE:
        return {}
    shown = {}
    for name, draw in pictures().items():
        figure = draw()
        content = picture_bytes(figure, form)
        (folder / f"{name}.{form}").write_bytes(content)
        is_for_print = form == PictureFormat.PDF
        shown[name] = picture_bytes(figure, PictureFormat.PNG) if is_for_print else content
    return shown


def write_truth_picture(run: Run, truth: Sequence[tuple[float, float]], file: Path) -> None:
    """Fig. 6b: the power map with crosses where the sources truly are, x and y [m].

    Raises
    ------
    OutputError
        The name of the file does not end in a format of pictures, or it cannot be written.
    """
    from soundmap.outputs import figures

    ending = file.suffix.lower().removeprefix(".")
    forms = [str(form) for form in PictureFormat if form != PictureFormat.NONE]
    if ending not in forms:
        raise OutputError(f"{file}: a picture ends in .{', .'.join(forms)}.")
    content = picture_bytes(figures.power_map_figure(run, truth=truth), PictureFormat(ending))
    try:
        file.write_bytes(content)
    except OSError as error:
        raise OutputError(f"{file}: cannot be written ({error.strerror}).") from None


def picture_bytes(figure: Figure, form: PictureFormat) -> bytes:
    """A figure as the content of a file, without a date in it."""
    import matplotlib

    settings: Any = {"svg.hashsalt": "soundmap", "pdf.fonttype": 42}
    undated: dict[str, Any] = {
        PictureFormat.PDF: {"CreationDate": None},
        PictureFormat.SVG: {"Date": None},
    }
    file = io.BytesIO()
    with matplotlib.rc_context(settings), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a log's name may hold letters that the font lacks
        figure.savefig(file, format=str(form), dpi=figure.dpi, metadata=undated.get(form))
    return file.getvalue()
