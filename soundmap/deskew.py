"""Laser rays where they were measured: each at its own time, from where the robot then stood.

A sweep of a UTM-30LX takes 18.75 ms, in which a robot turning at 90 deg/s turns 1.7 deg.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, Trajectory, relative, transformed
from soundmap.sensors import LaserScan


@dataclass(frozen=True)
class Rays:
    """Laser rays that met a surface, as seen from the robot's base at one time.

    Attributes
    ----------
    time_ns : int
        The time at which the base frame is taken [ns since epoch].
    origin_m : ndarray, shape (B, 2)
        Where each ray started, in the base frame [m].
    end_m : ndarray, shape (B, 2)
        Where each ray met the surface, in the base frame [m].
    """

    time_ns: int
    origin_m: FloatArray
    end_m: FloatArray

    def __len__(self) -> int:
        return len(self.end_m)

    @property
    def bearing_rad(self) -> FloatArray:
        """Direction of each ray in the base frame [rad], shape (B,)."""
        step = self.end_m - self.origin_m
        return np.arctan2(step[:, 1], step[:, 0])

    @property
    def range_m(self) -> FloatArray:
        """Length of each ray [m], shape (B,)."""
        step = self.end_m - self.origin_m
        return np.hypot(step[:, 0], step[:, 1])


def deskewed_rays(
    scan: LaserScan, track: Trajectory, time_ns: int, *, most: int | None = None
) -> Rays:
    """The returns of a scan, each taken from its own time to ``time_ns``.

    Parameters
    ----------
    scan : LaserScan
    track : Trajectory
        Motion of the base, in whatever frame: odometry will do over a sweep.
    time_ns : int
        Time of the base frame wanted [ns since epoch].
    most : int, optional
        Keep no more than this many returns, evenly spread over the valid ones.

    Returns
    -------
    Rays
        Rays without a return, and rays at times that ``track`` does not span, are left out.
    """
    valid = np.flatnonzero(np.isfinite(scan.range_m))
    if most is not None and len(valid) > most:
        valid = valid[_evenly(len(valid), most)]
    end = scan.mount.base_points(scan.bearing_rad[valid], scan.range_m[valid])
    origin = np.broadcast_to(scan.mount.translation_m[:2], end.shape)
    base_then = track.at(scan.ray_time_ns[valid])
    base_now = track.at(time_ns)
    motion = relative(base_now, base_then)
    known = np.isfinite(motion).all(axis=-1)
    motion, end, origin = motion[known], end[known], origin[known]
    return Rays(time_ns, transformed(motion, origin), transformed(motion, end))


def _evenly(count: int, most: int) -> NDArray[np.int64]:
    return (np.arange(most) * count + count // 2) // most
