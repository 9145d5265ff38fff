"""Walls: the straight surfaces that lasers saw, which mirror sound."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soundmap.detect.evidence import Evidence
from soundmap.geometry import FloatArray

HIT_CELL_M = 0.04
"""Laser hits within such a cell are one point of a surface."""
LEAST_HITS = 3
PIECES = 8
"""Surfaces are told by points this many times finer than cells."""
NEIGHBOURS, BESIDE_CELLS = 7, 2.5
"""Points that tell the direction of a surface: at most so many, at most so many cells away."""
SURFACE_REACH_M = 9.0
HITS_AT_ONCE = 2000
MOST_WALLS = 12
LEAST_LENGTH_M = 1.0
DIRECTIONS = 180
SLICE_M = 0.05
"""Spacing of the parallels among which a wall is sought."""
ON_WALL_M = 0.06


def surface_points(evidence: Evidence) -> FloatArray:
    """Means of the laser hits in each cell that was hit often enough, shape (H, 2) [m]."""
    bearings = evidence.range_m.shape[1]
    turn = evidence.handedness * 2.0 * np.pi * np.arange(bearings) / bearings
    cells = np.zeros((0, 2), dtype=np.int64)
    sums = np.zeros((0, 3))
    for start in range(0, len(evidence), HITS_AT_ONCE):
        part = slice(start, start + HITS_AT_ONCE)
        distance = evidence.range_m[part].astype(np.float64)
        angle = evidence.axis_rad[part, None] + turn
        x = evidence.place_m[part, :1] + distance * np.cos(angle)
        y = evidence.place_m[part, 1:] + distance * np.sin(angle)
        near = np.isfinite(distance) & (distance < SURFACE_REACH_M)
        hits = np.column_stack([x[near], y[near], np.ones(int(near.sum()))])
        cells = np.concatenate([cells, np.floor(hits[:, :2] / HIT_CELL_M).astype(np.int64)])
        cells, index = np.unique(cells, axis=0, return_inverse=True)
        sums = _sums(np.concatenate([sums, hits]), index.ravel(), len(cells))
    often = sums[:, 2] >= LEAST_HITS
    return np.asarray(sums[often, :2] / sums[often, 2:])


def surface_pieces(points_m: FloatArray) -> FloatArray:
    """Points along the surfaces, `PIECES` times finer.

    Where a source is on a surface must not hang on where the cells happen to lie.

    Parameters
    ----------
    points_m : ndarray, shape (H, 2)
        As `surface_points` gives them.

    Returns
    -------
    ndarray, shape (H * PIECES, 2)
        Evenly along a cell's length of the line through each point and its neighbours; less than
        that where these lie around it on all sides.

    Examples
    --------
    >>> x = np.arange(0.0, 1.0, HIT_CELL_M)
    >>> pieces = surface_pieces(np.column_stack([x, 2.0 + 0.0 * x]))
    >>> float(np.diff(pieces[:, 0]).max().round(6)), float(np.ptp(pieces[:, 1]).round(6))
    (0.005, 0.0)
    """
    from scipy.spatial import KDTree

    away, near = KDTree(points_m).query(
        points_m, k=1 + NEIGHBOURS, distance_upper_bound=BESIDE_CELLS * HIT_CELL_M
    )
    told = np.isfinite(away)[..., None]
    step = np.where(told, points_m[np.where(told[..., 0], near, 0)] - points_m[:, None], 0.0)
    count = told.sum(axis=1)
    step = np.where(told, step - step.sum(axis=1, keepdims=True) / count[:, None], 0.0)
    width, axes = np.linalg.eigh(np.einsum("hni,hnj->hij", step, step))
    straight = np.sqrt(np.maximum(width[:, 1] - width[:, 0], 0.0) / np.maximum(width[:, 1], 1e-12))
    along = HIT_CELL_M * ((np.arange(PIECES) + 0.5) / PIECES - 0.5)
    line = straight[:, None] * axes[:, :, 1]
    return np.asarray((points_m[:, None] + along[:, None] * line[:, None]).reshape(-1, 2))


def _sums(values: FloatArray, index: NDArray[np.intp], count: int) -> FloatArray:
    return np.stack([np.bincount(index, column, count) for column in values.T], axis=-1)


def wall_lines(points_m: FloatArray) -> FloatArray:
    r"""Straight lines that many points of surfaces lie on, the richest first.

    Parameters
    ----------
    points_m : ndarray, shape (H, 2)
        As `surface_points` gives them.

    Returns
    -------
    ndarray, shape (W, 3)
        Unit normal :math:`n` and offset :math:`o` [m] of each: its points have
        :math:`n \cdot p = o`.

    Examples
    --------
    >>> x = np.arange(0.0, 4.0, 0.04)
    >>> lines = wall_lines(np.column_stack([x, 2.0 + 0.0 * x]))
    >>> (lines * np.sign(lines[:, 1:2])).round(6).tolist()
    [[0.0, 1.0, 2.0]]
    """
    angle = np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    lines: list[FloatArray] = []
    left = np.asarray(points_m, dtype=np.float64)
    while len(lines) < MOST_WALLS and len(left) * HIT_CELL_M >= LEAST_LENGTH_M:
        line = _refined(left, _richest(left, normals))
        on = np.abs(left @ line[:2] - line[2]) < ON_WALL_M
        along = left[on] @ np.array([-line[1], line[0]])
        if 0.1 * len(np.unique(np.floor(along / 0.1))) < LEAST_LENGTH_M:
            break
        lines.append(line)
        left = left[~on]
    return np.array(lines).reshape(-1, 3)


def _richest(points_m: FloatArray, normals: FloatArray) -> FloatArray:
    """The slice two spacings wide that holds most points."""
    most, best = -1, np.zeros(3)
    for normal in normals:
        offset = points_m @ normal
        low = float(offset.min())
        held = np.bincount(np.floor((offset - low) / SLICE_M).astype(np.int64))
        pairs = held[:-1] + held[1:] if len(held) > 1 else held
        top = int(np.argmax(pairs))
        if pairs[top] > most:
            most, best = int(pairs[top]), np.append(normal, low + SLICE_M * (top + 1))
    return best


def _refined(points_m: FloatArray, line: FloatArray) -> FloatArray:
    """The line of least squares through the points near a line, three times closer in."""
    for tolerance in (0.08, 0.05, 0.04):
        near = points_m[np.abs(points_m @ line[:2] - line[2]) < tolerance]
        if len(near) < 10:
            break
        centre = near.mean(axis=0)
        _, _, axes = np.linalg.svd(near - centre, full_matrices=False)
        line = np.append(axes[1], axes[1] @ centre)
    return line
