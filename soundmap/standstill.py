"""Whether the robot moves although its odometry says that it does not: laser scans tell."""

from __future__ import annotations

import numpy as np

from soundmap.errors import NothingUsableError
from soundmap.geometry import FloatArray, Trajectory, relative
from soundmap.sensors import LaserScan

STILL_M, STILL_RAD = 0.02, np.radians(2.0)
"""Odometry that moves less than this in a whole run stands still."""
CHANGE_M = 0.1
"""A range that differs by more than this has changed [m]."""
CHANGED_SHARE = 0.35
"""The robot has moved if so many of a scanner's rays have changed: people change fewer."""
CHANGED_SCANS = 5
EVERY = 4
"""One ray in so many tells enough."""


def compared_ranges(scan: LaserScan) -> FloatArray:
    """The ranges of a scan that are compared with those of another."""
    return scan.range_m[::EVERY].copy()


def has_moved(before: FloatArray, now: FloatArray) -> bool:
    """Whether two scans of one scanner, as `compared_ranges`, were taken from different places.

    Scans of different size, or without a ray that returned in both, say nothing.

    Examples
    --------
    >>> wall = np.full(10, 2.0)
    >>> has_moved(wall, wall + 0.3), has_moved(wall, wall + 0.01)
    (True, False)
    """
    if len(before) != len(now):
        return False
    change = np.abs(before - now)
    known = np.count_nonzero(np.isfinite(change))
    return bool(known and np.count_nonzero(change > CHANGE_M) > CHANGED_SHARE * known)


class StandstillWitness:
    """Notices odometry that never moves while the laser scans show that the robot does."""

    def __init__(self, odometry: Trajectory) -> None:
        step = relative(odometry.pose[:-1], odometry.pose[1:])
        driven_m = np.hypot(step[:, 0], step[:, 1]).sum()
        self._stuck = bool(driven_m < STILL_M and np.abs(step[:, 2]).sum() < STILL_RAD)
        self._first: dict[int, FloatArray] = {}
        self._changed = 0

    def see(self, scan: LaserScan) -> None:
        """Look at one more scan.

        Raises
        ------
        NothingUsableError
            The odometry of the whole run is worth nothing.
        """
        if not self._stuck:
            return
        now = compared_ranges(scan)
        first = self._first.setdefault(scan.scanner, now)
        self._changed = self._changed + 1 if has_moved(first, now) else 0
        if self._changed >= CHANGED_SCANS:
            raise NothingUsableError(
                "the odometry never moves although the laser scans show that the robot does. "
                "Check the odometry topic ([topics] odometry); `soundmap info` lists them."
            )
