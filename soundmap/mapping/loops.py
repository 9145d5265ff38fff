"""Closing loops: recognising a place that was seen before, and making sure of it.

What the robot has seen over its last metres is searched for among older scans within the window
that the drift since then allows. A find counts if the surfaces match, if no other pose in the
window does nearly as well (a corridor is the same all along), if neither side looks through
surfaces of the other, and if the whole graph can follow without strain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, relative, transformed
from soundmap.mapping.alignment import PointStore, aligned_scan, pair_fits
from soundmap.mapping.correlation import best_placement, nearness_grid
from soundmap.mapping.growing_graph import GrowingGraph
from soundmap.mapping.key_scans import KeyScan, strip_order
from soundmap.mapping.links import scan_links
from soundmap.mapping.pose_graph import Links, link_costs, solved_graph

GAP_M = 10.0
"""Scans farther than this in the graph are worth tying together."""
NEAR_M = 3.0
VIEW_M = 3.0
"""What was seen over so much of the way is searched for at once."""
AROUND_M = 5.0
PLACE_M = 0.7
MOST_TARGETS = 80
TIED_TO = 12
DRIFT_M, DRIFT_M_PER_M = 0.4, 0.05
DRIFT_RAD, DRIFT_RAD_PER_M = np.radians(6.0), np.radians(0.7)
MOST_DRIFT_RAD = np.radians(45.0)
QUERY_SPACING_M = 0.10
LEAST_SCORE = 0.45
MOST_RIVAL = 0.88
RIVAL_BEYOND_M = 0.5
LEAST_MATCHED_SHARE = 0.6
MOST_SEEN_THROUGH = 0.2
LEAST_MATCHED = 20
GATES_M = (0.3, 0.15)
LOOSE = np.diag([1.0, 1.0, 10.0])
MOST_COST = 16.0
"""Greatest squared error of a loop's links once the graph has followed [sigma^2]."""
MOST_STRAIN = 300.0
"""Greatest rise of the squared errors of all older links together [sigma^2]."""


@dataclass(frozen=True)
class LoopSearch:
    """What came of one search.

    Attributes
    ----------
    tried, found, closed : int
        Regions searched, in which the scan was recognised, and to which it was tied.
    """

    tried: int = 0
    found: int = 0
    closed: int = 0

    def __add__(self, other: LoopSearch) -> LoopSearch:
        return LoopSearch(
            self.tried + other.tried, self.found + other.found, self.closed + other.closed
        )


def close_loops(
    graph: GrowingGraph, scan: int, distance: FloatArray, *, most_drift_m: float
) -> LoopSearch:
    """Look for the place of a scan among old ones and tie it to what is found.

    Parameters
    ----------
    graph : GrowingGraph
        Gets links and better poses.
    scan : int
    distance : ndarray, shape (count,)
        Ways through the graph from ``scan`` [m].
    most_drift_m : float
        Half width of the greatest window [m].
    """
    region, way = _region(graph, scan, distance, most_drift_m)
    if len(region) == 0:
        return LoopSearch()
    links = _recognised(graph, scan, region, way, most_drift_m)
    closed = links is not None and _tied(graph, links)
    return LoopSearch(1, int(links is not None), int(closed))


def _window(distance: FloatArray, most_drift_m: float) -> FloatArray:
    return np.minimum(DRIFT_M + DRIFT_M_PER_M * distance, most_drift_m)


def _region(
    graph: GrowingGraph, scan: int, distance: FloatArray, most_drift_m: float
) -> tuple[NDArray[np.int64], float]:
    """Old scans wherever the scan may stand, spread evenly, and the way to the farthest [m].

    All of the window has to be shown: where the true place is missing, a false one has no rival.
    """
    pose = graph.pose
    gap = np.hypot(*(pose[:, :2] - pose[scan, :2]).T)
    old = distance > GAP_M
    distance = np.minimum(distance, 1e6)
    candidates = old & (gap < NEAR_M + _window(distance, most_drift_m))
    if not candidates.any():
        return np.empty(0, dtype=np.int64), 0.0
    way = float(np.max(distance[candidates]))
    reach = AROUND_M + float(_window(np.array(way), most_drift_m))
    members = np.flatnonzero(old & (gap < reach))
    # One scan a place and direction shows all that there is to see.
    place = np.floor(pose[members, :2] / PLACE_M).astype(np.int64)
    sector = np.floor(pose[members, 2] / (np.pi / 2)).astype(np.int64)
    key = (place[:, 0] * 100_003 + place[:, 1]) * 8 + sector
    _, first = np.unique(key, return_index=True)
    chosen = members[np.sort(first)]
    return chosen[np.argsort(gap[chosen], kind="stable")][:MOST_TARGETS], way


def _recognised(
    graph: GrowingGraph,
    scan: int,
    region: NDArray[np.int64],
    way: float,
    most_drift_m: float,
) -> Links | None:
    """Links to the scans of a region if the scan's surroundings are found there."""
    view = recent_view(graph, scan)
    expected = graph.pose[scan]
    grid = nearness_grid(graph.points_of(region), expected[:2])
    found = best_placement(
        grid,
        _spaced(view.end_m),
        expected,
        window_m=float(_window(np.array(way), most_drift_m)),
        window_rad=min(DRIFT_RAD + DRIFT_RAD_PER_M * way, MOST_DRIFT_RAD),
        least_score=LEAST_SCORE,
        rival_beyond_m=RIVAL_BEYOND_M,
    )
    if found is None or found.rival > MOST_RIVAL * found.score:
        return None
    near = _overlapping(graph, region, view, found.pose)
    old = [graph.scans[k] for k in near]
    store = PointStore.of([*old, view])
    moving = len(near)
    aligned = aligned_scan(
        store,
        np.vstack([graph.pose[near], found.pose]),
        moving=moving,
        prior=found.pose,
        prior_information=LOOSE,
        gates_m=GATES_M,
    )
    pose = np.vstack([graph.pose[near], aligned.pose])
    through = seen_through_share(old, pose[:-1], view, graph.scans[scan], pose[-1])
    if aligned.matched < LEAST_MATCHED_SHARE or through > MOST_SEEN_THROUGH:
        return None
    pairs = np.stack([np.full(moving, moving), np.arange(moving)], axis=-1)
    fits = pair_fits(store, pose, pairs, gate_m=GATES_M[-1])
    links = scan_links(pose, pairs, fits, least_matched=LEAST_MATCHED)
    if len(links) == 0:
        return None
    index = np.append(near, scan)
    return Links(index[links.pairs], links.measured, links.information)


def _overlapping(
    graph: GrowingGraph, region: NDArray[np.int64], view: KeyScan, place: FloatArray
) -> NDArray[np.int64]:
    """The scans of a region that show most of a view from a place."""
    store = PointStore.of([*(graph.scans[k] for k in region), view])
    pose = np.vstack([graph.pose[region], place])
    pairs = np.stack([np.full(len(region), len(region)), np.arange(len(region))], axis=-1)
    matched = pair_fits(store, pose, pairs, gate_m=GATES_M[0], stride=2).matched
    return region[np.argsort(-matched, kind="stable")][:TIED_TO]


def _tied(graph: GrowingGraph, links: Links) -> bool:
    """Add the links of a loop if the graph can follow them."""
    before = graph.links()
    together = Links.joined([before, links])
    if np.all(link_costs(graph.pose, links) < MOST_COST / 4.0):
        graph.add_links(links)
        return True
    settled = solved_graph(graph.pose, before)
    solution = solved_graph(settled.pose, together)
    cost_before = link_costs(settled.pose, before)
    cost = link_costs(solution.pose, together)
    strain = float(np.sum(cost[: len(before)]) - np.sum(cost_before))
    if np.median(cost[len(before) :]) > MOST_COST or strain > MOST_STRAIN:
        return False
    graph.add_links(links)
    graph.replace_poses(solution.pose)
    return True


def recent_view(graph: GrowingGraph, scan: int) -> KeyScan:
    """What was seen over the last metres, as one scan from the pose of the last."""
    driven = np.array([other.driven_m for other in graph.scans[: scan + 1]])
    turned = np.array([other.turned_rad for other in graph.scans[: scan + 1]])
    recent = (driven[-1] - driven < VIEW_M) & (turned[-1] - turned < 2.0 * np.pi)
    index = np.flatnonzero(recent)
    index = index[:: -max(1, len(index) // 12)]
    motion = relative(graph.pose[scan], graph.pose[index])
    end, normal, origin = [], [], []
    for k, pose in zip(index.tolist(), motion, strict=True):
        other = graph.scans[k]
        end.append(transformed(pose, other.end_m))
        origin.append(transformed(pose, other.origin_m))
        normal.append(transformed(np.array([0.0, 0.0, pose[2]]), other.normal))
    ends = np.concatenate(end).astype(np.float32)
    kept = _spaced_index(ends, 0.5 * QUERY_SPACING_M)
    kept = kept[strip_order(ends[kept])]
    last = graph.scans[scan]
    return KeyScan(
        last.time_ns,
        last.scanner,
        last.odometry,
        last.driven_m,
        last.turned_rad,
        np.concatenate(origin)[kept].astype(np.float32),
        ends[kept],
        np.concatenate(normal)[kept].astype(np.float32),
    )


def _spaced_index(points: NDArray[np.floating], spacing_m: float) -> NDArray[np.int64]:
    cell = np.floor(points / spacing_m).astype(np.int64)
    _, first = np.unique(cell[:, 0] * 1_000_003 + cell[:, 1], return_index=True)
    return np.sort(first)


def _spaced(points: NDArray[np.float32]) -> FloatArray:
    return points[_spaced_index(points, QUERY_SPACING_M)].astype(np.float64)


PROFILE_BINS = 240
THROUGH_M = 0.4


def seen_through_share(
    old: list[KeyScan],
    old_pose: FloatArray,
    view: KeyScan,
    new: KeyScan,
    new_pose: FloatArray,
) -> float:
    """Share of the surfaces in mutual view that one side shows and the other looks through.

    Parameters
    ----------
    old : list of KeyScan
    old_pose : ndarray, shape (K, 3)
    view : KeyScan
        What was seen lately, to be looked at from the old poses.
    new : KeyScan
        What is seen from the new pose, to look from.
    new_pose : ndarray, shape (3,)
    """
    counts = np.zeros(2, dtype=np.int64)
    for scan, pose in zip(old, old_pose, strict=True):
        counts += _judged(new, relative(new_pose, pose), scan)
        counts += _judged(scan, relative(pose, new_pose), view)
    return float(counts[1] / max(counts.sum(), 1))


def _judged(viewer: KeyScan, pose: FloatArray, shown: KeyScan) -> NDArray[np.int64]:
    """How many returns of another scan agree with a view, and how many it looks through."""
    origin = viewer.origin_m.mean(axis=0).astype(np.float64)
    points = transformed(pose, shown.end_m)
    return _counted(viewer.end_m - origin, points - origin, PROFILE_BINS, THROUGH_M)


@njit(cache=True, nogil=True)
def _counted(seen: FloatArray, shown: FloatArray, bins: int, margin: float) -> NDArray[np.int64]:
    profile = np.full(bins, np.inf)
    per_rad = bins / (2.0 * np.pi)
    for k in range(len(seen)):
        slot = int((np.arctan2(seen[k, 1], seen[k, 0]) + np.pi) * per_rad) % bins
        profile[slot] = min(profile[slot], np.hypot(seen[k, 0], seen[k, 1]))
    counts = np.zeros(2, dtype=np.int64)
    for k in range(len(shown)):
        slot = int((np.arctan2(shown[k, 1], shown[k, 0]) + np.pi) * per_rad) % bins
        distance = np.hypot(shown[k, 0], shown[k, 1])
        nearest = min(profile[slot], profile[slot - 1], profile[(slot + 1) % bins])
        if not np.isfinite(nearest) or nearest < distance - margin:
            continue
        counts[1 if nearest > distance + margin else 0] += 1
    return counts
