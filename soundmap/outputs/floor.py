"""The floor plan that every picture of a place is drawn on: size, walls, metres, colour bar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray

from soundmap.geometry import FloatArray
from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.outputs.area import Area, coarsened, cropped
from soundmap.outputs.labels import is_far, label_offsets
from soundmap.outputs.wording import ellipse_95, printable

WALL, UNKNOWN, OPEN = 0.25, 0.90, 1.0
DIMMED_UNKNOWN, DIMMED_OPEN = 0.80, 0.90
"""Grey values of the geometric map, 0 black to 1 white."""

LONG_SIDE_INCHES = 6.2
DOTS_PER_INCH = 160
LEAST_CELL_DOTS = 3.0
"""Cells smaller than this in the picture are drawn in blocks, so that none is skipped."""

LEFT, RIGHT, TOP, BOTTOM = 0.75, 0.25, 0.40, 0.55
"""Room around the axes for what is written there [inches]."""
BAR_GAP, BAR_WIDTH, BAR_TEXT = 0.12, 0.18, 0.75
BAR_LABEL_INCHES = 3.9
LEGEND_ROW = 0.26
LEGEND_HANDLE, LEGEND_LETTER = 0.6, 0.078
"""Width of what stands before a label, gaps included, and of one of its letters [inches]."""
LEAST_WIDTH_INCHES = 5.0
CIRCLE_POINTS = 15.0
LEADER = {"arrowstyle": "-", "linewidth": 0.9, "color": "black", "shrinkA": 0, "shrinkB": 7}
"""The line from a label to a marker that is far off."""

Places = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Mark:
    """How a kind of place is marked.

    Attributes
    ----------
    label : str
        In the legend.
    marker, colour : str
        As matplotlib takes them.
    size : float
        [points]
    suffix : str
        Added to the names of such places.
    """

    label: str
    marker: str = "o"
    colour: str = "black"
    size: float = CIRCLE_POINTS
    suffix: str = ""


FOUND = Mark("found here")
DOUBTFUL = Mark("found here, with remarks", marker="s", size=13.0, suffix="*")
IMAGE = Mark("mirror image", marker="D", colour="0.45", size=5.0)
TRUTH = Mark("truth", marker="x", colour="#D55E00", size=9.0)


class FloorPlan:
    """A picture of an area, with the geometric map and metres on its axes.

    Everything is placed in inches: the axes have the area's shape, and what is written around
    them has its own room, whatever the site's proportions.

    Parameters
    ----------
    area : Area
    room : OccupancyGrid or None
    title : str
    dimmed : bool
        Keep white for the data: open space is grey, too.
    """

    def __init__(
        self, area: Area, room: OccupancyGrid | None, title: str, *, dimmed: bool = False
    ) -> None:
        unknown, free = (DIMMED_UNKNOWN, DIMMED_OPEN) if dimmed else (UNKNOWN, OPEN)
        self.area, self.room = area, room
        self.scale = LONG_SIDE_INCHES / max(area.width, area.height)
        self.figure = Figure(dpi=DOTS_PER_INCH)
        FigureCanvasAgg(self.figure)
        self.axes: Axes = self.figure.add_axes((0.1, 0.1, 0.8, 0.8))
        self._title = title
        self._bar: Axes | None = None
        self.axes.set_facecolor(str(unknown))
        if room is not None:
            shade = np.full(room.frame.shape, unknown, dtype=np.float32)
            shade[room.free], shade[room.occupied] = free, WALL
            part, extent = self.blocks(shade, room.frame, np.min)
            self.axes.imshow(part, origin="lower", extent=extent, cmap="gray", vmin=0, vmax=1)
        self.axes.set_aspect("equal")
        self.axes.set_xlim(area.left, area.right)
        self.axes.set_ylim(area.bottom, area.top)
        self.axes.set_xlabel("x [m]")
        self.axes.set_ylabel("y [m]")

    def block_m(self, frame: GridFrame) -> float:
        """Edge of what is drawn as one square: a cell, or as many as a picture can show [m]."""
        return self._cells_a_block(frame) * frame.resolution_m

    def blocks(
        self, values: NDArray[np.generic], frame: GridFrame, reduce: Any
    ) -> tuple[FloatArray, tuple[float, float, float, float]]:
        """The cells in the area in drawable blocks, and the edges of what they cover [m].

        Parameters
        ----------
        values : ndarray, shape (H, W)
        frame : GridFrame
        reduce : callable
            What stands for a block, as ``np.max`` does; called with ``axis``.
        """
        part, extent = cropped(values, frame, self.area)
        return coarsened(part, extent, self._cells_a_block(frame), reduce)

    def add_colour_bar(self, image: AxesImage, label: str, extend: str) -> None:
        """A bar beside the axes; below them where they are too low for its label."""
        axes = self.figure.add_axes((0.9, 0.1, 0.05, 0.8))
        self._bar = axes
        upright = self._height >= BAR_LABEL_INCHES
        bar = self.figure.colorbar(
            image,
            cax=axes,
            orientation="vertical" if upright else "horizontal",
            extend=extend,
        )
        bar.set_label(label, fontsize=9)

    def draw_wall_outlines(self) -> None:
        """Thin lines round the walls, over whatever colours lie on them."""
        if self.room is None:
            return
        part, (left, right, bottom, top) = self.blocks(self.room.occupied, self.room.frame, np.max)
        if min(part.shape) < 2 or not part.any() or part.all():
            return
        x = left + (np.arange(part.shape[1]) + 0.5) * (right - left) / part.shape[1]
        y = bottom + (np.arange(part.shape[0]) + 0.5) * (top - bottom) / part.shape[0]
        self.axes.contour(x, y, part.astype(np.float32), [0.5], colors=[str(WALL)], linewidths=0.7)

    def draw_places(
        self, places_m: Places, marks: Sequence[Mark], fills: Sequence[Any] | None = None
    ) -> None:
        """Markers named S1, S2, ... in the order given; where many crowd, some go without a name.

        Parameters
        ----------
        places_m : sequence of tuple
            x, y [m].
        marks : sequence of Mark
            How each is marked; those of one mark share an entry of the legend.
        fills : sequence of colours, optional
            What fills each marker; by default they are hollow.
        """
        if not places_m:
            return
        points = (np.array(places_m) - [self.area.left, self.area.bottom]) * self.scale * 72.0
        names = [f"S{number}{mark.suffix}" for number, mark in enumerate(marks, start=1)]
        size = (self.area.width * self.scale * 72.0, self.area.height * self.scale * 72.0)
        offsets = label_offsets(points, names, size, marker=CIRCLE_POINTS)
        unnamed = " (some unnamed)" if any(offset is None for offset in offsets) else ""
        for number, mark in enumerate(dict.fromkeys(marks)):
            own = [index for index, its in enumerate(marks) if its == mark]
            filled = "none" if fills is None else [fills[index] for index in own]
            self._mark([places_m[index] for index in own], mark, "" if number else unnamed, filled)
        for place, name, mark, offset in zip(places_m, names, marks, offsets, strict=True):
            if offset is not None:
                text = self.axes.annotate(
                    name,
                    place,
                    xytext=offset,
                    textcoords="offset points",
                    ha="center",
                    va="center",
                    weight="bold",
                    color=mark.colour,
                    fontsize=9,
                    zorder=6,
                    arrowprops=LEADER if is_far(offset) else None,
                )
                text.set_path_effects(_halo())

    def draw_ellipses(self, places_m: Places, covariances_m2: Sequence[FloatArray]) -> None:
        """Where the places lie with 95 %, if that is more than their markers cover."""
        reach = 0.5 * CIRCLE_POINTS / 72.0 / self.scale
        ellipses = map(ellipse_95, covariances_m2)
        lines = [
            np.array(place) + ellipse
            for place, ellipse in zip(places_m, ellipses, strict=True)
            if np.hypot(*ellipse.T).max() > reach
        ]
        if not lines:
            return
        self.axes.add_collection(
            LineCollection(lines, colors="black", linewidths=0.9, label="95 %", zorder=4.5)
        )

    def draw_images(self, places_m: Places, sources_m: Places) -> None:
        """Small marks at mirror images in the picture, but for those under a source's marker."""
        area, reach = self.area, CIRCLE_POINTS / 72.0 / self.scale
        inside = [
            (x, y)
            for x, y in places_m
            if area.left <= x <= area.right
            and area.bottom <= y <= area.top
            and all(np.hypot(x - a, y - b) > reach for a, b in sources_m)
        ]
        if inside:
            self._mark(inside, IMAGE)

    def draw_truth(self, places_m: Places) -> None:
        """Crosses where the sources truly are."""
        if places_m:
            self._mark(places_m, TRUTH)

    def finished(self) -> Figure:
        """The figure with everything in its place."""
        width, height = self.area.width * self.scale, self._height
        handles, labels = self.axes.get_legend_handles_labels()
        beside = self._bar is not None and height >= BAR_LABEL_INCHES
        below = self._bar is not None and not beside
        right = RIGHT + (BAR_GAP + BAR_WIDTH + BAR_TEXT if beside else 0.0)
        total_width = max(LEFT + width + right, LEAST_WIDTH_INCHES)
        columns = _legend_columns(labels, total_width - 0.2)
        rows = -(-len(labels) // columns)
        bottom = BOTTOM + LEGEND_ROW * rows + (0.1 if rows else 0.0)
        bar_bottom = bottom - 0.05
        bottom += BAR_WIDTH + 0.55 if below else 0.0
        total_height = bottom + height + TOP
        self.figure.set_size_inches(total_width, total_height)
        left = LEFT + (total_width - LEFT - width - right) / 2.0

        def place(x: float, y: float, w: float, h: float) -> tuple[float, float, float, float]:
            return x / total_width, y / total_height, w / total_width, h / total_height

        self.axes.set_position(place(left, bottom, width, height))
        if self._bar is not None and beside:
            self._bar.set_position(place(left + width + BAR_GAP, bottom, BAR_WIDTH, height))
        elif self._bar is not None:
            self._bar.set_position(place(left, bar_bottom, width, BAR_WIDTH))
        self.figure.text(
            0.5,
            1.0 - 0.14 / total_height,
            shortened(self._title, int(total_width * 10.5)),
            ha="center",
            va="top",
            fontsize=11,
            parse_math=False,
        )
        if labels:
            self.figure.legend(
                handles,
                labels,
                loc="lower center",
                ncols=columns,
                frameon=False,
                fontsize=9,
                borderaxespad=0.45,
                labelspacing=1.0,
                handletextpad=0.5,
                columnspacing=1.2,
            )
        return self.figure

    @property
    def _height(self) -> float:
        return self.area.height * self.scale

    def _cells_a_block(self, frame: GridFrame) -> int:
        dots = frame.resolution_m * self.scale * DOTS_PER_INCH
        return max(1, int(np.ceil(LEAST_CELL_DOTS / dots - 1e-9)))

    def _mark(self, places_m: Places, mark: Mark, remark: str = "", fill: Any = "none") -> None:
        x, y = np.array(places_m).T
        self.axes.scatter(
            x,
            y,
            s=mark.size**2,
            marker=mark.marker,
            facecolors=mark.colour if mark.marker == "x" else fill,
            edgecolors=None if mark.marker == "x" else mark.colour,
            linewidths=1.4,
            path_effects=_halo(),
            label=mark.label + remark,
            zorder=5,
        )


def shortened(text: str, most: int) -> str:
    """Text of no more than ``most`` characters, its middle left out where there are more.

    Examples
    --------
    >>> shortened("a very long name: power map", 15)
    'a very…ower map'
    """
    text = printable(text)
    if len(text) <= most:
        return text
    start = (most - 1) * 3 // 7
    return f"{text[:start]}…{text[len(text) - (most - 1 - start) :]}"


def _legend_columns(labels: Sequence[str], width: float) -> int:
    """The most columns that fit into a width [inches]; they are filled one after the other."""
    entries = [LEGEND_HANDLE + LEGEND_LETTER * len(label) for label in labels]
    for columns in range(len(labels), 1, -1):
        long, more = divmod(len(labels), columns)
        ends = np.cumsum([long + (number < more) for number in range(columns)])
        widest = [max(part) for part in np.split(np.array(entries), ends[:-1])]
        if sum(widest) <= width:
            return columns
    return 1


def _halo() -> list[patheffects.AbstractPathEffect]:
    return [patheffects.withStroke(linewidth=2.5, foreground="white")]
