"""From odometry and laser scans to the robot's trajectory in the geometric map. Sect. 2.2."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from soundmap.carrying import carried_poses, odometry_times_between
from soundmap.config import LocalizeConfig
from soundmap.errors import MapError
from soundmap.geometry import FloatArray, Trajectory, relative
from soundmap.grid import OccupancyGrid
from soundmap.localize.agreement import Agreement, agreement
from soundmap.localize.mounts import MountOffset, added, mount_offsets, remounted
from soundmap.localize.placement import (
    CANNOT_TELL,
    FIRST_MATCH,
    MOST_BEYOND,
    Placement,
)
from soundmap.localize.smoothing import SmoothedPoses, carried, smoothed_poses
from soundmap.localize.tracking import Tracker
from soundmap.localize.trust import bridged, slipping, without_scraps
from soundmap.localize.views import STAGE, Views, chosen_views
from soundmap.localize.wall_fit import WallFit
from soundmap.losses import LossLedger
from soundmap.odometry_model import OdometryModel, fitted_odometry
from soundmap.sensors import LaserScan

UNKNOWN_ODOMETRY = OdometryModel(
    noise_distance_per_metre=0.3, noise_turn_per_metre=0.2, noise_turn_per_turn=0.3
)
"""What is believed of the odometry before the run has shown how good it is: not much."""
RARE_NS = 600_000_000
"""Between laser scans farther apart than this, odometry carries the pose."""
MOUNT_ROUNDS = 4
"""Times that the mounts are found again from poses that fit them better."""
ROUNDS = 4
"""Times that all poses are smoothed and it is judged anew which of them to trust."""

MOST_IN_WALLS = 0.5
"""A map in which more of the way than this leads through walls shows something else."""


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
        `Trajectory.usable` where the pose is known well and the scans match the map.

    Raises
    ------
    NothingUsableError
        No scan has enough returns within the time of the odometry, or the odometry stands still
        while the scans change.
    MapError
        The scans never match the map, or match it equally well in several places.
    """
    losses = LossLedger() if losses is None else losses
    views = chosen_views(lasers, odometry, config, losses)
    return localized(views, odometry, room, config, start_pose=start_pose, losses=losses)


def localized(
    views: Views,
    odometry: Trajectory,
    room: OccupancyGrid,
    config: LocalizeConfig,
    *,
    start_pose: tuple[float, float, float] | None = None,
    losses: LossLedger,
) -> Trajectory:
    """The trajectory from views that were gathered before; as `estimate_trajectory`."""
    start = None if start_pose is None else np.array(start_pose, dtype=np.float64)
    placement = Placement(room, views, config, losses)
    placement.find(start)
    estimate = Estimate(placement.pose, placement.known, placement.matched, placement.beyond)
    if estimate.usable.any():
        if config.smoothing:
            estimate = _smoothed(estimate, views, room, config)
            if config.refine_mounts != "off" and estimate.usable.any():
                refined = _with_refined_mounts(estimate, views, room, config, losses)
                estimate = refined if config.refine_mounts == "correct" else estimate
        else:
            estimate = _filtered(estimate, views, room, config)
    return _joined(_checked(estimate, views, room, losses), odometry)


@dataclass(frozen=True)
class Estimate:
    """A pose for each of K views, how the map agrees with it, and whether to trust it.

    Attributes
    ----------
    pose : ndarray, shape (K, 3)
    usable : ndarray of bool, shape (K,)
    matched, beyond : ndarray, shape (K,)
    covariance : ndarray, shape (K, 3, 3), or None
    """

    pose: FloatArray
    usable: NDArray[np.bool_]
    matched: FloatArray
    beyond: FloatArray
    covariance: FloatArray | None = None


def _filtered(
    estimate: Estimate, views: Views, room: OccupancyGrid, config: LocalizeConfig
) -> Estimate:
    """The particle filter's poses, as in the paper."""
    tracker = Tracker(room, views, estimate.usable, estimate.pose, config)
    tracker.track()
    return Estimate(tracker.pose, tracker.usable, tracker.matched, tracker.beyond)


def _smoothed(
    estimate: Estimate, views: Views, room: OccupancyGrid, config: LocalizeConfig
) -> Estimate:
    """Most likely poses given the whole run, and judged again there."""
    reported = relative(views.odometry[:-1], views.odometry[1:])
    pose, trusted = estimate.pose, estimate.usable
    tolerance_m = 3.0 * config.hit_sigma_m
    agreed = agreement(room, pose, views, tolerance_m=tolerance_m)
    walls, model = WallFit(room, config), UNKNOWN_ODOMETRY
    for round_ in range(ROUNDS):
        step = model.corrected(reported)
        weight = model.information(np.hypot(step[:, 0], step[:, 1]), np.abs(step[:, 2]))
        pose = carried(pose, step, trusted)
        counts = agreed.is_matched & np.repeat(trusted, np.diff(views.first))
        scans = walls.evidence(views, counts, pose, by_lines=round_ > 0)
        result = smoothed_poses(step, weight, pose, scans)
        del scans  # holds a copy of all returns that count
        pose = result.pose
        agreed = agreement(room, pose, views, tolerance_m=tolerance_m)
        way_m = np.concatenate([[0.0], np.cumsum(np.hypot(step[:, 0], step[:, 1]))])
        trusted = _trusted(agreed, result, trusted, way_m, config)
        trusted = without_scraps(trusted, pose, step, way_m)
        if not trusted.any():
            break
        if round_ == 0:  # later poses follow the odometry and cannot judge it
            both = trusted[:-1] & trusted[1:]
            found = relative(pose[:-1], pose[1:])
            model = _not_too_sure(fitted_odometry(reported[both], found[both], model), config)
    trusted = trusted & ~slipping(views.time_ns, pose, reported)
    return Estimate(pose, trusted, agreed.matched, agreed.beyond, result.covariance)


def _with_refined_mounts(
    estimate: Estimate,
    views: Views,
    room: OccupancyGrid,
    config: LocalizeConfig,
    losses: LossLedger,
) -> Estimate:
    """The estimate with the scanners where scans and odometry put them, which is told."""
    offsets: list[MountOffset] = []
    walls = WallFit(room, config)
    for _ in range(MOUNT_ROUNDS):
        agreed = agreement(room, estimate.pose, views, tolerance_m=3.0 * config.hit_sigma_m)
        counts = agreed.is_matched & np.repeat(estimate.usable, np.diff(views.first))
        scans = walls.evidence(views, counts, estimate.pose, by_lines=True)
        found, pose = mount_offsets(views, estimate.pose, estimate.usable, scans)
        offsets, views = added(offsets, found), remounted(views, found)
        estimate = _smoothed(replace(estimate, pose=pose), views, room, config)
    both = estimate.usable[:-1] & estimate.usable[1:]
    wheels = fitted_odometry(
        relative(views.odometry[:-1], views.odometry[1:])[both],
        relative(estimate.pose[:-1], estimate.pose[1:])[both],
        UNKNOWN_ODOMETRY,
    )
    losses.remark(f"odometry seems to need {wheels}", STAGE, effect="corrected")
    for each in offsets:
        losses.remark(
            str(each),
            STAGE,
            effect="mount corrected" if config.refine_mounts == "correct" else "told only",
        )
    return estimate


def _not_too_sure(model: OdometryModel, config: LocalizeConfig) -> OdometryModel:
    """The model with no less noise than the particle filter assumes."""
    return replace(
        model,
        noise_distance_per_metre=max(
            model.noise_distance_per_metre, config.noise_distance_per_metre
        ),
        noise_turn_per_metre=max(model.noise_turn_per_metre, config.noise_turn_per_metre),
        noise_turn_per_turn=max(model.noise_turn_per_turn, config.noise_turn_per_turn),
    )


def _trusted(
    agreed: Agreement,
    result: SmoothedPoses,
    before: NDArray[np.bool_],
    way_m: FloatArray,
    config: LocalizeConfig,
) -> NDArray[np.bool_]:
    """Poses that are known well enough and whose scans match; new ones have to match better."""
    proved = (agreed.matched >= FIRST_MATCH) & (agreed.beyond <= MOST_BEYOND)
    variance = np.diagonal(result.covariance, axis1=1, axis2=2)
    near = np.sqrt(variance[:, 0] + variance[:, 1]) <= config.max_spread_m
    near &= np.sqrt(variance[:, 2]) <= config.max_spread_rad
    matching = near & np.where(before, agreed.matched >= config.min_match, proved)
    return near & bridged(matching, way_m)


def _checked(
    estimate: Estimate, views: Views, room: OccupancyGrid, losses: LossLedger
) -> Trajectory:
    """The estimate as a trajectory; an error if no pose of it may be trusted."""
    last_of_its_time = np.flatnonzero(np.append(np.diff(views.time_ns) > 0, True))
    usable = estimate.usable[last_of_its_time]
    if not usable.any():
        raise MapError(_why_lost(estimate, room))
    cells = room.frame.cells(estimate.pose[estimate.usable, :2])
    within = cells[room.frame.contains(cells)]
    if np.count_nonzero(room.occupied[within[:, 0], within[:, 1]]) > MOST_IN_WALLS * len(cells):
        raise MapError(
            "where the laser scans match the map best, the robot drives through what the map shows "
            "as occupied. Are free and occupied swapped in it (negate)?"
        )
    lost = int(np.count_nonzero(~usable))
    losses.add("robot not localized", STAGE, effect="sound not fused", count=lost)
    covariance = estimate.covariance
    return Trajectory(
        views.time_ns[last_of_its_time],
        estimate.pose[last_of_its_time],
        usable,
        None if covariance is None else covariance[last_of_its_time],
    )


def _joined(known: Trajectory, odometry: Trajectory) -> Trajectory:
    """The trajectory with poses carried by odometry between laser scans that are far apart."""
    between = odometry_times_between(known.time_ns, odometry, rare_ns=RARE_NS)
    if len(between) == 0:
        return known
    time_ns = np.union1d(known.time_ns, between)
    pose, before, after = carried_poses(time_ns, odometry, known.time_ns, known.pose)
    covariance = known.covariance
    if covariance is not None:
        size = np.trace(covariance[:, :2, :2], axis1=1, axis2=2)
        covariance = covariance[np.where(size[before] > size[after], before, after)]
    return Trajectory(
        time_ns,
        pose,
        known.usable[before] & known.usable[after],
        covariance,
        np.isin(time_ns, known.time_ns),
    )


def _why_lost(estimate: Estimate, room: OccupancyGrid) -> str:
    matched, beyond = float(np.median(estimate.matched)), float(np.median(estimate.beyond))
    if matched >= FIRST_MATCH and beyond <= MOST_BEYOND:
        return (
            CANNOT_TELL if estimate.covariance is None else _why_unknown(estimate.covariance, room)
        )
    left, right, bottom, top = room.frame.extent_m
    return (
        f"the laser scans do not match the map, which spans x {left:.1f} to {right:.1f} m and "
        f"y {bottom:.1f} to {top:.1f} m: at the best poses found, {matched:.0%} of a scan's "
        f"returns lie on its walls (expected {FIRST_MATCH:.0%} or more) and {beyond:.0%} behind "
        f"them (expected {MOST_BEYOND:.0%} or less). Is it the map of this site, are the scanners' "
        "mounts right, and is --start-pose (if given) that of the first scan?"
    )


def _why_unknown(covariance: FloatArray, room: OccupancyGrid) -> str:
    spread_m = float(np.sqrt(np.trace(covariance[:, :2, :2], axis1=1, axis2=2)).min())
    left, right, bottom, top = room.frame.extent_m
    is_anywhere = spread_m > 0.5 * max(right - left, top - bottom)
    known = "nowhere known" if is_anywhere else f"known to {spread_m:.1f} m at best"
    return (
        "the laser scans match the map, but nothing in their reach tells where along its walls the "
        f"robot is: its place along them is {known}. Does the run pass a corner, a "
        "door or the end of the corridor?"
    )
