"""The surroundings of a run, gathered from its laser scans as they come."""

from __future__ import annotations

from collections import deque

import numpy as np
from numba import njit

from soundmap.deskew import deskewed_rays
from soundmap.geometry import FloatArray, Trajectory
from soundmap.sensors import LaserScan
from soundmap.surroundings import Surroundings, SurroundingsPacker

DIRECTIONS = 720
"""Directions from the base in which a point is kept."""
INTERVAL_NS = 100_000_000
"""Time between surroundings: that between audio scans."""
LASER_AGE_NS = 200_000_000
"""A laser scan farther away in time than this no longer shows the same surroundings."""


class SurroundingsGatherer:
    """Takes in laser scans one by one; never holds more than those of the last half second.

    Parameters
    ----------
    odometry : Trajectory
        Motion of the base in whatever frame: over a fraction of a second any will do.
    """

    def __init__(self, odometry: Trajectory) -> None:
        self._odometry = odometry
        self._near: deque[LaserScan] = deque()
        self._due: deque[int] = deque()
        self._last: LaserScan | None = None
        self._packer = SurroundingsPacker(DIRECTIONS)

    def see(self, scan: LaserScan) -> None:
        """Look at one more scan; scans come by time."""
        time_ns = scan.middle_ns
        self._near.append(scan)
        self._last = scan
        latest = self._due[-1] if self._due else self._packer.last_ns
        if latest is None or time_ns - latest >= INTERVAL_NS:
            self._due.append(time_ns)
        while self._due and self._due[0] < time_ns - LASER_AGE_NS:
            self._take(self._due.popleft())

    def gathered(self) -> Surroundings:
        """The surroundings of all scans seen; to be called once, after the last."""
        while self._due:
            self._take(self._due.popleft())
        latest = self._packer.last_ns
        if self._last is not None and latest is not None and self._last.middle_ns > latest:
            self._take(self._last.middle_ns)
        return self._packer.surroundings()

    def _take(self, time_ns: int) -> None:
        """Keep what is seen at a time in the scan of each scanner that is nearest to it."""
        while self._near and self._near[0].middle_ns < time_ns - LASER_AGE_NS:
            self._near.popleft()
        nearest: dict[int, tuple[int, LaserScan]] = {}
        for scan in self._near:
            away_ns = abs(scan.middle_ns - time_ns)
            if away_ns > LASER_AGE_NS:
                continue
            if scan.scanner not in nearest or away_ns < nearest[scan.scanner][0]:
                nearest[scan.scanner] = away_ns, scan
        points = [
            deskewed_rays(nearest[scanner][1], self._odometry, time_ns).end_m
            for scanner in sorted(nearest)
        ]
        self._packer.add(time_ns, thinned(np.concatenate(points), DIRECTIONS))


@njit(cache=True, nogil=True)
def thinned(point_m: FloatArray, directions: int) -> FloatArray:
    """Of some points the one nearest to each direction from the origin.

    Parameters
    ----------
    point_m : ndarray, shape (P, 2)
    directions : int
        :math:`M`: directions 2 pi m / M.

    Returns
    -------
    ndarray, shape (M, 2)
        NaN where no point lies within half the spacing of the directions.
    """
    kept = np.full((directions, 2), np.nan)
    least = np.full(directions, np.inf)
    for k in range(len(point_m)):
        place = np.arctan2(point_m[k, 1], point_m[k, 0]) * directions / (2.0 * np.pi)
        nearest = np.rint(place)
        away = abs(place - nearest)
        m = int(nearest) % directions
        if away < least[m]:
            least[m] = away
            kept[m] = point_m[k]
    return kept
