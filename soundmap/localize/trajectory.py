"""From odometry and laser scans to the robot's trajectory in the geometric map. Sect. 2.2."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from soundmap.config import LocalizeConfig
from soundmap.errors import MapError
from soundmap.geometry import FloatArray, Trajectory, relative
from soundmap.grid import OccupancyGrid
from soundmap.localize.global_start import NearbySearch
from soundmap.localize.likelihood import Agreement, scan_agreement
from soundmap.localize.smoothing import SmoothedPoses, carried, smoothed_poses
from soundmap.localize.tracking import FIRST_MATCH, MOST_BEYOND, OPENING_NS, Fix, Tracker
from soundmap.localize.views import STAGE, View, chosen_views
from soundmap.localize.wall_fit import WallFit
from soundmap.losses import LossLedger
from soundmap.odometry_model import OdometryModel, fitted_odometry
from soundmap.sensors import LaserScan

UNKNOWN_ODOMETRY = OdometryModel(
    noise_distance_per_metre=0.3, noise_turn_per_metre=0.2, noise_turn_per_turn=0.3
)
"""What is believed of the odometry before the run has shown how good it is: not much."""
POOR_MATCH = 0.9
CLEARLY_BETTER = 0.10
"""Below the first share of matched returns a better pose is sought nearby; by how much better."""
ROUNDS = 4
"""Times that all poses are smoothed and it is judged anew which of them to trust."""


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
    views = chosen_views(lasers, odometry, config, losses)
    tracker = Tracker(room, config, np.random.default_rng(config.seed), losses)
    opening = _opening(views)
    tracker.start(opening, None if start_pose is None else np.array(start_pose))
    for view in chain(opening, views):
        tracker.add(view)
    fixes = sorted(tracker.fixes, key=lambda fix: fix.time_ns)
    if config.smoothing and any(fix.usable for fix in fixes):
        fixes = _smoothed(fixes, room, config)
    return _checked(fixes, room, losses)


def _opening(views: Iterator[View]) -> list[View]:
    """The first moment of the run: by then every scanner has been heard."""
    opening = [next(views)]
    for view in views:
        opening.append(view)
        if view.time_ns - opening[0].time_ns > OPENING_NS:
            break
    return opening


def _smoothed(fixes: list[Fix], room: OccupancyGrid, config: LocalizeConfig) -> list[Fix]:
    """The fixes moved to their most likely poses given the whole run, and judged again there."""
    fixes = _moved_nearby(fixes, room, config)
    views = [fix.view for fix in fixes]
    odometry = np.array([view.odometry for view in views])
    reported = relative(odometry[:-1], odometry[1:])
    agreements = [fix.agreement for fix in fixes]
    pose = np.array([fix.pose for fix in fixes])
    trusted = np.array([fix.usable for fix in fixes])
    walls, model = WallFit(room, config), UNKNOWN_ODOMETRY
    for round_ in range(ROUNDS):
        step = model.corrected(reported)
        weight = model.information(np.hypot(step[:, 0], step[:, 1]), np.abs(step[:, 2]))
        pose = carried(pose, step, trusted)
        points = [
            view.rays.end_m[agreement.is_matched & usable]
            for view, agreement, usable in zip(views, agreements, trusted, strict=True)
        ]
        result = smoothed_poses(
            step, weight, pose, walls.evidence(points, pose, by_lines=round_ > 0)
        )
        pose = result.pose
        agreements = [
            _agreement(room, at, view, config) for at, view in zip(pose, views, strict=True)
        ]
        trusted = _trusted(agreements, result, trusted, config)
        if round_ == 0:  # later poses follow the odometry and cannot judge it
            both = trusted[:-1] & trusted[1:]
            found = relative(pose[:-1], pose[1:])
            model = _not_too_sure(fitted_odometry(reported[both], found[both], model), config)
    return [
        Fix(view, at, agreement, bool(usable), covariance)
        for view, at, agreement, usable, covariance in zip(
            views, pose, agreements, trusted, result.covariance, strict=True
        )
    ]


def _moved_nearby(fixes: list[Fix], room: OccupancyGrid, config: LocalizeConfig) -> list[Fix]:
    """The fixes that match poorly moved to where their scans match much better nearby, if so."""
    search = NearbySearch(room)
    moved = []
    for fix in fixes:
        if fix.agreement.matched < POOR_MATCH and len(fix.view.rays):
            pose = search.best(fix.pose, fix.view.rays)
            agreement = _agreement(room, pose, fix.view, config)
            if agreement.matched > fix.agreement.matched + CLEARLY_BETTER:
                proved = agreement.matched >= FIRST_MATCH and agreement.beyond <= MOST_BEYOND
                fix = replace(fix, pose=pose, agreement=agreement, usable=proved)
        moved.append(fix)
    return moved


def _agreement(
    room: OccupancyGrid, pose: FloatArray, view: View, config: LocalizeConfig
) -> Agreement:
    return scan_agreement(room, pose, view.rays, tolerance_m=3.0 * config.hit_sigma_m)


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
    agreements: list[Agreement],
    result: SmoothedPoses,
    before: NDArray[np.bool_],
    config: LocalizeConfig,
) -> NDArray[np.bool_]:
    """Poses that are known well enough and whose scans match; new ones have to match better."""
    matched = np.array([agreement.matched for agreement in agreements])
    beyond = np.array([agreement.beyond for agreement in agreements])
    proved = (matched >= FIRST_MATCH) & (beyond <= MOST_BEYOND)
    variance = np.diagonal(result.covariance, axis1=1, axis2=2)
    near = np.sqrt(variance[:, 0] + variance[:, 1]) <= config.max_spread_m
    near &= np.sqrt(variance[:, 2]) <= config.max_spread_rad
    return near & np.where(before, matched >= config.min_match, proved)


def _checked(fixes: list[Fix], room: OccupancyGrid, losses: LossLedger) -> Trajectory:
    """The fixes, ordered by time, as a trajectory; an error if none of them may be trusted."""
    time_ns = np.array([fix.time_ns for fix in fixes], dtype=np.int64)
    last_of_its_time = np.flatnonzero(np.append(np.diff(time_ns) > 0, True))
    kept = [fixes[index] for index in last_of_its_time]
    lost = sum(not fix.usable for fix in kept)
    if lost == len(kept):
        raise MapError(_why_lost(fixes, room))
    losses.add("robot not localized", STAGE, effect="sound not fused", count=lost)
    smoothed = all(fix.covariance is not None for fix in kept)
    return Trajectory(
        time_ns[last_of_its_time],
        np.array([fix.pose for fix in kept]),
        np.array([fix.usable for fix in kept]),
        np.array([fix.covariance for fix in kept]) if smoothed else None,
    )


def _why_lost(fixes: list[Fix], room: OccupancyGrid) -> str:
    matched = float(np.median([fix.agreement.matched for fix in fixes]))
    beyond = float(np.median([fix.agreement.beyond for fix in fixes]))
    if matched >= FIRST_MATCH and beyond <= MOST_BEYOND:
        return (
            "the pose cannot be told from the laser scans: the map looks alike in several "
            "places. Give the start with --start-pose X,Y,DEG."
        )
    left, right, bottom, top = room.frame.extent_m
    return (
        f"the laser scans do not match the map, which spans x {left:.1f} to {right:.1f} m and "
        f"y {bottom:.1f} to {top:.1f} m: at the best poses found, {matched:.0%} of a scan's "
        f"returns lie on its walls (expected {FIRST_MATCH:.0%} or more) and {beyond:.0%} behind "
        f"them (expected {MOST_BEYOND:.0%} or less). Is it the map of this site, are the scanners' "
        "mounts right, and is --start-pose (if given) that of the first scan?"
    )
