"""From laser scans and odometry to the geometric map and the trajectory in it. Sect. 2.1.

Key scans are laid on their neighbours one by one, loops are closed as they are met, all overlapping
scans are relaxed together, and the rays of the relaxed scans are drawn.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.carrying import carried_poses, odometry_times_between, slipped
from soundmap.config import MappingConfig
from soundmap.geometry import FloatArray, Trajectory, composed, inverted, relative
from soundmap.grid import OccupancyGrid
from soundmap.losses import LossLedger
from soundmap.mapping.growing_graph import GrowingGraph
from soundmap.mapping.key_scans import STAGE, KeyScan, KeyScans, chosen_key_scans
from soundmap.mapping.links import odometry_links
from soundmap.mapping.loops import LoopSearch, close_loops
from soundmap.mapping.occupancy import drawn_map
from soundmap.mapping.pose_graph import Links, solved_graph, told_errors
from soundmap.mapping.relaxation import relaxed_poses
from soundmap.odometry_model import OdometryModel, fitted_odometry
from soundmap.sensors import LaserScan

LOOP_EVERY_M = 1.0
"""Way between two searches for loops."""
FIRST_GATES_M, FIRST_FINE_ROUNDS = (0.4, 0.3, 0.2), 1
LAST_GATES_M, LAST_FINE_ROUNDS = (0.25, 0.2, 0.15, 0.12, 0.12, 0.10), 3
FIRST_LEARNT_M = 8.0
"""Way after which the errors of the odometry are learnt; then each time it has grown by half."""
FIRM_M = 0.04
"""Surfaces hold a scan in place if they tell its place in every direction at least this well."""
UNKNOWN_SCALE = 0.03
"""What stays unknown of the odometry's scale after it has been learnt [m/m]."""
MOST_DRIFT_M = 0.2
"""A pose that may have drifted farther from those that are held in place is not usable."""
CARRIED_M = 3.0
"""Over more way than this without a surface in sight odometry, which bends, ties no two places."""
RARE_NS = 200_000_000
"""Where laser scans are farther apart, the trajectory has the poses of the odometry as well."""
GROWING, RELAXING = 0.7, 0.3
"""Shares of the work, for the progress shown."""


@dataclass(frozen=True)
class MapFacts:
    """How the map came about.

    Attributes
    ----------
    key_scans : int
        Scans that it is made of.
    unmatched : int
        Key scans that fitted none of their neighbours and stand where odometry put them.
    loops_searched, loops_recognised, loops_closed : int
        Searches for places seen before, places recognised, and ties that the whole map bore out.
    links : int
        Pairs of scans that hold each other in place.
    residual_m, residual_rad : float
        Median disagreement of a pair of scans with the map, where it tells its place [m, rad].
    body_returns : int
        Returns removed because they came from the robot itself.
    odometry : OdometryModel
        Systematic and random errors of the odometry, from the finished map.
    """

    key_scans: int
    unmatched: int
    loops_searched: int
    loops_recognised: int
    loops_closed: int
    links: int
    residual_m: float
    residual_rad: float
    body_returns: int
    odometry: OdometryModel


@dataclass(frozen=True)
class BuiltMap:
    """The geometric map of a run and the trajectory in it; the origin is at the first pose.

    Attributes
    ----------
    room : OccupancyGrid
    trajectory : Trajectory
        Base in the map frame, one pose a laser scan, and one an odometry pose where laser scans
        are rare; those between key scans are carried there by odometry. Usable near key scans that
        fit the map and are held in place by it, or not far from such.
    facts : MapFacts
    """

    room: OccupancyGrid
    trajectory: Trajectory
    facts: MapFacts


def build_map(
    lasers: Callable[[], Iterable[LaserScan]],
    odometry: Trajectory,
    config: MappingConfig,
    *,
    losses: LossLedger | None = None,
    report: Callable[[float], None] = lambda _: None,
) -> BuiltMap:
    """Map and trajectory from laser scans and odometry alone.

    Parameters
    ----------
    lasers : callable
        Gives the scans of all scanners, ordered by time; a fresh pass a call.
    odometry : Trajectory
        Base in the odometry frame.
    config : MappingConfig
    losses : LossLedger, optional
        Where what could not be used is counted.
    report : callable, optional
        Told the share of the work that is done, 0 to 1.

    Raises
    ------
    NothingUsableError
        No scan has enough returns within the time of the odometry.
    """
    losses = LossLedger() if losses is None else losses
    keys = chosen_key_scans(
        lasers(),
        odometry,
        distance_m=config.key_distance_m,
        angle_rad=config.key_angle_rad,
        most_returns=config.returns,
        spacing_m=config.return_spacing_m,
        losses=losses,
    )
    model = OdometryModel(
        noise_distance_per_metre=config.noise_distance_per_metre,
        noise_turn_per_metre=config.noise_turn_per_metre,
        noise_turn_per_turn=config.noise_turn_per_turn,
    )
    graph = GrowingGraph(keys.scans, model, config.neighbours)
    search = _grown(graph, config, report)
    pose, _ = _relaxed(keys.scans, graph.pose, model, config, FIRST_GATES_M, FIRST_FINE_ROUNDS)
    graph.replace_poses(pose)
    search += _searched_again(graph, config)
    model = _fitted_model(keys.scans, graph.pose, model)
    pose, links = _relaxed(
        keys.scans,
        graph.pose,
        model,
        config,
        LAST_GATES_M,
        LAST_FINE_ROUNDS,
        lambda done: report(GROWING + RELAXING * done),
    )
    losses.add(
        "laser scan that fits none of its neighbours",
        STAGE,
        effect="placed by odometry",
        count=int(np.count_nonzero(~graph.matched)),
    )
    driven_m = np.array([scan.driven_m for scan in keys.scans])
    surfaces = _of_surfaces(links, len(pose))
    held = held_in_place(pose, surfaces, driven_m, most_drift_m=MOST_DRIFT_M)
    tied = tied_together(surfaces, driven_m)
    losses.add(
        "laser scan whose surroundings do not tell the way along them",
        STAGE,
        effect="pose flagged",
        count=int(np.count_nonzero(~held)),
    )
    losses.add(
        "laser scan that odometry alone ties to the map, over metres without a surface in sight",
        STAGE,
        effect="pose flagged, the map may be wrong there",
        count=int(np.count_nonzero(~tied)),
    )
    facts = _facts(keys, pose, links, graph.matched, search, model)
    pose = composed(inverted(pose[0]), pose)
    key_ns = np.array([key.time_ns for key in keys.scans], dtype=np.int64)
    return BuiltMap(
        drawn_map(keys.scans, pose, cell_m=config.cell_m, occupied_share=config.occupied_share),
        carried_trajectory(keys.time_ns, odometry, key_ns, pose, graph.matched & held & tied),
        facts,
    )


def _grown(
    graph: GrowingGraph, config: MappingConfig, report: Callable[[float], None]
) -> LoopSearch:
    """Add all scans, closing loops on the way."""
    search = LoopSearch()
    distance, searched_m, learn_m = np.zeros(1), 0.0, FIRST_LEARNT_M
    for new in range(1, len(graph.scans)):
        graph.add_next(distance)
        if graph.scans[new].driven_m > learn_m:
            learn_m *= 1.5
            graph.adopt(_learnt_model(graph))
        step = float(np.hypot(*(graph.pose[new, :2] - graph.pose[new - 1, :2])))
        distance = np.append(distance + step, 0.0)
        driven_m = graph.scans[new].driven_m
        if driven_m - searched_m >= LOOP_EVERY_M or new == len(graph.scans) - 1:
            searched_m = driven_m
            distance = graph.distances_from(new)
            outcome = close_loops(graph, new, distance, most_drift_m=config.loop_window_m)
            if outcome.closed:
                distance = graph.distances_from(new)
            search += outcome
        report(GROWING * new / len(graph.scans))
    return search


def _learnt_model(graph: GrowingGraph) -> OdometryModel:
    """Systematic errors of the odometry so far; its noise is not yet believed to be small."""
    fitted = _fitted_model(graph.scans[: graph.count], graph.pose, graph.model)
    return dataclasses.replace(
        fitted,
        noise_distance_per_metre=max(fitted.noise_distance_per_metre, 0.03),
        noise_turn_per_metre=max(fitted.noise_turn_per_metre, 0.02),
        noise_turn_per_turn=max(fitted.noise_turn_per_turn, 0.03),
    )


def _searched_again(graph: GrowingGraph, config: MappingConfig) -> LoopSearch:
    """Loops that were missed on the way, now that the poses are better."""
    search, searched_m = LoopSearch(), -np.inf
    for scan in range(len(graph.scans)):
        if graph.scans[scan].driven_m - searched_m < LOOP_EVERY_M:
            continue
        searched_m = graph.scans[scan].driven_m
        distance = graph.distances_from(scan)
        search += close_loops(graph, scan, distance, most_drift_m=config.loop_window_m)
    if search.closed:
        graph.replace_poses(solved_graph(graph.pose, graph.links()).pose)
    return search


def _relaxed(
    scans: Sequence[KeyScan],
    pose: FloatArray,
    model: OdometryModel,
    config: MappingConfig,
    gates_m: Sequence[float],
    fine_rounds: int,
    report: Callable[[float], None] = lambda _: None,
) -> tuple[FloatArray, Links]:
    return relaxed_poses(
        scans,
        pose,
        odometry_links(scans, model),
        neighbours=config.neighbours,
        gates_m=gates_m,
        fine_rounds=fine_rounds,
        report=report,
    )


def _facts(
    keys: KeyScans,
    pose: FloatArray,
    links: Links,
    matched: NDArray[np.bool_],
    search: LoopSearch,
    model: OdometryModel,
) -> MapFacts:
    surfaces = _of_surfaces(links, len(pose))
    off_m, off_rad = told_errors(pose, surfaces)
    found = len(surfaces) > 0
    return MapFacts(
        key_scans=len(pose),
        unmatched=int(np.count_nonzero(~matched)),
        loops_searched=search.tried,
        loops_recognised=search.found,
        loops_closed=search.closed,
        links=len(surfaces),
        residual_m=float(np.median(off_m)) if found else 0.0,
        residual_rad=float(np.median(off_rad)) if found else 0.0,
        body_returns=keys.body_returns,
        odometry=_fitted_model(keys.scans, pose, model),
    )


def _of_surfaces(links: Links, scans: int) -> Links:
    """The links that come from surfaces: the first of all are the odometry's."""
    first = scans - 1
    return Links(links.pairs[first:], links.measured[first:], links.information[first:])


def held_in_place(
    pose: FloatArray, links: Links, driven_m: FloatArray, *, most_drift_m: float
) -> NDArray[np.bool_]:
    """Whether surfaces hold each key scan in every direction, or odometry has not far to carry it.

    Along a corridor without features only odometry tells the way, with `UNKNOWN_SCALE` of error.

    Parameters
    ----------
    pose : ndarray, shape (K, 3)
    links : Links
        Those that come from surfaces.
    driven_m : ndarray, shape (K,)
        Way up to each scan [m].
    most_drift_m : float
        Greatest drift of a pose that is still known [m].
    """
    heading = pose[links.pairs[:, 1], 2]
    cos, sin = np.cos(heading), np.sin(heading)
    turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], axis=1)
    in_map = turn @ links.information[:, :2, :2] @ turn.swapaxes(1, 2)
    held = np.zeros((len(pose), 2, 2))
    for end in range(2):
        np.add.at(held, links.pairs[:, end], in_map)
    firm = np.linalg.eigvalsh(held)[:, 0] >= FIRM_M**-2.0
    if not firm.any():
        return firm
    after = np.searchsorted(driven_m[firm], driven_m).clip(0, np.count_nonzero(firm) - 1)
    before = np.maximum(after - 1, 0)
    away_m = np.minimum(
        np.abs(driven_m[firm][after] - driven_m), np.abs(driven_m[firm][before] - driven_m)
    )
    return UNKNOWN_SCALE * away_m <= most_drift_m


def tied_together(links: Links, driven_m: FloatArray) -> NDArray[np.bool_]:
    """Which key scans belong to the greatest piece of the map that surfaces hold together.

    Parameters
    ----------
    links : Links
        Those that come from surfaces.
    driven_m : ndarray, shape (K,)
        Way up to each scan [m].
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(driven_m)
    near = np.flatnonzero(np.diff(driven_m) <= CARRIED_M)
    pairs = np.concatenate([links.pairs, np.stack([near, near + 1], axis=-1)])
    ties = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    _, piece = connected_components(ties, directed=False)
    return np.asarray(piece == np.bincount(piece).argmax())


def _fitted_model(
    scans: Sequence[KeyScan], pose: FloatArray, model: OdometryModel
) -> OdometryModel:
    """The errors of the odometry over pieces long enough to rise above those of the map."""
    driven = np.array([scan.driven_m for scan in scans])
    turned = np.array([scan.turned_rad for scan in scans])
    piece = np.floor(driven / 0.5 + turned / 0.5).astype(np.int64)
    ends = np.flatnonzero(np.append(True, np.diff(piece) > 0))
    odometry = np.array([scan.odometry for scan in scans])
    return fitted_odometry(
        relative(odometry[ends[:-1]], odometry[ends[1:]]),
        relative(pose[ends[:-1]], pose[ends[1:]]),
        model,
    )


def carried_trajectory(
    scan_ns: NDArray[np.int64],
    odometry: Trajectory,
    key_ns: NDArray[np.int64],
    pose: FloatArray,
    matched: NDArray[np.bool_],
) -> Trajectory:
    """Poses of all laser scans, and between rare ones of the odometry, from those of key scans.

    Parameters
    ----------
    scan_ns : ndarray of int64, shape (S,)
        Times of the laser scans, increasing, within the time of the odometry.
    odometry : Trajectory
    key_ns : ndarray of int64, shape (K,)
    pose : ndarray, shape (K, 3)
        Of the key scans.
    matched : ndarray of bool, shape (K,)
        Whether a key scan fits the map.
    """
    between = odometry_times_between(scan_ns, odometry, rare_ns=RARE_NS)
    time_ns = np.union1d(scan_ns, between)
    carried, before, after = carried_poses(time_ns, odometry, key_ns, pose)
    slips = np.concatenate([[False], slipped(odometry.at(key_ns), pose), [False]])
    usable = (matched[before] | matched[after]) & ~(slips[after] | slips[before + 1])
    driven_m = odometry.driven_m()
    at_m, key_m = (np.interp(ns, odometry.time_ns, driven_m) for ns in (time_ns, key_ns))
    away_m = np.minimum(np.abs(at_m - key_m[before]), np.abs(at_m - key_m[after]))
    usable &= away_m <= CARRIED_M
    return Trajectory(time_ns, carried, usable, is_scan=np.isin(time_ns, scan_ns))
