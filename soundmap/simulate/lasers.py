"""Lasers: what a scanner measures that moves while it sweeps, each ray at its own time."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import ArrayLike

from soundmap.geometry import FloatArray, composed


def ray_ranges(
    origin_m: ArrayLike,
    direction_rad: ArrayLike,
    start_m: FloatArray,
    end_m: FloatArray,
    circles_m: FloatArray,
) -> FloatArray:
    """Distance to the first surface along each ray.

    Parameters
    ----------
    origin_m : array_like, shape (R, 2)
    direction_rad : array_like, shape (R,)
        In the frame of the origins [rad].
    start_m, end_m : ndarray, shape (W, 2)
        Straight surfaces.
    circles_m : ndarray, shape (R, C, 3)
        Centres and radii of round things at the time of each ray.

    Returns
    -------
    ndarray, shape (R,)
        [m]; inf where a ray meets nothing.

    Examples
    --------
    >>> wall = np.array([[2.0, -1.0]]), np.array([[2.0, 1.0]])
    >>> ray_ranges([[0.0, 0.0], [0.0, 0.0]], [0.0, np.pi], *wall, np.zeros((2, 0, 3)))
    array([ 2., inf])
    """
    origin = np.ascontiguousarray(origin_m, dtype=np.float64)
    direction = np.asarray(direction_rad, dtype=np.float64)
    way = np.stack([np.cos(direction), np.sin(direction)], axis=-1)
    walls = np.concatenate([start_m, end_m - start_m], axis=1)
    return np.array(_ray_ranges(origin, way, walls, np.ascontiguousarray(circles_m)))


@numba.njit(cache=True, nogil=True)
def _ray_ranges(
    origin: FloatArray, way: FloatArray, walls: FloatArray, circles: FloatArray
) -> FloatArray:
    result = np.full(len(origin), np.inf)
    for r in range(len(origin)):
        ox, oy, dx, dy = origin[r, 0], origin[r, 1], way[r, 0], way[r, 1]
        nearest = np.inf
        for w in range(len(walls)):
            wx, wy = walls[w, 2], walls[w, 3]
            gx, gy = walls[w, 0] - ox, walls[w, 1] - oy
            det = dx * wy - dy * wx
            if det == 0.0:
                continue
            along = (gx * wy - gy * wx) / det
            across = (gx * dy - gy * dx) / det
            if along > 0.0 and 0.0 <= across <= 1.0 and along < nearest:
                nearest = along
        for c in range(circles.shape[1]):
            gx, gy = circles[r, c, 0] - ox, circles[r, c, 1] - oy
            middle = gx * dx + gy * dy
            half = circles[r, c, 2] ** 2 - (gx * gx + gy * gy - middle * middle)
            if half >= 0.0 and 0.0 < middle - np.sqrt(half) < nearest:
                nearest = middle - np.sqrt(half)
        result[r] = nearest
    return result


def scan_bearings(field_rad: float, step_rad: float) -> FloatArray:
    """Bearings of a scanner's rays in its own frame, symmetric about its x axis [rad]."""
    rays = round(field_rad / step_rad) + 1
    return np.asarray((np.arange(rays) - 0.5 * (rays - 1)) * step_rad, dtype=np.float64)


def ray_origins(
    base_pose: FloatArray, mount: tuple[float, float, float, float], bearing_rad: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Origin (R, 2) [m] and direction (R,) [rad] in the map frame of rays taken one by one.

    Parameters
    ----------
    base_pose : ndarray, shape (R, 3)
        Pose of the robot's base at the time of each ray.
    mount : tuple
        x, y, z [m] and yaw [rad] of the scanner in the base frame.
    bearing_rad : ndarray, shape (R,)
        In the scanner's frame.
    """
    scanner = composed(base_pose, np.array([mount[0], mount[1], mount[3]]))
    return scanner[..., :2], scanner[..., 2] + bearing_rad


def measured_ranges(
    true_m: FloatArray,
    rng: np.random.Generator,
    *,
    noise_m: float,
    noise_per_m: float,
    dropout_share: float,
    range_min_m: float,
    range_max_m: float,
) -> FloatArray:
    """Ranges as a scanner reports them, to the millimetre; inf where nothing came back."""
    finite = np.where(np.isfinite(true_m), true_m, 0.0)
    sigma = noise_m + noise_per_m * finite
    noisy = np.round(finite + sigma * rng.standard_normal(true_m.shape), 3)
    lost = rng.random(true_m.shape) < dropout_share
    bad = ~np.isfinite(true_m) | (noisy > range_max_m) | (noisy < range_min_m) | lost
    return np.where(bad, np.inf, noisy)


def leg_circles(walker_pose: FloatArray, time_s: FloatArray, radius_m: float) -> FloatArray:
    """Two legs of someone walking, shape (R, 2, 3): centres and radii [m].

    The feet are 0.2 m apart and swing 0.25 m to the front and to the back, once a second.
    """
    swing = 0.25 * np.sin(2.0 * np.pi * time_s)
    legs = []
    for side in (-1.0, 1.0):
        step = np.stack([side * swing, np.full_like(swing, 0.1 * side), 0.0 * swing], axis=-1)
        foot = composed(walker_pose, step)
        legs.append(np.stack([foot[:, 0], foot[:, 1], np.full(len(foot), radius_m)], axis=-1))
    return np.stack(legs, axis=1)
