"""Laser rays where they were measured: each at its own time, from where the robot then stood.

A sweep of a UTM-30LX takes 18.75 ms, in which a robot turning at 90 deg/s turns 1.7 deg.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, Trajectory
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
    ends = scan.mount.base_points(scan.bearing_rad[valid], scan.range_m[valid])
    known, origins, ends = _taken(
        track.time_ns,
        track.pose,
        scan.ray_time_ns[valid],
        time_ns,
        scan.mount.translation_m[:2],
        ends,
    )
    return Rays(time_ns, origins[known], ends[known])


def _evenly(count: int, most: int) -> NDArray[np.int64]:
    return (np.arange(most) * count + count // 2) // most


@njit(cache=True, nogil=True)
def interpolated_pose(
    time_ns: NDArray[np.int64], pose: FloatArray, wanted_ns: int
) -> tuple[float, float, float]:
    """`Trajectory.at` for a single time, from the arrays of the trajectory: x, y, heading."""
    last = len(time_ns) - 1
    if last < 0 or wanted_ns < time_ns[0] or wanted_ns > time_ns[last]:
        return np.nan, np.nan, np.nan
    left = int(np.searchsorted(time_ns, wanted_ns, side="right")) - 1
    right = min(left + 1, last)
    share = (wanted_ns - time_ns[left]) / max(time_ns[right] - time_ns[left], 1)
    turn = (pose[right, 2] - pose[left, 2] + np.pi) % (2.0 * np.pi) - np.pi
    return (
        pose[left, 0] + share * (pose[right, 0] - pose[left, 0]),
        pose[left, 1] + share * (pose[right, 1] - pose[left, 1]),
        (pose[left, 2] + share * turn + np.pi) % (2.0 * np.pi) - np.pi,
    )


@njit(cache=True, nogil=True)
def _taken(
    time_ns: NDArray[np.int64],
    pose: FloatArray,
    ray_ns: NDArray[np.int64],
    now_ns: int,
    origin: FloatArray,
    end: FloatArray,
) -> tuple[NDArray[np.bool_], FloatArray, FloatArray]:
    """Rays taken from the base frames of their own times to that of one time.

    Returns which of them have a known time, where they started and where they ended, (B, 2).
    """
    known = np.zeros(len(end), dtype=np.bool_)
    origins, ends = np.empty(end.shape), np.empty(end.shape)
    now_x, now_y, now_heading = interpolated_pose(time_ns, pose, now_ns)
    now_cos, now_sin = np.cos(now_heading), np.sin(now_heading)
    for k in range(len(end)):
        x, y, heading = interpolated_pose(time_ns, pose, ray_ns[k])
        known[k] = np.isfinite(x) and np.isfinite(now_x)
        dx, dy = x - now_x, y - now_y
        shift_x, shift_y = now_cos * dx + now_sin * dy, now_cos * dy - now_sin * dx
        cos, sin = np.cos(heading - now_heading), np.sin(heading - now_heading)
        origins[k, 0] = shift_x + cos * origin[0] - sin * origin[1]
        origins[k, 1] = shift_y + sin * origin[0] + cos * origin[1]
        ends[k, 0] = shift_x + cos * end[k, 0] - sin * end[k, 1]
        ends[k, 1] = shift_y + sin * end[k, 0] + cos * end[k, 1]
    return known, origins, ends
