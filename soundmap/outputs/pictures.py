"""Which pictures a folder gets, in which format, and how they become files."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from soundmap.change import PowerRatio
from soundmap.errors import OutputError
from soundmap.geometry import Trajectory
from soundmap.grid import OccupancyGrid
from soundmap.outputs.picture_format import PictureFormat
from soundmap.run import MapRun, Run
from soundmap.sound import AudioScans

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # slow to load: only where pictures are drawn


Pictures = Mapping[str, "Callable[[], Figure]"]
"""How to draw each picture, by the name of its file without ending; another process can be told."""


@dataclass(frozen=True)
class Picture:
    """A picture as it is written and as a page shows it.

    Attributes
    ----------
    content : bytes
        Of the file.
    shown : bytes
        What a browser can show: SVG if that is the format, else PNG.
    """

    content: bytes
    shown: bytes


def run_pictures(run: Run) -> Pictures:
    """The pictures of a run, the most telling first."""
    return {**place_pictures(run), **sound_pictures(run.log, run.scans, run.trajectory)}


def place_pictures(run: Run) -> Pictures:
    """Those of a run's pictures that show where its sources are."""
    quiet = replace(run, scans=_none_of(run.scans))
    return {"power_map": partial(_power_map, quiet), "trajectory": partial(_trajectory, quiet)}


def sound_pictures(log: Path, scans: AudioScans, trajectory: Trajectory) -> Pictures:
    """Those of a run's pictures that need nothing but what was heard, and where from."""
    needed = replace(scans, sub_bands=None, sub_band_hz=(), sharp=None)
    return {"audio_scans": partial(_audio_scans, log, needed, trajectory)}


def map_pictures(run: MapRun) -> Pictures:
    """The picture of a map."""
    return {"map": partial(_map, run)}


def difference_pictures(ratio: PowerRatio, *, room: OccupancyGrid | None, title: str) -> Pictures:
    """The pictures of a difference of two runs."""
    return {"power_ratio": partial(_power_ratio, ratio, room, title)}


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


def drawn(draw: Callable[[], Figure], form: PictureFormat) -> Picture:
    """A picture in a format; equal pictures give equal bytes."""
    figure = draw()
    content = picture_bytes(figure, form)
    is_for_print = form == PictureFormat.PDF
    return Picture(content, picture_bytes(figure, PictureFormat.PNG) if is_for_print else content)


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


def _none_of(scans: AudioScans) -> AudioScans:
    return replace(
        scans,
        time_ns=scans.time_ns[:0],
        power=scans.power[:0],
        sub_bands=None,
        sub_band_hz=(),
        sharp=None,
    )


# What draws is loaded where it is called.


def _power_map(run: Run) -> Figure:
    from soundmap.outputs.figures import power_map_figure

    return power_map_figure(run)


def _trajectory(run: Run) -> Figure:
    from soundmap.outputs.figures import trajectory_figure

    return trajectory_figure(run)


def _audio_scans(log: Path, scans: AudioScans, trajectory: Trajectory) -> Figure:
    from soundmap.outputs.time_figures import audio_scan_figure

    return audio_scan_figure(scans, trajectory, f"{log.stem}: audio scans")


def _map(run: MapRun) -> Figure:
    from soundmap.outputs.figures import map_figure

    return map_figure(run.room, run.trajectory, f"{run.log.stem}: geometric map and trajectory")


def _power_ratio(ratio: PowerRatio, room: OccupancyGrid | None, title: str) -> Figure:
    from soundmap.outputs.figures import power_ratio_figure

    return power_ratio_figure(ratio, room=room, title=title)
