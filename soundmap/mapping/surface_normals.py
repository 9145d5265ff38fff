"""Which way the surface faces where a laser ray met it: a line through the neighbouring returns."""

from __future__ import annotations

import numpy as np
from numba import njit

from soundmap.geometry import FloatArray

NEIGHBOURS = 5
"""Returns on either side through which a line is laid, as far as they reach."""
REACH_M = 0.12
"""They lie within this distance, or within three times the spacing of the rays, if that is more."""
LEAST_RETURNS = 3
MOST_THICKNESS = 0.3
"""A line if the returns scatter across it by less than this share of the scatter along it."""


def surface_normals(origin_m: FloatArray, end_m: FloatArray) -> FloatArray:
    """Unit normals towards the scanner of the surfaces that neighbouring rays met.

    Parameters
    ----------
    origin_m, end_m : ndarray, shapes (P, 2)
        Rays in the order of their bearings [m].

    Returns
    -------
    ndarray, shape (P, 2)
        Zero where the neighbours do not lie on a line: at corners, edges and single returns.
    """
    if len(end_m) < LEAST_RETURNS:
        return np.zeros((len(end_m), 2))
    step = end_m - origin_m
    bearing = np.arctan2(step[:, 1], step[:, 0])
    turn = np.abs((np.diff(bearing) + np.pi) % (2 * np.pi) - np.pi)
    reach = np.maximum(REACH_M, 3.0 * float(np.median(turn)) * np.hypot(step[:, 0], step[:, 1]))
    return _normals(np.ascontiguousarray(origin_m), np.ascontiguousarray(end_m), reach)


@njit(cache=True, nogil=True)
def _normals(origin: FloatArray, end: FloatArray, reach: FloatArray) -> FloatArray:
    normal = np.zeros(end.shape)
    for i in range(len(end)):
        count = 0
        sx = sy = sxx = sxy = syy = 0.0
        for j in range(max(i - NEIGHBOURS, 0), min(i + NEIGHBOURS + 1, len(end))):
            dx, dy = end[j, 0] - end[i, 0], end[j, 1] - end[i, 1]
            if dx * dx + dy * dy <= reach[i] * reach[i]:
                count += 1
                sx += dx
                sy += dy
                sxx += dx * dx
                sxy += dx * dy
                syy += dy * dy
        if count < LEAST_RETURNS:
            continue
        sxx -= sx * sx / count
        sxy -= sx * sy / count
        syy -= sy * sy / count
        root = np.sqrt((sxx - syy) * (sxx - syy) + 4.0 * sxy * sxy)
        along, across = 0.5 * (sxx + syy + root), max(0.5 * (sxx + syy - root), 0.0)
        if along <= 1e-12 or across > MOST_THICKNESS * MOST_THICKNESS * along:
            continue
        angle = 0.5 * np.arctan2(2.0 * sxy, sxx - syy)
        nx, ny = -np.sin(angle), np.cos(angle)
        if nx * (origin[i, 0] - end[i, 0]) + ny * (origin[i, 1] - end[i, 1]) < 0.0:
            nx, ny = -nx, -ny
        normal[i, 0], normal[i, 1] = nx, ny
    return normal
