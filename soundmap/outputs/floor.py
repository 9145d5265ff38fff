"""The floor plan that every picture of a place is drawn on: size, walls, metres, labels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from soundmap.geometry import FloatArray
from soundmap.grid import GridFrame, OccupancyGrid

WALL, UNKNOWN, OPEN = 0.25, 0.90, 1.0
DIMMED_UNKNOWN, DIMMED_OPEN = 0.80, 0.90
"""Grey values of the geometric map, 0 black to 1 white."""

MARGIN_M = 0.75
LEAST_SIDE_M = 2.0
GREATEST_ASPECT = 4.0
LONG_SIDE_INCHES = 8.0


@dataclass(frozen=True)
class Area:
    """A rectangle of the map frame.

    Attributes
    ----------
    left, right, bottom, top : float
        Edges [m].
    """

    left: float
    right: float
    bottom: float
    top: float

    @property
    def width(self) -> float:
        """Extent along x [m]."""
        return self.right - self.left

    @property
    def height(self) -> float:
        """Extent along y [m]."""
        return self.top - self.bottom


def area_of_interest(points_m: Iterable[FloatArray], room: OccupancyGrid | None) -> Area:
    """The part of the map to show: where the run took place, as far as the map reaches.

    Parameters
    ----------
    points_m : iterable of ndarray, shapes (..., 2)
        Everything that must be seen [m]. Without any, the whole known map is shown.
    room : OccupancyGrid or None
    """
    known = None if room is None else _bounds(_known_corners(room))
    run = _bounds(np.concatenate([np.zeros((0, 2)), *points_m]))
    if run is None:
        low, high = known if known is not None else (np.zeros(2), np.zeros(2))
    else:
        low, high = run
        if known is not None:  # some surroundings, but not beyond the edge of the known map
            around = max(2.0, 0.1 * float(np.max(high - low)))
            low = np.minimum(low, np.maximum(low - around, known[0]))
            high = np.maximum(high, np.minimum(high + around, known[1]))
    low, high = low - MARGIN_M, high + MARGIN_M
    side = np.maximum(high - low, LEAST_SIDE_M)
    side = np.maximum(side, side.max() / GREATEST_ASPECT)
    left, bottom = (low + high - side) / 2.0
    return Area(float(left), float(left + side[0]), float(bottom), float(bottom + side[1]))


def floor_plan(
    area: Area, room: OccupancyGrid | None, title: str, *, dimmed: bool = False
) -> tuple[Figure, Axes]:
    """A figure of a size that suits the area, with the geometric map and metres on its axes.

    Parameters
    ----------
    area : Area
    room : OccupancyGrid or None
    title : str
    dimmed : bool
        Keep white for the data: open space is grey, too.
    """
    unknown, free = (DIMMED_UNKNOWN, DIMMED_OPEN) if dimmed else (UNKNOWN, OPEN)
    scale = LONG_SIDE_INCHES / max(area.width, area.height)
    figure = Figure(
        figsize=(max(area.width * scale, 4.0) + 1.8, area.height * scale + 1.3),
        layout="constrained",
    )
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_facecolor(str(unknown))
    if room is not None:
        shade = np.full(room.frame.shape, unknown, dtype=np.float32)
        shade[room.free], shade[room.occupied] = free, WALL
        part, extent = cropped(shade, room.frame, area)
        axes.imshow(part, origin="lower", extent=extent, cmap="gray", vmin=0, vmax=1)
    axes.set_aspect("equal")
    axes.set_xlim(area.left, area.right)
    axes.set_ylim(area.bottom, area.top)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_title(title, parse_math=False)
    return figure, axes


def draw_wall_outlines(axes: Axes, room: OccupancyGrid, area: Area) -> None:
    """Thin lines round the walls, over whatever colours lie on them."""
    part, (left, right, bottom, top) = cropped(room.occupied, room.frame, area)
    if min(part.shape) < 2 or not part.any() or part.all():
        return
    half = room.frame.resolution_m / 2.0
    x = np.linspace(left + half, right - half, part.shape[1])
    y = np.linspace(bottom + half, top - half, part.shape[0])
    axes.contour(x, y, part.astype(np.float32), [0.5], colors=[str(WALL)], linewidths=0.7)


def cropped(
    values: NDArray[np.generic], frame: GridFrame, area: Area
) -> tuple[NDArray[np.generic], tuple[float, float, float, float]]:
    """The cells of a grid that reach into an area, and the edges of that part [m].

    A site may have a hundred million cells, of which a picture shows a corner.
    """
    step, (x, y), (rows, columns) = frame.resolution_m, frame.origin_m, frame.shape
    first_column, last_column = _span(area.left - x, area.right - x, step, columns)
    first_row, last_row = _span(area.bottom - y, area.top - y, step, rows)
    part = values[first_row:last_row, first_column:last_column]
    left, right = x + first_column * step, x + last_column * step
    return part, (left, right, y + first_row * step, y + last_row * step)


def draw_places(axes: Axes, places_m: Sequence[tuple[float, float]], area: Area) -> None:
    """Circles labelled S1, S2, ... in the order given, the labels inside the area."""
    if not places_m:
        return
    x, y = np.array(places_m).T
    outline: list[patheffects.AbstractPathEffect] = [
        patheffects.withStroke(linewidth=2.5, foreground="white")
    ]
    axes.plot(
        x,
        y,
        linestyle="none",
        marker="o",
        markersize=11,
        markerfacecolor="none",
        markeredgecolor="black",
        markeredgewidth=1.6,
        path_effects=outline,
        label="local maxima",
    )
    for number, place in enumerate(places_m, start=1):
        at_right_edge = place[0] > area.right - 0.06 * area.width
        at_top = place[1] > area.top - 0.06 * area.height
        text = axes.annotate(
            f"S{number}",
            place,
            xytext=(-7 if at_right_edge else 7, -16 if at_top else 7),
            textcoords="offset points",
            horizontalalignment="right" if at_right_edge else "left",
            weight="bold",
        )
        text.set_path_effects(outline)


def _span(start_m: float, end_m: float, step: float, count: int) -> tuple[int, int]:
    first = min(max(int(np.floor(start_m / step)), 0), count - 1)
    last = min(max(int(np.ceil(end_m / step)), first + 1), count)
    return first, last


def _known_corners(room: OccupancyGrid) -> FloatArray:
    """Corners of the rectangle around everything that is not unknown, shape (2, 2) or (0, 2)."""
    known = room.occupied | room.free
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    if not len(rows):
        return np.zeros((0, 2))
    return room.frame.centres([[rows[0], columns[0]], [rows[-1], columns[-1]]])


def _bounds(points: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    return (points.min(axis=0), points.max(axis=0)) if len(points) else None
