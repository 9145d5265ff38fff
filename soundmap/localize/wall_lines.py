"""Where exactly the walls stand, learned from the run itself.

A cell of the map says only that a surface is somewhere within 5 cm. The laser returns of the whole
run say where: those about each surface cell are fitted by a short line, and poses are then matched
to the lines instead of the cells (surface elements as in Biber and Strasser, "The normal
distributions transform", IROS 2003). The lines of a run and its poses could still drift together,
so the lines are laid in the cells again: `soundmap.localize.registration`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from soundmap.geometry import FloatArray
from soundmap.localize.map_fit import Surface, add_residual

REACH_M = 0.15
"""Returns farther than this from a surface cell do not belong to it."""
LEAST_POINTS = 6
FLATNESS = 0.2
"""Greatest ratio of the variances across and along a line that still is one. Where noise leaves
none, the map's own cells serve as well."""
SURE_RAD = np.radians(3.0)
"""How well a straight wall of the map tells its direction; what is no such wall needs returns that
tell as well."""


@dataclass(frozen=True)
class WallLines:
    """A line at every surface cell that enough returns lie about.

    Attributes
    ----------
    normal : ndarray, shape (C, 2)
        Unit vectors; zero where there is no line.
    offset_m : ndarray, shape (C,)
        Points p of line c satisfy normal . p = offset [m].
    """

    normal: FloatArray
    offset_m: FloatArray


def wall_lines(surface: Surface, points_m: Iterable[FloatArray]) -> WallLines:
    """Lines through the returns about each surface cell and its neighbours.

    Parameters
    ----------
    surface : Surface
    points_m : iterable of ndarray, shape (P, 2)
        Laser returns of the whole run in the map frame [m], part by part.
    """
    moments = np.zeros((len(surface.centre_m), 6))
    for part in points_m:
        _add_moments(
            moments,
            surface.nearest,
            surface.centre_m,
            surface.corner_m,
            surface.resolution_m,
            np.ascontiguousarray(part),
            REACH_M,
        )
    return _fitted_lines(surface, moments)


def _fitted_lines(surface: Surface, moments: FloatArray) -> WallLines:
    """The line through each cell's returns; where they are few, turned towards the map's wall."""
    count, x, y, xx, xy, yy = _with_neighbours(surface.own, surface.cell, moments).T
    total = np.maximum(count, 1.0)
    mean = np.stack([x, y], axis=-1) / total[:, None]
    var_x, var_y = xx / total - mean[:, 0] ** 2, yy / total - mean[:, 1] ** 2
    cov = xy / total - mean[:, 0] * mean[:, 1]
    half_sum, half_gap = 0.5 * (var_x + var_y), np.hypot(0.5 * (var_x - var_y), cov)
    along, across = half_sum + half_gap, np.maximum(half_sum - half_gap, 0.0)
    exists = (count >= LEAST_POINTS) & (across <= FLATNESS * along) & (along > 1e-6)
    tilt = 0.5 * np.arctan2(2.0 * cov, var_x - var_y)
    # The direction of a line errs by the scatter across it, that of the map's wall by SURE_RAD.
    doubt = across / np.maximum(along * (count - 2.0), 1e-12)
    wall = np.arctan2(-surface.normal[:, 0], surface.normal[:, 1])
    is_wall = np.any(surface.normal != 0.0, axis=1)
    turn = (wall - tilt + 0.5 * np.pi) % np.pi - 0.5 * np.pi
    tilt = tilt + np.where(is_wall, doubt / (doubt + SURE_RAD**2), 0.0) * turn
    exists &= is_wall | (doubt <= SURE_RAD**2)
    normal = np.stack([-np.sin(tilt), np.cos(tilt)], axis=-1) * exists[:, None]
    # Moments are taken about each cell's own lower-left corner of the map.
    return WallLines(normal, np.sum(normal * (mean + surface.corner_m), axis=1))


def has_line(surface: Surface, lines: WallLines, points_m: FloatArray) -> NDArray[np.bool_]:
    """Whether the surface cell nearest to each point has a line, shape (P,); map frame [m]."""
    cell = np.floor((points_m - surface.corner_m) / surface.resolution_m).astype(np.int64)[:, ::-1]
    inside = np.all((cell >= 0) & (cell < surface.nearest.shape), axis=1)
    row, column = np.where(inside[:, None], cell, 0).T
    return inside & np.any(lines.normal[surface.nearest[row, column]] != 0.0, axis=1)


def line_pull(
    surface: Surface,
    lines: WallLines,
    pose: FloatArray,
    points_m: NDArray[np.floating],
    first: NDArray[np.int64],
    counts: NDArray[np.bool_],
    *,
    sigma_m: float,
    kernel_m: float,
) -> tuple[FloatArray, FloatArray]:
    """Normal equations of fitting the points of each pose to the lines nearest to them.

    Parameters and results are those of `soundmap.localize.map_fit.point_pull`; points without a
    line nearby do not count, nor do those that ``counts``, shape (P,), leaves out.
    """
    return _line_pull(
        surface.nearest,
        surface.corner_m,
        surface.resolution_m,
        lines.normal,
        lines.offset_m,
        np.ascontiguousarray(pose),
        np.ascontiguousarray(points_m, dtype=np.float32),
        first,
        counts,
        sigma_m,
        kernel_m,
    )


@njit(cache=True, nogil=True)
def _add_moments(
    moments: FloatArray,
    nearest: NDArray[np.int32],
    centre: FloatArray,
    corner: FloatArray,
    resolution: float,
    points: FloatArray,
    reach: float,
) -> None:
    """Adds count, sums and sums of products of the points nearest to each surface cell, (C, 6)."""
    rows, columns = nearest.shape
    for i in range(len(points)):
        x, y = points[i, 0] - corner[0], points[i, 1] - corner[1]
        column, row = int(np.floor(x / resolution)), int(np.floor(y / resolution))
        if not (0 <= row < rows and 0 <= column < columns):
            continue
        cell = nearest[row, column]
        if np.hypot(points[i, 0] - centre[cell, 0], points[i, 1] - centre[cell, 1]) > reach:
            continue
        moments[cell, 0] += 1.0
        moments[cell, 1] += x
        moments[cell, 2] += y
        moments[cell, 3] += x * x
        moments[cell, 4] += x * y
        moments[cell, 5] += y * y


@njit(cache=True, nogil=True)
def _with_neighbours(
    own: NDArray[np.int32], cell: NDArray[np.int64], moments: FloatArray
) -> FloatArray:
    """Moments of each surface cell together with those of the surface cells around it."""
    rows, columns = own.shape
    summed = np.zeros_like(moments)
    for c in range(len(cell)):
        for row in range(max(cell[c, 0] - 1, 0), min(cell[c, 0] + 2, rows)):
            for column in range(max(cell[c, 1] - 1, 0), min(cell[c, 1] + 2, columns)):
                other = own[row, column]
                if other >= 0:
                    summed[c] += moments[other]
    return summed


@njit(cache=True, nogil=True)
def _line_pull(
    nearest: NDArray[np.int32],
    corner: FloatArray,
    resolution: float,
    normal: FloatArray,
    offset: FloatArray,
    pose: FloatArray,
    points: NDArray[np.float32],
    first: NDArray[np.int64],
    counts: NDArray[np.bool_],
    sigma: float,
    kernel: float,
) -> tuple[FloatArray, FloatArray]:
    rows, columns = nearest.shape
    information = np.zeros((len(pose), 3, 3))
    pull = np.zeros((len(pose), 3))
    for k in range(len(pose)):
        cos, sin = np.cos(pose[k, 2]), np.sin(pose[k, 2])
        for i in range(first[k], first[k + 1]):
            if not counts[i]:
                continue
            lever_x = cos * points[i, 0] - sin * points[i, 1]
            lever_y = sin * points[i, 0] + cos * points[i, 1]
            x, y = pose[k, 0] + lever_x, pose[k, 1] + lever_y
            column = int(np.floor((x - corner[0]) / resolution))
            row = int(np.floor((y - corner[1]) / resolution))
            if not (0 <= row < rows and 0 <= column < columns):
                continue
            line = nearest[row, column]
            slope_x, slope_y = normal[line]
            off = slope_x * x + slope_y * y - offset[line]
            if (slope_x == 0.0 and slope_y == 0.0) or abs(off) > 3.0 * kernel:
                continue
            weight = np.exp(-0.5 * (off / kernel) ** 2) / (sigma * sigma)
            add_residual(information[k], pull[k], off, slope_x, slope_y, lever_x, lever_y, weight)
    return information, pull
