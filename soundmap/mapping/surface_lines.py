"""The surface where a laser ray met it: a line through the neighbouring returns.

The line goes through as many returns as tell its direction: few where they lie far apart or hardly
scatter, and many where the scanner's noise is greater than their spacing. A return laid on its line
has less noise than one that is taken as it is; and two scans of a wall laid on each other by raw
returns hold still wherever they are put, because everyone finds a partner with noise like its own.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from soundmap.geometry import FloatArray

NEIGHBOURS = 5
"""Returns on either side through which a line is laid at first, as far as they reach ..."""
SURE_RAD = np.radians(3.0)
"""... and twice as many, twice as far, until they tell its direction this well."""
REACH_M, MOST_REACH_M = 0.12, 0.5
"""They lie within this distance, or within three times the spacing of the rays, if that is more."""
LEAST_RETURNS = 3
MOST_THICKNESS = 0.3
"""A line if the returns scatter across it by less than this share of the scatter along it ..."""
MOST_ROUGHNESS = 1.5
"""... and, where it goes on beyond the nearest, by no more than so many times the ranges do."""
MOST_OFF = 3.0
"""A return farther from the line than so many standard deviations of a range is not on it."""
LEAST_NOISE_M = 0.001
"""Scanners tell ranges in steps of this size."""


def surface_lines(origin_m: FloatArray, end_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit normals towards the scanner of the surfaces that rays met, and the returns laid on them.

    Parameters
    ----------
    origin_m, end_m : ndarray, shapes (P, 2)
        Rays in the order of their bearings [m].

    Returns
    -------
    normal : ndarray, shape (P, 2)
        Zero where the neighbours do not lie on a line: at corners, edges and single returns.
    point_m : ndarray, shape (P, 2)
        The foot of each return on its line; the return itself where there is none.
    """
    if len(end_m) < LEAST_RETURNS:
        return np.zeros((len(end_m), 2)), end_m.copy()
    step = end_m - origin_m
    bearing = np.arctan2(step[:, 1], step[:, 0])
    turn = np.abs((np.diff(bearing) + np.pi) % (2 * np.pi) - np.pi)
    reach = np.maximum(REACH_M, 3.0 * float(np.median(turn)) * np.hypot(step[:, 0], step[:, 1]))
    noise = max(range_noise(step, end_m), LEAST_NOISE_M)
    return _lines(np.ascontiguousarray(origin_m), np.ascontiguousarray(end_m), reach, noise)


def range_noise(ray_m: FloatArray, end_m: FloatArray) -> float:
    """Standard deviation of the ranges of a scan [m]: how far returns lie off their neighbours.

    Parameters
    ----------
    ray_m, end_m : ndarray, shapes (P, 2)
        From the scanner to each return, and where that lies [m], P >= 3.
    """
    before, here, after = end_m[:-2], end_m[1:-1], end_m[2:]
    length = np.hypot(*ray_m[1:-1].T)
    x, y = (after - before).T
    across = np.stack([-y, x], axis=-1)
    facing = np.sum(across * ray_m[1:-1], axis=1) / np.maximum(length, 1e-9)
    beyond = np.sum(across * (here - before), axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.abs(beyond / facing)
    off = off[np.isfinite(off)]
    # The neighbours err as well, by half together.
    return 1.48 * float(np.median(off)) / np.sqrt(1.5) if len(off) else 0.0


@njit(cache=True, nogil=True)
def _lines(
    origin: FloatArray, end: FloatArray, reach: FloatArray, noise: float
) -> tuple[FloatArray, FloatArray]:
    normal, point = np.zeros(end.shape), end.copy()
    for i in range(len(end)):
        found, met, wide = False, 0, 1
        ray_x, ray_y = end[i, 0] - origin[i, 0], end[i, 1] - origin[i, 1]
        length = max(np.hypot(ray_x, ray_y), 1e-9)
        ray_x, ray_y = ray_x / length, ray_y / length
        tilt = middle_x = middle_y = 0.0
        while True:
            within = min(wide * reach[i], max(reach[i], MOST_REACH_M))
            count, along, across, angle, mean_x, mean_y = _line(end, i, wide * NEIGHBOURS, within)
            if count == met or (count < LEAST_RETURNS and wide > 1):
                break
            met = count
            rough = across / max(count - 2, 1)
            # Noise alone spreads returns along the ray, and that is no surface.
            along -= 2.0 * count * (noise * (np.cos(angle) * ray_x + np.sin(angle) * ray_y)) ** 2
            line = count >= LEAST_RETURNS and along > 1e-12
            line = line and across <= MOST_THICKNESS * MOST_THICKNESS * along
            if wide > 1:
                line = line and rough <= (MOST_ROUGHNESS * noise) ** 2
            if line:
                found, tilt, middle_x, middle_y = True, angle, mean_x, mean_y
            if (found and not line) or (line and rough <= SURE_RAD * SURE_RAD * along):
                break
            wide *= 2
        nx, ny = -np.sin(tilt), np.cos(tilt)
        off = nx * middle_x + ny * middle_y
        if not found or abs(off) > MOST_OFF * noise:
            continue
        if nx * ray_x + ny * ray_y > 0.0:
            nx, ny, off = -nx, -ny, -off
        normal[i, 0], normal[i, 1] = nx, ny
        point[i, 0], point[i, 1] = end[i, 0] + off * nx, end[i, 1] + off * ny
    return normal, point


@njit(cache=True, nogil=True)
def _line(
    end: FloatArray, i: int, neighbours: int, reach: float
) -> tuple[int, float, float, float, float, float]:
    """Count, scatter along and across, direction and middle, from return i, of those about it."""
    count = 0
    sx = sy = sxx = sxy = syy = 0.0
    for j in range(max(i - neighbours, 0), min(i + neighbours + 1, len(end))):
        dx, dy = end[j, 0] - end[i, 0], end[j, 1] - end[i, 1]
        if dx * dx + dy * dy <= reach * reach:
            count += 1
            sx += dx
            sy += dy
            sxx += dx * dx
            sxy += dx * dy
            syy += dy * dy
    sxx -= sx * sx / count
    sxy -= sx * sy / count
    syy -= sy * sy / count
    root = np.sqrt((sxx - syy) * (sxx - syy) + 4.0 * sxy * sxy)
    along, across = 0.5 * (sxx + syy + root), max(0.5 * (sxx + syy - root), 0.0)
    return count, along, across, 0.5 * np.arctan2(2.0 * sxy, sxx - syy), sx / count, sy / count
