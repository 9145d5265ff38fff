"""Poses at other times than those that are known, carried there by odometry."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, Trajectory, composed, relative, wrapped_angle

SLIP_M, SLIP_RAD = 0.10, np.radians(5.0)
"""Wheels slipped that contradict two neighbouring poses by more than this, ..."""
DRIFT = 0.2
"""... and than the worst drift of any odometry in use [m/m, rad/m and rad/rad]."""


def carried_poses(
    time_ns: NDArray[np.int64],
    odometry: Trajectory,
    known_ns: NDArray[np.int64],
    known_pose: FloatArray,
) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int64]]:
    """Poses between known ones: carried forward from one, blended with those carried back.

    They are blended by the way and the turn between the two.

    Parameters
    ----------
    time_ns : ndarray of int64, shape (S,)
        Increasing, within the time of the odometry.
    odometry : Trajectory
    known_ns : ndarray of int64, shape (K,)
        Increasing, likewise.
    known_pose : ndarray, shape (K, 3)

    Returns
    -------
    pose : ndarray, shape (S, 3)
    before, after : ndarray of int64, shape (S,)
        Indices of the known poses between which each lies; the same at a known time and outside.
    """
    reported, known_odometry = odometry.at(time_ns), odometry.at(known_ns)
    last = len(known_ns) - 1
    before = np.clip(np.searchsorted(known_ns, time_ns, side="right") - 1, 0, last)
    after = np.clip(np.searchsorted(known_ns, time_ns, side="left"), 0, last)
    forward = composed(known_pose[before], relative(known_odometry[before], reported))
    backward = composed(known_pose[after], relative(known_odometry[after], reported))
    progress = motion_progress(odometry)
    own = np.interp(time_ns, odometry.time_ns, progress)
    known = np.interp(known_ns, odometry.time_ns, progress)
    way = np.maximum(known[after] - known[before], 1e-9)
    share = np.clip((own - known[before]) / way, 0.0, 1.0)
    blended = forward + share[:, None] * (backward - forward)
    turn = wrapped_angle(backward[:, 2] - forward[:, 2])
    blended[:, 2] = wrapped_angle(forward[:, 2] + share * turn)
    return blended, before, after


def slipped(known_odometry: FloatArray, known_pose: FloatArray) -> NDArray[np.bool_]:
    """Between which neighbouring poses the wheels slipped, so that nothing can be carried there.

    Parameters
    ----------
    known_odometry, known_pose : ndarray, shapes (K, 3)
        Of the same times, by the odometry and as they are known.

    Returns
    -------
    ndarray of bool, shape (K - 1,)
    """
    step = relative(known_pose[:-1], known_pose[1:])
    off = step - relative(known_odometry[:-1], known_odometry[1:])
    way, turn = np.hypot(step[:, 0], step[:, 1]), np.abs(wrapped_angle(step[:, 2]))
    is_far = np.hypot(off[:, 0], off[:, 1]) > SLIP_M + DRIFT * way
    return is_far | (np.abs(wrapped_angle(off[:, 2])) > SLIP_RAD + DRIFT * (way + turn))


def motion_progress(odometry: Trajectory) -> FloatArray:
    """Way [m] and turn [rad] up to each pose of the odometry added up, and a trace of time."""
    turned = np.cumsum(
        np.abs(wrapped_angle(np.diff(odometry.pose[:, 2], prepend=odometry.pose[:1, 2])))
    )
    elapsed_s = (odometry.time_ns - odometry.time_ns[0]) * 1e-9
    return odometry.driven_m() + turned + 1e-6 * elapsed_s


def odometry_times_between(
    scan_ns: NDArray[np.int64], odometry: Trajectory, *, rare_ns: int
) -> NDArray[np.int64]:
    """Times of the odometry where laser scans are farther apart than ``rare_ns``.

    Parameters
    ----------
    scan_ns : ndarray of int64, shape (S,), S >= 1
        Increasing.
    """
    inside = (odometry.time_ns > scan_ns[0]) & (odometry.time_ns < scan_ns[-1])
    times = odometry.time_ns[inside]
    after = np.searchsorted(scan_ns, times)
    return np.setdiff1d(
        times[scan_ns[after] - scan_ns[np.maximum(after - 1, 0)] > rare_ns], scan_ns
    )
