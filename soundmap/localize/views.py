"""Which laser scans are worth using, and what the robot saw in them.

A scan is used when the robot has moved since the scanner's last one. Standing still, the same view
again is hardly new evidence: it counts a few times, until together the looks weigh as much as one
whole scan, and later only shows that the pose still holds.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from soundmap.config import LocalizeConfig
from soundmap.deskew import Rays, deskewed_rays, interpolated_pose
from soundmap.errors import NothingUsableError
from soundmap.geometry import FloatArray, Trajectory, relative, transformed
from soundmap.losses import LossLedger
from soundmap.sensors import LaserScan
from soundmap.standstill import StandstillWitness, compared_ranges, has_moved

STAGE = "localize"
LEAST_RAYS = 10
"""A scan with fewer returns says too little about the pose."""
LOOK_INTERVAL_S = 0.1
"""Time between the looks that count of a robot at rest."""
AT_REST = 0.2
"""A robot is at rest that has moved less than this share of the way to a new place."""


@dataclass(frozen=True)
class Views:
    """The laser scans used of a run, by time: what was seen, and where odometry put the robot.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (K,)
        Not decreasing [ns since epoch].
    odometry : ndarray, shape (K, 3)
        Base in the odometry frame at these times.
    driven_m : ndarray, shape (K,)
        Distance driven up to then [m].
    is_evidence : ndarray of bool, shape (K,)
        Whether the view says something new about the pose.
    scanner : ndarray of int64, shape (K,)
    range_max_m : float
        Greatest range of any scanner [m].
    first : ndarray of int64, shape (K + 1,)
        View k has the rays first[k] to first[k + 1].
    origin_m, end_m : ndarray of float32, shapes (P, 2)
        Where the rays started and met a surface, in the base frame at their view's time [m].
    """

    time_ns: NDArray[np.int64]
    odometry: FloatArray
    driven_m: FloatArray
    is_evidence: NDArray[np.bool_]
    scanner: NDArray[np.int64]
    range_max_m: float
    first: NDArray[np.int64]
    origin_m: NDArray[np.float32]
    end_m: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.time_ns)

    def rays(self, view: int) -> Rays:
        """The rays of one view."""
        own = slice(self.first[view], self.first[view + 1])
        return Rays(
            int(self.time_ns[view]),
            self.origin_m[own].astype(np.float64),
            self.end_m[own].astype(np.float64),
        )

    def joined_rays(self, views: Iterable[int], reference: int) -> Rays:
        """The rays of several views in the base frame of one, as odometry puts them together."""
        origins, ends = [], []
        for view in views:
            motion = relative(self.odometry[reference], self.odometry[view])
            rays = self.rays(view)
            origins.append(transformed(motion, rays.origin_m))
            ends.append(transformed(motion, rays.end_m))
        time_ns = int(self.time_ns[reference])
        return Rays(time_ns, np.concatenate(origins), np.concatenate(ends))


@dataclass(frozen=True)
class _Place:
    """Where a scanner last looked from, how often, when last, and what it saw then."""

    x_m: float
    y_m: float
    heading_rad: float
    looks: int
    time_ns: int
    ranges: FloatArray


class ViewChooser:
    """Takes the laser scans of a run one by one and keeps those worth using, deskewed.

    Parameters
    ----------
    odometry : Trajectory
    config : LocalizeConfig
    losses : LossLedger
        Where scans that could not be used are counted.
    """

    def __init__(self, odometry: Trajectory, config: LocalizeConfig, losses: LossLedger) -> None:
        self._odometry, self._config, self._losses = odometry, config, losses
        self._most_looks = math.ceil(1.0 / config.likelihood_exponent)
        self._witness = StandstillWitness(odometry)
        self._places: dict[int, _Place] = {}
        self._passed_over: dict[int, LaserScan] = {}
        self._range_max_m = 0.0
        self._chosen = _ChosenViews()

    def see(self, scan: LaserScan) -> None:
        """Look at one more scan; scans come by time.

        Raises
        ------
        NothingUsableError
            The odometry stands still while the scans change.
        """
        time_ns = scan.middle_ns
        x, y, heading = interpolated_pose(self._odometry.time_ns, self._odometry.pose, time_ns)
        if math.isnan(x):
            self._losses.add("laser scan without odometry", STAGE, effect="scan not used")
            return
        place = self._places.get(scan.scanner)
        looks = 0
        if place is not None:
            way = self._way(place, x, y, heading)
            elapsed_s = (time_ns - place.time_ns) * 1e-9
            if way < 1.0 and not self._is_due(place, way, elapsed_s, scan):
                self._passed_over[scan.scanner] = scan
                return
            stands = way < 1.0 and not (way < AT_REST and self._looks_elsewhere(place, scan))
            looks = place.looks if stands else 0
        rays = self._rays(scan)
        if len(rays) < LEAST_RAYS:
            self._losses.add("laser scan with too few returns", STAGE, effect="scan not used")
            return
        self._passed_over.pop(scan.scanner, None)
        if place is not None and looks > 0:
            self._places[scan.scanner] = replace(place, looks=looks + 1, time_ns=time_ns)
        else:
            self._places[scan.scanner] = _Place(x, y, heading, 1, time_ns, compared_ranges(scan))
        self._witness.see(scan)
        self._range_max_m = max(self._range_max_m, scan.range_max_m)
        self._chosen.add(scan.scanner, rays, is_evidence=looks < self._most_looks)

    def views(self) -> Views:
        """What was chosen; among it the first and the last scan of every scanner.

        To be called once: nothing is kept here afterwards.

        Raises
        ------
        NothingUsableError
            No scan has enough returns within the time of the odometry.
        """
        chosen = self._chosen
        if not len(chosen.time_ns):
            raise NothingUsableError(
                "no laser scan has enough returns at a time that the odometry spans; the robot "
                "cannot be localized. `soundmap info` shows what the log holds."
            )
        for scan in self._passed_over.values():
            chosen.add(scan.scanner, self._rays(scan), is_evidence=False)
        self._chosen = _ChosenViews()
        return chosen.views(self._odometry, self._range_max_m)

    def _way(self, place: _Place, x_m: float, y_m: float, heading_rad: float) -> float:
        """Motion since the scanner's last place, 1 where it makes a new one."""
        moved_m = math.hypot(x_m - place.x_m, y_m - place.y_m)
        turned_rad = abs(math.remainder(heading_rad - place.heading_rad, 2.0 * math.pi))
        return max(
            moved_m / max(self._config.update_distance_m, 1e-9),
            turned_rad / max(self._config.update_angle_rad, 1e-9),
        )

    def _is_due(self, place: _Place, way: float, elapsed_s: float, scan: LaserScan) -> bool:
        """Whether it is time for another look from about the same place."""
        if elapsed_s >= self._config.update_interval_s:
            return True
        if way >= AT_REST or elapsed_s < LOOK_INTERVAL_S:
            return False
        return place.looks < self._most_looks or self._looks_elsewhere(place, scan)

    @staticmethod
    def _looks_elsewhere(place: _Place, scan: LaserScan) -> bool:
        """Whether the robot has moved unnoticed by its odometry."""
        return has_moved(place.ranges, compared_ranges(scan))

    def _rays(self, scan: LaserScan) -> Rays:
        return deskewed_rays(scan, self._odometry, scan.middle_ns, most=self._config.beams)


class _ChosenViews:
    """Views to be kept, nearly in order; their rays, in single precision, grow in place."""

    def __init__(self) -> None:
        self.time_ns = array("q")
        self._scanner, self._is_evidence, self._count = array("q"), array("b"), array("q")
        self._origin_m, self._end_m = bytearray(), bytearray()

    def add(self, scanner: int, rays: Rays, *, is_evidence: bool) -> None:
        self.time_ns.append(rays.time_ns)
        self._scanner.append(scanner)
        self._is_evidence.append(is_evidence)
        self._count.append(len(rays))
        self._origin_m += rays.origin_m.astype(np.float32).data
        self._end_m += rays.end_m.astype(np.float32).data

    def views(self, odometry: Trajectory, range_max_m: float) -> Views:
        """All of them by time, without a second copy of the rays."""
        added_ns = np.array(self.time_ns, dtype=np.int64)
        order = np.argsort(added_ns, kind="stable")
        time_ns, count = added_ns[order], np.array(self._count, dtype=np.int64)
        first = np.concatenate([[0], np.cumsum(count[order])])
        origin_m, end_m = (
            np.frombuffer(rays, dtype=np.float32).reshape(-1, 2)
            for rays in (self._origin_m, self._end_m)
        )
        _reorder(origin_m, count, order)
        _reorder(end_m, count, order)
        return Views(
            time_ns=time_ns,
            odometry=odometry.at(time_ns),
            driven_m=np.interp(time_ns, odometry.time_ns, odometry.driven_m()),
            is_evidence=np.array(self._is_evidence, dtype=bool)[order],
            scanner=np.array(self._scanner, dtype=np.int64)[order],
            range_max_m=range_max_m,
            first=first,
            origin_m=origin_m,
            end_m=end_m,
        )


def _reorder(rays: NDArray[np.float32], count: NDArray[np.int64], order: NDArray[np.int64]) -> None:
    """Bring the rays of all views, so many of each, into another order, in place.

    Only neighbours and the last few views are out of order: they are moved group by group.
    """
    place = np.arange(len(order))
    begins = np.flatnonzero(np.maximum.accumulate(order) == place) + 1
    start = np.concatenate([[0], np.cumsum(count)])
    for low, high in pairwise([0, *begins.tolist()]):
        if high - low > 1:
            moved = [rays[start[view] : start[view + 1]] for view in order[low:high].tolist()]
            rays[start[low] : start[high]] = np.concatenate(moved)


def chosen_views(
    lasers: Iterable[LaserScan], odometry: Trajectory, config: LocalizeConfig, losses: LossLedger
) -> Views:
    """The scans worth using of a whole run, ordered by time.

    Raises
    ------
    NothingUsableError
        No scan has enough returns within the time of the odometry, or the odometry stands still
        while the scans change.
    """
    chooser = ViewChooser(odometry, config, losses)
    for scan in lasers:
        chooser.see(scan)
    return chooser.views()
