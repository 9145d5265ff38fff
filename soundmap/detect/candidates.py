"""Candidates: places where a sound may come from, on surfaces, behind them, or in the open."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from soundmap.detect.evidence import Evidence
from soundmap.geometry import FloatArray

HIT_CELL_M = 0.04
"""Laser hits within such a cell are one point of a surface."""
LEAST_HITS = 3
SURFACE_STEP_M = 0.10
OPEN_STEP_M = 0.25
SURROUNDINGS_M = 2.2
"""How far from surfaces candidates lie: mirror images of what stands 1 m off a wall are 2 m off."""
REACH_M = 9.0
HITS_AT_ONCE = 2000


class Kind(IntEnum):
    """Where a candidate lies as the lasers see it."""

    SURFACE = 0
    """On a surface: a source."""
    BEHIND = 1
    """Behind a surface: the mirror image of a source."""
    OPEN = 2
    """In the open: a source that the lasers do not see."""


@dataclass(frozen=True)
class Candidates:
    """Where sound may come from.

    Attributes
    ----------
    surface_m : ndarray, shape (H, 2)
        Points of the surfaces, each the mean of the laser hits in a cell [m].
    place_m : ndarray, shape (C, 2)
        Candidates in the map frame [m].
    kind : ndarray of int, shape (C,)
        `Kind` of each; those on surfaces come first.
    """

    surface_m: FloatArray
    place_m: FloatArray
    kind: NDArray[np.int64]


def candidate_places(evidence: Evidence) -> Candidates:
    """Candidates around all that the lasers saw during the run."""
    from scipy.spatial import cKDTree

    surface = _surface_points(evidence)
    if not len(surface):
        return Candidates(surface, surface, np.empty(0, dtype=np.int64))
    cells = np.floor(surface / SURFACE_STEP_M).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    on = surface[np.sort(first)]
    low, high = surface.min(axis=0) - SURROUNDINGS_M, surface.max(axis=0) + SURROUNDINGS_M
    x, y = np.meshgrid(*(np.arange(a, b, OPEN_STEP_M) for a, b in zip(low, high, strict=True)))
    around = np.stack([x.ravel(), y.ravel()], axis=-1)
    distance, _ = cKDTree(surface).query(around, distance_upper_bound=SURROUNDINGS_M)
    off = around[np.isfinite(distance) & (distance > 0.15)]
    kinds = [(Kind.SURFACE, len(on)), (Kind.BEHIND, len(off)), (Kind.OPEN, len(off))]
    kind = np.concatenate([np.full(count, int(each), dtype=np.int64) for each, count in kinds])
    return Candidates(surface, np.concatenate([on, off, off]), kind)


def _surface_points(evidence: Evidence) -> FloatArray:
    """Means of the laser hits in each cell that was hit often enough."""
    bearings = evidence.range_m.shape[1]
    turn = evidence.handedness * 2.0 * np.pi * np.arange(bearings) / bearings
    cells: dict[tuple[int, int], list[float]] = {}
    for start in range(0, len(evidence), HITS_AT_ONCE):
        part = slice(start, start + HITS_AT_ONCE)
        distance = evidence.range_m[part].astype(np.float64)
        angle = evidence.axis_rad[part, None] + turn
        x = evidence.place_m[part, :1] + distance * np.cos(angle)
        y = evidence.place_m[part, 1:] + distance * np.sin(angle)
        near = np.isfinite(distance) & (distance < REACH_M)
        hits = np.stack([x[near], y[near]], axis=-1)
        key, index, count = np.unique(
            np.floor(hits / HIT_CELL_M).astype(np.int64),
            axis=0,
            return_inverse=True,
            return_counts=True,
        )
        index = index.ravel()
        sums = np.stack([np.bincount(index, hits[:, i], len(key)) for i in (0, 1)], axis=-1)
        for (column, row), (sum_x, sum_y), hit in zip(key, sums, count, strict=True):
            total = cells.setdefault((int(column), int(row)), [0.0, 0.0, 0.0])
            total[0] += sum_x
            total[1] += sum_y
            total[2] += hit
    points = np.array(list(cells.values())).reshape(-1, 3)
    points = points[points[:, 2] >= LEAST_HITS]
    points = points[np.lexsort((points[:, 1] / points[:, 2], points[:, 0] / points[:, 2]))]
    return np.asarray(points[:, :2] / points[:, 2:])
