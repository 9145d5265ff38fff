"""The occupancy grid: which cells laser rays end in, and which they pass.

Each ray visits exactly the cells that it crosses. A ray that grazes a wall passes through cells
that the wall runs through before it meets it; it says nothing about cells so close to the surface.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, transformed
from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.mapping.key_scans import KeyScan

MARGIN_M = 0.5
SURFACE_CELLS = 1.0
"""Rays say nothing about cells this near to the surface that they meet, but the last."""
MOST_GRAZING_CELLS = 10.0
UNDER_ROBOT_M = 0.1
SHORT_STEP_M = 1.0


def map_frame(scans: Sequence[KeyScan], pose: FloatArray, *, cell_m: float) -> GridFrame:
    """A grid around all returns; cell corners lie at whole multiples of the cell."""
    low, high = pose[:, :2].min(axis=0), pose[:, :2].max(axis=0)
    for scan, place in zip(scans, pose, strict=True):
        points = transformed(place, scan.end_m)
        low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    first = np.floor((low - MARGIN_M) / cell_m)
    columns, rows = (np.ceil((high + MARGIN_M) / cell_m) - first).astype(int)
    origin = first * cell_m
    return GridFrame(cell_m, (float(origin[0]), float(origin[1])), (int(rows), int(columns)))


def ray_counts(
    scans: Sequence[KeyScan], pose: FloatArray, frame: GridFrame
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """How many rays end in each cell, and how many pass it, shapes (H, W)."""
    hits = np.zeros(frame.shape, dtype=np.int32)
    misses = np.zeros(frame.shape, dtype=np.int32)
    corner = np.array(frame.origin_m)
    for scan, place in zip(scans, pose, strict=True):
        start = (transformed(place, scan.origin_m) - corner) / frame.resolution_m
        end = (transformed(place, scan.end_m) - corner) / frame.resolution_m
        normal = transformed(np.array([0.0, 0.0, place[2]]), scan.normal)
        _count(hits, misses, start, end, normal)
    return hits, misses


def drawn_map(
    scans: Sequence[KeyScan], pose: FloatArray, *, cell_m: float, occupied_share: float
) -> OccupancyGrid:
    """The geometric map that key scans at their poses show.

    Parameters
    ----------
    scans : sequence of KeyScan
    pose : ndarray, shape (K, 3)
    cell_m : float
    occupied_share : float
        A cell is occupied if at least this share of the rays that reach it end in it.
    """
    frame = map_frame(scans, pose, cell_m=cell_m)
    hits, misses = ray_counts(scans, pose, frame)
    seen = hits + misses
    occupied = (hits > 0) & (hits >= occupied_share * seen)
    free = ((seen > 0) | stood_on(pose, frame)) & ~occupied
    return OccupancyGrid(frame, occupied, free)


def stood_on(pose: FloatArray, frame: GridFrame) -> NDArray[np.bool_]:
    """Cells under the middle of the robot, which no ray need pass, shape (H, W).

    The way from one pose to the next is taken as straight where it is short.
    """
    reach = np.arange(-UNDER_ROBOT_M, UNDER_ROBOT_M + 1e-9, 0.5 * frame.resolution_m)
    x, y = np.meshgrid(reach, reach)
    disc = np.stack([x, y], axis=-1)[np.hypot(x, y) <= UNDER_ROBOT_M]
    start, step = pose[:-1, :2], np.diff(pose[:, :2], axis=0)
    short = np.hypot(step[:, 0], step[:, 1]) < SHORT_STEP_M
    share = np.linspace(0.0, 1.0, int(SHORT_STEP_M / UNDER_ROBOT_M) + 1)
    way = start[short, None] + share[:, None] * step[short, None]
    under = np.zeros(frame.shape, dtype=np.bool_)
    for points in (pose[:, :2], way.reshape(-1, 2)):
        for offset in disc:
            cells = frame.cells(points + offset)
            under[cells[:, 0], cells[:, 1]] = True
    return under


@njit(cache=True, nogil=True)
def _count(
    hits: NDArray[np.int32],
    misses: NDArray[np.int32],
    start: FloatArray,
    end: FloatArray,
    normal: FloatArray,
) -> None:
    rows, columns = hits.shape
    for ray in range(len(end)):
        x, y = start[ray]
        dx, dy = end[ray, 0] - x, end[ray, 1] - y
        length = np.hypot(dx, dy)
        last_column, last_row = int(np.floor(end[ray, 0])), int(np.floor(end[ray, 1]))
        if 0 <= last_row < rows and 0 <= last_column < columns:
            hits[last_row, last_column] += 1
        if length < 1e-9:
            continue
        cos, sin = dx / length, dy / length
        facing = abs(cos * normal[ray, 0] + sin * normal[ray, 1])
        near = SURFACE_CELLS / max(facing, SURFACE_CELLS / MOST_GRAZING_CELLS)
        if normal[ray, 0] == 0.0 and normal[ray, 1] == 0.0:
            near = SURFACE_CELLS
        stop = length - near
        column, row = int(np.floor(x)), int(np.floor(y))
        step_column = 1 if cos > 0 else -1
        step_row = 1 if sin > 0 else -1
        per_column = 1.0 / abs(cos) if abs(cos) > 1e-12 else 1e30
        per_row = 1.0 / abs(sin) if abs(sin) > 1e-12 else 1e30
        next_column = ((column + 1 - x) if cos > 0 else (x - column)) * per_column
        next_row = ((row + 1 - y) if sin > 0 else (y - row)) * per_row
        left = 0.0
        # A cell counts as passed if the ray leaves it before it comes near the surface.
        while left < stop:
            left = min(next_column, next_row)
            if left <= stop and 0 <= row < rows and 0 <= column < columns:
                misses[row, column] += 1
            if next_column < next_row:
                next_column += per_column
                column += step_column
            else:
                next_row += per_row
                row += step_row
