"""From odometry and laser scans to the robot's trajectory in the geometric map. Sect. 2.2.

Scans are used when the robot has moved since the last one used: standing still, the same view
again is no new evidence. While the particles do not agree, what was seen is kept, and once they
do, the filter runs back over it: a whole run is at hand, so its beginning need not be lost.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from copy import copy
from dataclasses import dataclass
from itertools import chain

import numpy as np

from soundmap.config import LocalizeConfig
from soundmap.deskew import Rays, deskewed_rays
from soundmap.errors import MapError, NothingUsableError
from soundmap.geometry import FloatArray, Trajectory, composed, relative, transformed
from soundmap.grid import OccupancyGrid
from soundmap.localize.global_start import start_hypotheses
from soundmap.localize.particle_filter import ParticleFilter
from soundmap.losses import LossLedger
from soundmap.sensors import LaserScan

STAGE = "localize"
LEAST_RAYS = 10
"""A scan with fewer returns says too little about the pose."""
LOST_AFTER_S = 2.0
"""Without a match for this long, the pose is sought in the whole map."""
ODOMETRY_DRIFT = 0.2
"""Worst drift of any odometry in use [m/m and rad/m]."""
ELSEWHERE_MATCH = 0.8
"""Share of a scan that must match to believe that the robot is where odometry cannot have led."""
OPENING_NS = 300_000_000
"""Scans this close together are matched to the map as one."""
MOST_PENDING = 20_000
"""Scans kept while the particles do not agree; bounds the memory of a run that stays lost."""


@dataclass(frozen=True)
class View:
    """One laser scan used: what was seen, and where the odometry thought the robot was."""

    rays: Rays
    odometry: FloatArray
    driven_m: float
    is_new_place: bool
    scanner: int
    range_max_m: float


@dataclass(frozen=True)
class Fix:
    """The pose found for a view, the share of it that the map explains, and whether to trust it."""

    view: View
    pose: FloatArray
    matched: float
    usable: bool

    @property
    def time_ns(self) -> int:
        """Time of the pose [ns since epoch]."""
        return self.view.rays.time_ns


def estimate_trajectory(
    lasers: Iterable[LaserScan],
    odometry: Trajectory,
    room: OccupancyGrid,
    config: LocalizeConfig,
    *,
    start_pose: tuple[float, float, float] | None = None,
    losses: LossLedger | None = None,
) -> Trajectory:
    """Trajectory of the base in the map, one pose a laser scan used.

    Parameters
    ----------
    lasers : iterable of LaserScan
        Of any number of scanners, ordered by time.
    odometry : Trajectory
        Base in the odometry frame.
    room : OccupancyGrid
        The geometric map.
    config : LocalizeConfig
    start_pose : tuple of float, optional
        x [m], y [m], heading [rad] at the first scan; without it the whole map is searched.
    losses : LossLedger, optional
        Where scans that could not be used are counted.

    Returns
    -------
    Trajectory
        `Trajectory.usable` where the particles were concentrated and the scans matched the map.

    Raises
    ------
    NothingUsableError
        No scan has enough returns within the time of the odometry, or the odometry stands still
        while the scans change.
    MapError
        The scans never match the map.
    """
    losses = LossLedger() if losses is None else losses
    views = _views(lasers, odometry, config, losses)
    localizer = _Localizer(room, config, np.random.default_rng(config.seed), losses)
    opening = _opening(views)
    localizer.start(opening, None if start_pose is None else np.array(start_pose))
    for view in chain(opening, views):
        localizer.add(view)
    return _checked(localizer.fixes, room, config, losses)


def _opening(views: Iterator[View]) -> list[View]:
    """The first moment of the run: by then every scanner has been heard."""
    opening = [next(views)]
    for view in views:
        opening.append(view)
        if view.rays.time_ns - opening[0].rays.time_ns > OPENING_NS:
            break
    return opening


def _views(
    lasers: Iterable[LaserScan], odometry: Trajectory, config: LocalizeConfig, losses: LossLedger
) -> Iterator[View]:
    """The scans worth using, deskewed; among them the first and the last of every scanner."""
    last_used: dict[int, View] = {}
    last_new: dict[int, View] = {}
    passed_over: dict[int, LaserScan] = {}
    witness, look = _StandstillWitness(odometry), _Look(odometry, config.beams)
    for scan in lasers:
        place = odometry.at(scan.middle_ns)
        if not np.isfinite(place).all():
            losses.add("laser scan without odometry", STAGE, effect="scan not used")
            continue
        earlier, newest = last_used.get(scan.scanner), last_new.get(scan.scanner)
        is_new = newest is None or _is_new_place(relative(newest.odometry, place), config)
        waited_s = 0.0 if earlier is None else (scan.middle_ns - earlier.rays.time_ns) * 1e-9
        if not is_new and waited_s < config.update_interval_s:
            passed_over[scan.scanner] = scan
            continue
        view = look.at(scan, is_new)
        if len(view.rays) < LEAST_RAYS:
            losses.add("laser scan with too few returns", STAGE, effect="scan not used")
            continue
        passed_over.pop(scan.scanner, None)
        last_used[scan.scanner] = view
        if is_new:
            last_new[scan.scanner] = view
        witness.see(scan)
        yield view
    if not last_used:
        raise NothingUsableError(
            "no laser scan has enough returns at a time that the odometry spans; the robot cannot "
            "be localized. `soundmap info` shows what the log holds."
        )
    for scan in sorted(passed_over.values(), key=lambda scan: scan.middle_ns):
        yield look.at(scan, False)


def _is_new_place(step: FloatArray, config: LocalizeConfig) -> bool:
    moved_m, turned_rad = np.hypot(step[0], step[1]), abs(step[2])
    return bool(moved_m >= config.update_distance_m or turned_rad >= config.update_angle_rad)


class _Look:
    """Turns laser scans into views along one odometry."""

    def __init__(self, odometry: Trajectory, most_rays: int) -> None:
        self._odometry, self._most_rays = odometry, most_rays
        self._driven_m = odometry.driven_m()

    def at(self, scan: LaserScan, is_new_place: bool) -> View:
        time_ns = scan.middle_ns
        return View(
            rays=deskewed_rays(scan, self._odometry, time_ns, most=self._most_rays),
            odometry=self._odometry.at(time_ns),
            driven_m=float(np.interp(time_ns, self._odometry.time_ns, self._driven_m)),
            is_new_place=is_new_place,
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
        moved_share = np.mean(np.abs(first[both] - scan.range_m[both]) > 0.2) if both.any() else 0.0
        self._changed = self._changed + 1 if moved_share > 0.4 else 0
        if self._changed >= 5:
            raise NothingUsableError(
                "the odometry never moves although the laser scans show that the robot does. "
                "Check the odometry topic ([topics] odometry); `soundmap info` lists them."
            )


class _Localizer:
    """Runs the particle filter over the views; seeks the pose in the whole map when it is lost."""

    def __init__(
        self,
        room: OccupancyGrid,
        config: LocalizeConfig,
        rng: np.random.Generator,
        losses: LossLedger,
    ) -> None:
        self._room, self._config, self._rng, self._losses = room, config, rng, losses
        self._filter: ParticleFilter | None = None
        self._odometry = np.zeros(3)
        self._pending: list[tuple[int, View]] = []
        self._anchor: Fix | None = None
        self._recent: dict[int, View] = {}
        self._matched_ns = 0
        self._patience_s = LOST_AFTER_S
        self.fixes: list[Fix] = []

    def start(self, opening: list[View], start_pose: FloatArray | None) -> None:
        """Place the particles, from a given pose or by a search with the first views."""
        first = opening[0]
        if start_pose is None:
            hypotheses, _ = start_hypotheses(self._room, _joined_rays(opening, first))
            if len(hypotheses) == 0:
                raise MapError("the map has no free space in which the robot could stand.")
        else:
            hypotheses = start_pose[None, :]
        self._filter = self._seeded(hypotheses, first)
        self._odometry, self._matched_ns = first.odometry, first.rays.time_ns

    def add(self, view: View) -> None:
        """Use one more scan."""
        if self._filter is None:
            raise ValueError("start the localizer first")
        self._filter.predict(relative(self._odometry, view.odometry))
        self._odometry = view.odometry
        self._recent[view.scanner] = view
        if view.is_new_place:
            self._filter.correct(view.rays)
        fix = self._fix(self._filter, view)
        self.fixes.append(fix)
        self._anchor = fix if fix.usable else self._anchor
        if fix.matched >= self._config.min_match:
            self._matched_ns, self._patience_s = view.rays.time_ns, LOST_AFTER_S
        if fix.usable:
            self._look_back(self._filter)
            return
        if len(self._pending) < MOST_PENDING:
            self._pending.append((len(self.fixes) - 1, view))
        if (view.rays.time_ns - self._matched_ns) * 1e-9 > self._patience_s:
            self._seek(view, fix.pose)

    def _seeded(self, hypotheses: FloatArray, view: View) -> ParticleFilter:
        return ParticleFilter(
            self._room,
            hypotheses,
            self._config,
            range_max_m=view.range_max_m,
            rng=self._rng,
        )

    def _fix(self, particle_filter: ParticleFilter, view: View) -> Fix:
        estimate = particle_filter.estimate()
        matched = particle_filter.matched(estimate, view.rays)
        needed = self._config.min_match
        if self._anchor is not None and not _consistent(self._anchor, view, estimate.pose):
            needed = max(needed, ELSEWHERE_MATCH)
        usable = matched >= needed and particle_filter.concentrated(estimate)
        return Fix(view, estimate.pose, matched, usable)

    def _look_back(self, particle_filter: ParticleFilter) -> None:
        """Run back over the views that came before the particles agreed."""
        pending, self._pending = self._pending, []
        backward, odometry = copy(particle_filter), self._odometry
        for index, view in reversed(pending):
            backward.predict(relative(odometry, view.odometry))
            odometry = view.odometry
            if view.is_new_place:
                backward.correct(view.rays)
            fix = self._fix(backward, view)
            if fix.usable:
                self.fixes[index] = fix

    def _seek(self, view: View, expected: FloatArray) -> None:
        """Search the whole map; the pose expected from odometry stays a hypothesis."""
        near = [
            recent
            for recent in self._recent.values()
            if abs(recent.rays.time_ns - view.rays.time_ns) < OPENING_NS
        ]
        hypotheses, _ = start_hypotheses(self._room, _joined_rays(near, view))
        self._filter = self._seeded(np.vstack([hypotheses, expected]), view)
        self._matched_ns, self._patience_s = view.rays.time_ns, 2.0 * self._patience_s
        self._losses.remark(
            "laser scans stopped matching the map",
            STAGE,
            effect="pose sought in the whole map",
        )


def _consistent(anchor: Fix, view: View, pose: FloatArray) -> bool:
    """Whether the odometry can have led from a trusted pose to this one."""
    expected = composed(anchor.pose, relative(anchor.view.odometry, view.odometry))
    driven_m = abs(view.driven_m - anchor.view.driven_m)
    off = relative(expected, pose)
    near = np.hypot(off[0], off[1]) <= 0.5 + ODOMETRY_DRIFT * driven_m
    return bool(near and abs(off[2]) <= np.radians(20.0) + ODOMETRY_DRIFT * driven_m)


def _joined_rays(views: list[View], reference: View) -> Rays:
    """The rays of several views in the base frame of one of them."""
    origins, ends = [], []
    for view in views:
        motion = relative(reference.odometry, view.odometry)
        origins.append(transformed(motion, view.rays.origin_m))
        ends.append(transformed(motion, view.rays.end_m))
    return Rays(reference.rays.time_ns, np.concatenate(origins), np.concatenate(ends))


def _checked(
    fixes: list[Fix], room: OccupancyGrid, config: LocalizeConfig, losses: LossLedger
) -> Trajectory:
    """The fixes as a trajectory; an error if none of them may be trusted."""
    fixes = sorted(fixes, key=lambda fix: fix.time_ns)
    time_ns = np.array([fix.time_ns for fix in fixes], dtype=np.int64)
    last_of_its_time = np.append(np.diff(time_ns) > 0, True)
    trajectory = Trajectory(
        time_ns[last_of_its_time],
        np.array([fix.pose for fix in fixes])[last_of_its_time],
        np.array([fix.usable for fix in fixes])[last_of_its_time],
    )
    lost = int(np.count_nonzero(~trajectory.usable))
    if lost == len(trajectory):
        matched = float(np.median([fix.matched for fix in fixes]))
        left, right, bottom, top = room.frame.extent_m
        raise MapError(
            f"the laser scans do not match the map, which spans x {left:.1f} to {right:.1f} m and "
            f"y {bottom:.1f} to {top:.1f} m: at the best pose found, {matched:.0%} of a scan's "
            f"returns lie on its walls, expected {config.min_match:.0%} or more. Is it the map of "
            "this site, are the scanners' mounts right, and is --start-pose (if given) that of "
            "the first scan?"
            if matched < config.min_match
            else "the pose cannot be told from the laser scans: the map looks alike in several "
            "places. Give the start with --start-pose X,Y,DEG."
        )
    losses.add("robot not localized", STAGE, effect="sound not fused", count=lost)
    return trajectory
