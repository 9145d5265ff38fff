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
    origins, ends = _deskewed(
        scan.bearing_rad,
        np.asarray(scan.range_m, dtype=np.float64),
        scan.time_ns,
        scan.ray_interval_ns,
        scan.mount.rotation,
        scan.mount.translation_m,
        track.time_ns,
        track.pose,
        time_ns,
        len(scan.range_m) if most is None else most,
    )
    return Rays(time_ns, origins, ends)


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
def _deskewed(  # type: ignore[no-untyped-def]
    bearing, ranges, first_ns, interval_ns, rotation, translation, time_ns, pose, now_ns, most
):
    """Where the returns of a scan started and ended, (B, 2) each, in the base frame of one time."""
    valid = np.flatnonzero(np.isfinite(ranges))
    kept = min(len(valid), most)
    origins, ends = np.empty((kept, 2)), np.empty((kept, 2))
    now_x, now_y, now_heading = interpolated_pose(time_ns, pose, now_ns)
    now_cos, now_sin = np.cos(now_heading), np.sin(now_heading)
    known = 0
    for i in range(kept):
        ray = valid[(i * len(valid) + len(valid) // 2) // kept if len(valid) > most else i]
        ray_ns = first_ns + np.int64(np.rint(ray * interval_ns))
        x, y, heading = interpolated_pose(time_ns, pose, ray_ns)
        if not (np.isfinite(x) and np.isfinite(now_x)):
            continue
        dx, dy = x - now_x, y - now_y
        shift_x, shift_y = now_cos * dx + now_sin * dy, now_cos * dy - now_sin * dx
        cos, sin = np.cos(heading - now_heading), np.sin(heading - now_heading)
        own_x, own_y = ranges[ray] * np.cos(bearing[ray]), ranges[ray] * np.sin(bearing[ray])
        end_x = rotation[0, 0] * own_x + rotation[0, 1] * own_y + translation[0]
        end_y = rotation[1, 0] * own_x + rotation[1, 1] * own_y + translation[1]
        origins[known, 0] = shift_x + cos * translation[0] - sin * translation[1]
        origins[known, 1] = shift_y + sin * translation[0] + cos * translation[1]
        ends[known, 0] = shift_x + cos * end_x - sin * end_y
        ends[known, 1] = shift_y + sin * end_x + cos * end_y
        known += 1
    return origins[:known], ends[:known]
