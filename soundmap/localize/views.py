"""Which laser scans are worth using, and what the robot saw in them.

A scan is used when the robot has moved since the scanner's last one. Standing still, the same view
again is hardly new evidence: it counts a few times, until together the looks weigh as much as one
whole scan, and later only shows that the pose still holds.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from soundmap.config import LocalizeConfig
from soundmap.deskew import Rays, deskewed_rays
from soundmap.errors import NothingUsableError
from soundmap.geometry import FloatArray, Trajectory, relative, transformed
from soundmap.losses import LossLedger
from soundmap.sensors import LaserScan

STAGE = "localize"
LEAST_RAYS = 10
"""A scan with fewer returns says too little about the pose."""
LOOK_INTERVAL_S = 0.1
"""Time between the looks that count of a robot at rest."""
AT_REST = 0.2
"""A robot is at rest that has moved less than this share of the way to a new place."""


@dataclass(frozen=True)
class View:
    """One laser scan used: what was seen, and where the odometry thought the robot was.

    Attributes
    ----------
    rays : Rays
        In the base frame at their own time.
    odometry : ndarray, shape (3,)
        Base in the odometry frame at that time.
    driven_m : float
        Distance driven up to then [m].
    is_evidence : bool
        Whether the view says something new about the pose.
    scanner : int
    range_max_m : float
        Greatest range of the scanner [m].
    """

    rays: Rays
    odometry: FloatArray
    driven_m: float
    is_evidence: bool
    scanner: int
    range_max_m: float

    @property
    def time_ns(self) -> int:
        """Time of the view [ns since epoch]."""
        return self.rays.time_ns

    def without_rays(self) -> View:
        """The same view with nothing seen."""
        nothing = np.empty((0, 2))
        return replace(self, rays=Rays(self.time_ns, nothing, nothing))


@dataclass(frozen=True)
class _Place:
    """Where a scanner last looked from, how often, and when last."""

    odometry: FloatArray
    looks: int
    time_ns: int


def chosen_views(
    lasers: Iterable[LaserScan], odometry: Trajectory, config: LocalizeConfig, losses: LossLedger
) -> Iterator[View]:
    """The scans worth using, deskewed; among them the first and the last of every scanner.

    Raises
    ------
    NothingUsableError
        No scan has enough returns within the time of the odometry, or the odometry stands still
        while the scans change.
    """
    places: dict[int, _Place] = {}
    passed_over: dict[int, LaserScan] = {}
    witness, eye = _StandstillWitness(odometry), _Eye(odometry, config)
    for scan in lasers:
        position = odometry.at(scan.middle_ns)
        if not np.isfinite(position).all():
            losses.add("laser scan without odometry", STAGE, effect="scan not used")
            continue
        earlier = places.get(scan.scanner)
        looks = eye.looks_here(earlier, position)
        if earlier is not None and not eye.is_due(earlier, position, scan.middle_ns):
            passed_over[scan.scanner] = scan
            continue
        view = eye.view(scan, is_evidence=looks < eye.most_looks)
        if len(view.rays) < LEAST_RAYS:
            losses.add("laser scan with too few returns", STAGE, effect="scan not used")
            continue
        passed_over.pop(scan.scanner, None)
        from_here = position if looks == 0 or earlier is None else earlier.odometry
        places[scan.scanner] = _Place(from_here, looks + 1, scan.middle_ns)
        witness.see(scan)
        yield view
    if not places:
        raise NothingUsableError(
            "no laser scan has enough returns at a time that the odometry spans; the robot cannot "
            "be localized. `soundmap info` shows what the log holds."
        )
    for scan in sorted(passed_over.values(), key=lambda scan: scan.middle_ns):
        yield eye.view(scan, is_evidence=False)


def joined_rays(views: Iterable[View], reference: View) -> Rays:
    """The rays of several views in the base frame of one of them."""
    origins, ends = [], []
    for view in views:
        motion = relative(reference.odometry, view.odometry)
        origins.append(transformed(motion, view.rays.origin_m))
        ends.append(transformed(motion, view.rays.end_m))
    return Rays(reference.time_ns, np.concatenate(origins), np.concatenate(ends))


class _Eye:
    """Judges laser scans along one odometry, and turns them into views."""

    def __init__(self, odometry: Trajectory, config: LocalizeConfig) -> None:
        self._odometry, self._config = odometry, config
        self._driven_m = odometry.driven_m()
        self.most_looks = int(np.ceil(1.0 / config.likelihood_exponent))

    def looks_here(self, earlier: _Place | None, position: FloatArray) -> int:
        """How often the scanner has looked from this place already."""
        return 0 if earlier is None or self._way(earlier, position) >= 1.0 else earlier.looks

    def is_due(self, earlier: _Place, position: FloatArray, time_ns: int) -> bool:
        """Whether it is time for the scanner's next view."""
        way = self._way(earlier, position)
        at_rest = way < AT_REST and earlier.looks < self.most_looks
        interval_s = LOOK_INTERVAL_S if at_rest else self._config.update_interval_s
        return way >= 1.0 or (time_ns - earlier.time_ns) * 1e-9 >= interval_s

    def _way(self, earlier: _Place, position: FloatArray) -> float:
        """Motion since the scanner's last place, 1 where it makes a new one."""
        step = relative(earlier.odometry, position)
        moved = np.hypot(step[0], step[1]) / max(self._config.update_distance_m, 1e-9)
        return float(max(moved, abs(step[2]) / max(self._config.update_angle_rad, 1e-9)))

    def view(self, scan: LaserScan, *, is_evidence: bool) -> View:
        time_ns = scan.middle_ns
        return View(
            rays=deskewed_rays(scan, self._odometry, time_ns, most=self._config.beams),
            odometry=self._odometry.at(time_ns),
            driven_m=float(np.interp(time_ns, self._odometry.time_ns, self._driven_m)),
            is_evidence=is_evidence,
            scanner=scan.scanner,
            range_max_m=scan.range_max_m,
        )


class _StandstillWitness:
    """Notices odometry that stands still while the laser scans show that the robot moves."""

    def __init__(self, odometry: Trajectory) -> None:
        step = relative(odometry.pose[:-1], odometry.pose[1:])
        driven_m = np.hypot(step[:, 0], step[:, 1]).sum()
        turned_rad = np.abs(step[:, 2]).sum()
        self._stuck = bool(driven_m < 0.02 and turned_rad < np.radians(2.0))
        self._first: dict[int, FloatArray] = {}
        self._changed = 0

    def see(self, scan: LaserScan) -> None:
        if not self._stuck:
            return
        first = self._first.setdefault(scan.scanner, scan.range_m)
        if len(first) != len(scan.range_m):
            return
        both = np.isfinite(first) & np.isfinite(scan.range_m)
        moved_share = np.mean(np.abs(first[both] - scan.range_m[both]) > 0.1) if both.any() else 0.0
        self._changed = self._changed + 1 if moved_share > 0.3 else 0
        if self._changed >= 3:
            raise NothingUsableError(
                "the odometry never moves although the laser scans show that the robot does. "
                "Check the odometry topic ([topics] odometry); `soundmap info` lists them."
            )
