"""The loudest bearing of an audio scan, finer than its bearings are spaced."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from soundmap.geometry import FloatArray


class Peak(NamedTuple):
    """A maximum between the bearings of a scan: where [rad], in [0, 2 pi), and how loud."""

    bearing_rad: float
    power: float


def refined_peak(power: ArrayLike, bearing_rad: FloatArray) -> Peak:
    """Vertex of the parabola through the loudest bearing and its two neighbours on the circle.

    Parameters
    ----------
    power : array_like, shape (N,)
        Finite [linear].
    bearing_rad : ndarray, shape (N,)
        Equally spaced over the full circle, increasing [rad].

    Raises
    ------
    ValueError
        If there are fewer than 3 bearings, not one power each, or powers that are not finite.

    Examples
    --------
    >>> bearing = np.radians([0.0, 90.0, 180.0, 270.0])
    >>> refined_peak([3.0, 1.0, 0.0, 1.0], bearing)
    Peak(bearing_rad=0.0, power=3.0)
    >>> round(np.degrees(refined_peak([3.0, 2.0, 0.0, 1.0], bearing).bearing_rad).item(), 3)
    15.0
    """
    values = np.asarray(power, dtype=np.float64)
    count = len(bearing_rad)
    if values.shape != (count,) or count < 3 or not np.all(np.isfinite(values)):
        raise ValueError("a peak needs one finite power a bearing, and at least 3 bearings")
    top = int(np.argmax(values))
    before, here, after = values[top - 1], values[top], values[(top + 1) % count]
    curvature = before - 2.0 * here + after
    offset = 0.5 * (before - after) / curvature if curvature < 0.0 else 0.0
    bearing = bearing_rad[top] + offset * 2.0 * np.pi / count
    wrapped = bearing % (2.0 * np.pi) % (2.0 * np.pi)  # once takes -1e-17 to 2 pi, twice to 0
    return Peak(float(wrapped), float(here - 0.25 * (before - after) * offset))
