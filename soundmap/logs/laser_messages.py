"""Bearings and ranges out of one laser message, whatever its layout."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from soundmap.geometry import FloatArray
from soundmap.logs.messages import Form, frame_name, ros_stamp_ns, timestamp_ns
from soundmap.logs.schemas import MessageError

Pose7 = tuple[float, float, float, float, float, float, float]


class LaserSweep(NamedTuple):
    """One laser message.

    Attributes
    ----------
    stamp_ns : int
        Time of the first ray; 0 if there is none.
    frame_id : str
    first_angle_rad, angle_step_rad : float
        Bearing of the first ray and from one ray to the next.
    ray_interval_s : float
        0 if the message does not tell.
    range_min_m, range_max_m : float
        Limits of the ranges that the scanner can measure; NaN if the message does not tell.
    ranges : array_like
        As recorded.
    beams_told : int
        How many ranges there should be by the angles; may be one off.
    pose : tuple or None
        x, y, z, qx, qy, qz, qw of the scanner in its frame, if it is not the frame itself.
    """

    stamp_ns: int
    frame_id: str
    first_angle_rad: float
    angle_step_rad: float
    ray_interval_s: float
    range_min_m: float
    range_max_m: float
    ranges: Any
    beams_told: int
    pose: Pose7 | None


def valid_ranges(sweep: LaserSweep) -> FloatArray:
    """Distances [m], shape (R,); NaN where there is no return.

    No return is what a scanner reports as NaN, infinite, nought, or outside its own limits.
    """
    return _returns(np.asarray(sweep.ranges), *_limits(sweep))


def longest_return(sweep: LaserSweep) -> float:
    """Greatest of the valid ranges [m]; NaN if there is none."""
    return _longest(np.asarray(sweep.ranges), *_limits(sweep))


# Compiled because numpy would let other threads go first after every step, thousands of times a
# minute.


@njit(cache=True)
def _returns(ranges, low, high):  # type: ignore[no-untyped-def]
    """Keeps what is a return, else NaN."""
    kept = np.empty(len(ranges))
    for i in range(len(ranges)):
        distance = ranges[i]
        kept[i] = distance if distance > 0.0 and low <= distance < high else np.nan
    return kept


@njit(cache=True)
def _longest(ranges, low, high):  # type: ignore[no-untyped-def]
    longest = np.nan
    for i in range(len(ranges)):
        distance = ranges[i]
        if distance > 0.0 and low <= distance < high and not distance <= longest:
            longest = distance
    return longest


def _limits(sweep: LaserSweep) -> tuple[float, float]:
    """Least and greatest range that means a return [m]."""
    low = max(sweep.range_min_m, 0.0) if math.isfinite(sweep.range_min_m) else 0.0
    high = sweep.range_max_m if math.isfinite(sweep.range_max_m) else math.inf
    return (low, high) if high > low else (0.0, math.inf)


def _step(first: float, last: float, step: float, count: int) -> float:
    """Angle between rays, from the ends of the sweep if the message does not tell it."""
    if np.isfinite(step) and (step != 0.0 or count < 2):
        return step
    return (last - first) / (count - 1) if count > 1 else 0.0


def _are_angles(first: float, step: float, count: int) -> bool:
    """Whether rays have a bearing each: finite, and not all the same."""
    return bool(np.isfinite(first) and np.isfinite(step)) and (step != 0.0 or count < 2)


def laser_sweep(
    stamp_ns: int,
    frame_id: str,
    numbers: tuple[float, float, float, float, float, float],
    ranges: Any,
) -> LaserSweep:
    """A sweep by what a ``LaserScan`` tells of it.

    Parameters
    ----------
    stamp_ns : int
    frame_id : str
    numbers : tuple of float
        Angles of the first and the last ray, angle and time between two rays, least and greatest
        range.
    ranges : array_like

    Raises
    ------
    MessageError
        The angles make no sense.
    """
    first, step, interval_s, least_m, greatest_m, told = _told(*numbers, len(ranges))
    return LaserSweep(
        stamp_ns, frame_id, first, step, interval_s, least_m, greatest_m, ranges, told, None
    )


@lru_cache(maxsize=16)  # they hardly ever change from sweep to sweep
def _told(
    first: float,
    last: float,
    step: float,
    interval_s: float,
    least_m: float,
    greatest_m: float,
    count: int,
) -> tuple[float, float, float, float, float, int]:
    """First angle, step, ray interval, range limits, and how many beams there should be."""
    step = _step(first, last, step, count)
    if not _are_angles(first, step, count):
        raise MessageError("laser scan without sound angles")
    told = (last - first) / step + 1.0 if step else np.nan
    return (
        first,
        step,
        interval_s if np.isfinite(interval_s) else 0.0,
        least_m,
        greatest_m,
        round(told) if 0.0 < told < 2**30 else count,
    )


def _laser_scan(message: Any) -> LaserSweep:
    numbers = (
        float(message.angle_min),
        float(message.angle_max),
        float(message.angle_increment),
        float(message.time_increment),
        float(message.range_min),
        float(message.range_max),
    )
    stamp_ns, frame_id = ros_stamp_ns(message.header.stamp), frame_name(message.header.frame_id)
    return laser_sweep(stamp_ns, frame_id, numbers, message.ranges)


def _angle_range_scan(message: Any) -> LaserSweep:
    first, last, count = float(message.start_angle), float(message.end_angle), len(message.ranges)
    step = _step(first, last, 0.0, count)
    if not _are_angles(first, step, count):
        raise MessageError("laser scan without sound angles")
    pose = None
    if hasattr(message, "pose"):
        p, q = message.pose.position, message.pose.orientation
        given = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
        if not np.all(np.isfinite(given)):
            raise MessageError("laser scan without a sound pose")
        # A pose that was never set is all zeros.
        pose = (*given[:3], *(given[3:] if any(given[3:]) else (0.0, 0.0, 0.0, 1.0)))
    return LaserSweep(
        timestamp_ns(message.timestamp),
        frame_name(message.frame_id),
        first,
        step,
        0.0,
        np.nan,
        np.nan,
        message.ranges,
        count,
        pose,
    )


SWEEP_READERS: dict[Form, Callable[[Any], LaserSweep]] = {
    Form.LASER_SCAN: _laser_scan,
    Form.ANGLE_RANGE_SCAN: _angle_range_scan,
}
"""What turns a decoded message of each layout into a sweep."""
