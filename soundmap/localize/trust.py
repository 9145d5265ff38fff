"""Which poses of a run to believe: those whose scans match the map along enough of the way."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, relative, wrapped_angle
from soundmap.localize.placement import ELSEWHERE_WAY_M, LOST_M, ODOMETRY_DRIFT
from soundmap.localize.smoothing import chained

TORN_M, TORN_RAD = 0.5, np.radians(30.0)
"""A step that differs so much from that of the odometry tears the trajectory."""
SLIP_NS = 100_000_000
SLIP_RAD_S = 1.0
"""Wheels slip that report a turn rate so far from the true one over at least so long."""
BRIDGE_M = 0.3
"""A robot that is known before and after so short a way was not lost on it."""


def bridged(matching: NDArray[np.bool_], way_m: FloatArray) -> NDArray[np.bool_]:
    """True where scans match, and between two such poses with next to no way between them.

    What stands in front of the map for a moment does not lose a robot.

    Parameters
    ----------
    matching : ndarray of bool, shape (K,)
    way_m : ndarray, shape (K,)
        Driven until each pose [m].
    """
    index = np.flatnonzero(matching)
    following = np.searchsorted(index, np.arange(len(matching)))
    inside = (following > 0) & (following < len(index))
    result = matching.copy()
    after, before = index[following[inside]], index[following[inside] - 1]
    result[inside] |= way_m[after] - way_m[before] <= BRIDGE_M
    return result


def without_scraps(
    trusted: NDArray[np.bool_], pose: FloatArray, step: FloatArray, way_m: FloatArray
) -> NDArray[np.bool_]:
    """The trusted poses less those of pieces that match along too little way to be proved.

    A few scans may fit some other place of the map by chance. A piece ends where the trajectory
    leaves the odometry, and where nothing matched over so much way that odometry cannot tell. Only
    way along which one scan after another matched proves a piece; of pieces that are all too short
    the longest remains.

    Parameters
    ----------
    trusted : ndarray of bool, shape (K,)
    pose : ndarray, shape (K, 3)
    step : ndarray, shape (K - 1, 3)
        Motion from each pose to the next according to the odometry.
    way_m : ndarray, shape (K,)
        Driven until each pose [m].
    """
    index = np.flatnonzero(trusted)
    if len(index) == 0:
        return trusted
    before, after = index[:-1], index[1:]
    gap_m = way_m[after] - way_m[before]
    is_joined = (gap_m <= ELSEWHERE_WAY_M) | (after == before + 1)
    is_joined &= ~_is_torn(pose, chained(step), before, after, gap_m)
    is_matched = is_joined & ((gap_m <= LOST_M) | (after == before + 1))
    piece = np.concatenate([[0], np.cumsum(~is_joined)])
    matched_m = np.bincount(piece[1:], weights=gap_m * is_matched, minlength=piece[-1] + 1)
    is_proved = matched_m >= ELSEWHERE_WAY_M
    if not is_proved.any():
        views = np.bincount(piece)
        is_proved[np.lexsort((views, matched_m))[-1]] = True
    kept = np.zeros_like(trusted)
    kept[index[is_proved[piece]]] = True
    return kept


def slipping(time_ns: NDArray[np.int64], pose: FloatArray, step: FloatArray) -> NDArray[np.bool_]:
    """Which poses fall in a moment in which the wheels reported a false turn: scans are bent then.

    The rays of a scan are put together by the odometry. A false way shifts them by centimetres at
    most, a false turn by degrees.

    Parameters
    ----------
    time_ns : ndarray of int64, shape (K,)
    pose : ndarray, shape (K, 3)
    step : ndarray, shape (K - 1, 3)
        Motion from each pose to the next according to the odometry.
    """
    odometry, count = chained(step), len(pose)
    before = np.arange(count)
    after = np.searchsorted(time_ns, time_ns + SLIP_NS)
    before, after = before[after < count], after[after < count]
    turn = pose[after, 2] - pose[before, 2]
    off = wrapped_angle(turn - (odometry[after, 2] - odometry[before, 2]))
    is_false = np.abs(off) > SLIP_RAD_S * 1e-9 * (time_ns[after] - time_ns[before])
    edges = np.zeros(count + 1, dtype=np.int64)
    np.add.at(edges, before[is_false], 1)
    np.add.at(edges, after[is_false] + 1, -1)
    return np.cumsum(edges)[:-1] > 0


def _is_torn(
    pose: FloatArray,
    odometry: FloatArray,
    before: NDArray[np.int64],
    after: NDArray[np.int64],
    gap_m: FloatArray,
) -> NDArray[np.bool_]:
    """Whether odometry cannot have led from one pose to another over some way."""
    off = relative(pose[before], pose[after]) - relative(odometry[before], odometry[after])
    drift = ODOMETRY_DRIFT * gap_m
    is_far = np.hypot(off[:, 0], off[:, 1]) > TORN_M + drift
    return is_far | (np.abs(wrapped_angle(off[:, 2])) > TORN_RAD + drift)
