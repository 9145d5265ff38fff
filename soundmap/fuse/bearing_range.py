"""How far the first surface is on each bearing of the array, from the laser points. Sect. 2.4."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from soundmap.geometry import FloatArray, wrapped_angle


def ranges_on_bearings(
    points_m: ArrayLike, bearing_rad: ArrayLike, *, tolerance_rad: float
) -> FloatArray:
    r"""Range :math:`\rho_n` on each bearing: that of the laser point nearest in angle.

    Parameters
    ----------
    points_m : array_like, shape (P, 2)
        Laser points of all scanners relative to the array's centre [m].
    bearing_rad : array_like, shape (N,)
        Bearings in the same axes as the points [rad].
    tolerance_rad : float
        A point farther off the bearing than this does not count [rad].

    Returns
    -------
    ndarray, shape (N,)
        [m]; NaN where no point is near enough.

    Examples
    --------
    >>> points = [[2.0, 0.0], [0.0, 3.0]]
    >>> ranges_on_bearings(points, [0.01, np.pi / 2, np.pi], tolerance_rad=0.03)
    array([ 2.,  3., nan])
    """
    points = np.asarray(points_m, dtype=np.float64).reshape(-1, 2)
    wanted = wrapped_angle(bearing_rad)
    if len(points) == 0:
        return np.full(wanted.shape, np.nan)
    angle = np.arctan2(points[:, 1], points[:, 0])
    order = np.argsort(angle, kind="stable")
    sorted_angle = angle[order]
    right = np.searchsorted(sorted_angle, wanted) % len(points)
    left = right - 1  # index -1 is the last point: the circle closes
    off_right = np.abs(wrapped_angle(sorted_angle[right] - wanted))
    off_left = np.abs(wrapped_angle(sorted_angle[left] - wanted))
    nearest = np.where(off_left < off_right, order[left], order[right])
    distance = np.hypot(points[nearest, 0], points[nearest, 1])
    return np.where(np.minimum(off_left, off_right) <= tolerance_rad, distance, np.nan)
