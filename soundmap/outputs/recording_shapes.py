"""What stands still in a recording: floor, robot, places, and the colours they have."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
from matplotlib import colormaps
from numpy.typing import NDArray

from soundmap.geometry import FloatArray
from soundmap.grid import OccupancyGrid
from soundmap.outputs.wording import ellipse_95
from soundmap.sound import SourceList

FLOOR_Z, POWER_Z, LINE_Z = 0.0, 0.01, 0.03
"""Heights at which flat things are drawn, one above the other [m]."""
WALL_RGBA, OPEN_RGBA, UNKNOWN_RGBA = (90, 95, 105, 255), (236, 238, 240, 255), (34, 38, 46, 255)
BLUE, VERMILION, GREEN = (0, 114, 178), (213, 94, 0), (0, 158, 115)
PURPLE, DARK, GREY = (117, 70, 160), (40, 44, 52), (130, 134, 142)
WHITE = (255, 255, 255)
ROBOT_M, RING_M = 0.2, 0.18
"""Radius of the robot, and of the ring round a source [m]."""


def draw_floor(stream: rr.RecordingStream, room: OccupancyGrid) -> None:
    """The geometric map, static: walls, open floor, and what nobody has seen."""
    rgba = np.empty((*room.frame.shape, 4), dtype=np.uint8)
    rgba[:] = UNKNOWN_RGBA
    rgba[room.free], rgba[room.occupied] = OPEN_RGBA, WALL_RGBA
    grid = floor_picture(rgba, room.frame.resolution_m, room.frame.origin_m, FLOOR_Z)
    stream.log("/world/map", grid, static=True)


def draw_robot(stream: rr.RecordingStream) -> None:
    """A disc with a line to its front."""
    height = np.array([0.0, 0.0, LINE_Z])
    front = np.array([[0.0, 0.0, 0.0], [ROBOT_M, 0.0, 0.0]])
    lines = [circle(ROBOT_M) + height, front + height]
    body = rr.LineStrips3D(lines, colors=[GREEN], radii=rr.Radius.ui_points(2.0))
    stream.log("/world/robot/body", body, static=True)


def draw_places(
    stream: rr.RecordingStream,
    places_m: Sequence[tuple[float, float]],
    labels: Sequence[str],
    colours: Sequence[tuple[int, int, int]],
) -> None:
    """Labelled points on the floor, static; an empty list draws nothing."""
    if not places_m:
        return
    at = raised(as_points(places_m), 4.0 * LINE_Z)
    dots = rr.Points3D(at, colors=list(colours), radii=rr.Radius.ui_points(2.5))
    stream.log("/world/result/sources", dots, static=True)
    rings = rr.LineStrips3D(
        list(circle(RING_M) + at[:, None, :]),
        colors=list(colours),
        radii=rr.Radius.ui_points(1.5),
    )
    stream.log("/world/result/source_rings", rings, static=True)
    # a label has the colour of its point: white ones are read best, and need no dot
    names = rr.Points3D(at, colors=[WHITE], radii=[0.0], labels=list(labels), show_labels=True)
    stream.log("/world/result/source_labels", names, static=True)


def draw_ellipses(stream: rr.RecordingStream, sources: SourceList) -> None:
    """Where the sources lie with 95 %, as far as that is known."""
    lines = [
        raised(np.array([source.x_m, source.y_m]) + ellipse_95(source.fit.covariance_m2), 0.13)
        for source in sources
        if source.fit is not None
    ]
    if lines:
        ellipses = rr.LineStrips3D(lines, colors=[VERMILION], radii=rr.Radius.ui_points(1.0))
        stream.log("/world/result/source_ellipses", ellipses, static=True)


def draw_images(stream: rr.RecordingStream, sources: SourceList) -> None:
    """Mirror images; whose they are shows when one is pointed at."""
    images = sources.reflections
    if not images:
        return
    at = raised(as_points([(image.x_m, image.y_m) for image in images]), 4.0 * LINE_Z)
    owners = ["" if image.source is None else f" of S{image.source + 1}" for image in images]
    labels = [f"mirror image{owner}" for owner in owners]
    dots = rr.Points3D(
        at, colors=[GREY], radii=rr.Radius.ui_points(3.0), labels=labels, show_labels=False
    )
    stream.log("/world/result/mirror_images", dots, static=True)


def floor_picture(
    rgba: NDArray[np.uint8], cell_m: float, corner_m: tuple[float, float], z_m: float
) -> rr.GridMap:
    """A picture on the floor; the rows of a `GridMap` run from the top down."""
    rows, columns = rgba.shape[:2]
    is_opaque = bool((rgba[..., 3] == 255).all())
    form = rr.components.ImageFormat(
        width=columns, height=rows, color_model="RGBA", channel_datatype="U8"
    )
    return rr.GridMap(
        data=np.ascontiguousarray(rgba[::-1]).tobytes(),
        format=form,
        cell_size=cell_m,
        translation=[*corner_m, z_m],
        opacity=None if is_opaque else 0.999,  # below 1, or what is transparent is drawn black
        draw_order=z_m,
    )


def coloured(share: FloatArray, colours: str) -> NDArray[np.uint8]:
    """Colours of a scale from 0 to 1, shape (H, W, 4); NaN is transparent."""
    seen = ~np.isnan(share)
    rgba = np.asarray(colormaps[colours](np.where(seen, share, 0.0), bytes=True), dtype=np.uint8)
    rgba[~seen] = 0
    return rgba


def circle(radius_m: float) -> FloatArray:
    """A closed line round the origin, flat, shape (41, 3)."""
    angle = np.linspace(0.0, 2.0 * np.pi, 41)
    return raised(radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1), 0.0)


def raised(points: FloatArray, z_m: float) -> FloatArray:
    """x, y, z from x, y, any leading axes."""
    return np.concatenate([points, np.full((*points.shape[:-1], 1), z_m)], axis=-1)


def as_points(places: Sequence[tuple[float, float]]) -> FloatArray:
    """Places as an array, shape (P, 2), also if there are none."""
    return np.array(places, dtype=np.float64).reshape(-1, 2)
