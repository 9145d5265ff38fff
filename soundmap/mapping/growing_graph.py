"""The map grown scan by scan: every key scan is laid on those near it that are known well.

How well two scans are known relative to each other is judged by the shortest way through the graph
from one to the other: errors grow along it (Olson, "Robust and efficient robotic mapping", 2008).
Scans that are near in space but far in the graph are candidates for closing a loop.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, composed, transformed, wrapped_angle
from soundmap.mapping.alignment import Alignment, PointStore, aligned_scan, pair_fits
from soundmap.mapping.correlation import NearnessGrid, best_placement, nearness_grid
from soundmap.mapping.founders import place_key
from soundmap.mapping.key_scans import KeyScan
from soundmap.mapping.links import WEAKEST, odometry_links, scan_links
from soundmap.mapping.pose_graph import Links
from soundmap.odometry_model import OdometryModel

REACH_M = 5.0
"""Scans this near are likely to see the same surfaces."""
CONNECTED_M = 8.0
"""Scans no farther than this in the graph are known well relative to each other."""
FARTHEST_M = 200.0
"""Ways through the graph are followed so far; drift beyond is as great as any."""
MOST_PIECES = 64
TURN_M_PER_RAD = 1.0
"""A turn of 1 rad makes scans as different as this distance does."""
LATEST = 4
MOST_LINKS = 5
LEAST_MATCHED_SHARE = 0.35
LEAST_MATCHED = 15
LEAST_WINDOW = (0.2, np.radians(12.0))
"""The pose is searched for at least this far around the expected one [m, rad] ..."""
WIDE_WINDOW = (1.0, np.radians(45.0))
"""... and so far if nothing is found there that fits well: odometry slips and stamps err."""
WELL_MATCHED_SHARE = 0.6
CLEARLY_BETTER = 0.15
UNMATCHED_M = 4.0
"""A scan that fits none of its neighbours is known as badly as after so much more way."""
GATES_M = (0.3, 0.15)


class GrowingGraph:
    """Poses of the key scans so far, and the links between them.

    Parameters
    ----------
    scans : sequence of KeyScan
        All key scans of the run by time.
    model : OdometryModel
    neighbours : int
        Scans that a new one is laid on.
    """

    def __init__(self, scans: Sequence[KeyScan], model: OdometryModel, neighbours: int) -> None:
        self.scans, self.model, self._neighbours = scans, model, neighbours
        self._pose = np.zeros((len(scans), 3))
        self.count = 1
        self.matched = np.zeros(len(scans), dtype=bool)
        self.matched[0] = True
        self._founders = [0]
        self._places = {place_key(self._pose[0], scans[0].scanner)}
        self._odometry_links = odometry_links(scans, model)
        self._scan_links: list[Links] = []
        self._trust = np.ones(max(len(scans) - 1, 0))

    @property
    def pose(self) -> FloatArray:
        """Poses of the scans added, shape (count, 3)."""
        return self._pose[: self.count]

    def replace_poses(self, pose: FloatArray) -> None:
        """Take better poses of the scans added."""
        self._pose[: self.count] = pose

    def links(self) -> Links:
        """All links between the scans added."""
        odometry = self._odometry_links
        done = self.count - 1
        information = odometry.information[:done] * self._trust[:done, None, None]
        chain = Links(odometry.pairs[:done], odometry.measured[:done], information)
        return Links.joined([chain, *self._scan_links])

    def adopt(self, model: OdometryModel) -> None:
        """Take a better model of the odometry, for the way done and the way to come."""
        self.model = model
        self._odometry_links = odometry_links(self.scans, model)

    def add_links(self, links: Links) -> None:
        """Add links between scans added."""
        self._scan_links.append(links)

    def distances_from(self, scan: int) -> FloatArray:
        """Shortest way through the graph from one scan to every scan added [m], shape (count,).

        Infinite where it is longer than `FARTHEST_M`.
        """
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import dijkstra

        if len(self._scan_links) > MOST_PIECES:
            self._scan_links = [Links.joined(self._scan_links)]
        pairs = np.concatenate(
            [self._odometry_links.pairs[: self.count - 1], *(x.pairs for x in self._scan_links)]
        )
        if len(pairs) == 0:
            return np.zeros(self.count)
        gap = self._pose[pairs[:, 0], :2] - self._pose[pairs[:, 1], :2]
        # coo_array adds up what is given twice; only the first of equal pairs may stay.
        _, once = np.unique(pairs[:, 0] * self.count + pairs[:, 1], return_index=True)
        length = 0.02 + np.hypot(gap[:, 0], gap[:, 1])
        length[: self.count - 1] += UNMATCHED_M * ~self.matched[1 : self.count]
        graph = coo_array(
            (length[once], (pairs[once, 0], pairs[once, 1])), shape=(self.count, self.count)
        )
        return dijkstra(graph.tocsr(), directed=False, indices=scan, limit=FARTHEST_M)

    def add_next(self, distance: FloatArray) -> None:
        """Add the next scan; ``distance`` as from `distances_from` its predecessor."""
        new = self.count
        step = self._odometry_links
        expected = composed(self._pose[new - 1], step.measured[new - 1])
        targets = self._targets(expected, distance)
        self._pose[new] = expected
        self.count += 1
        links = self._laid_on(new, targets, expected, step.information[new - 1])
        place = place_key(self._pose[new], self.scans[new].scanner)
        if place not in self._places:
            self._places.add(place)
            self._founders.append(new)
        if links is not None:
            self.matched[new] = True
            self._scan_links.append(links)

    def _targets(self, expected: FloatArray, distance: FloatArray) -> NDArray[np.int64]:
        """Well-known scans near a pose: some of the latest, and the founders most alike."""
        pose = self.pose
        gap = np.hypot(pose[:, 0] - expected[0], pose[:, 1] - expected[1])
        near = (gap < REACH_M) & (distance < CONNECTED_M)
        latest = np.flatnonzero(near)[-LATEST:]
        founding = np.array(self._founders, dtype=np.int64)
        founding = founding[near[founding]]
        turn = np.abs(wrapped_angle(pose[founding, 2] - expected[2]))
        unlike = gap[founding] + TURN_M_PER_RAD * turn
        alike = founding[np.argsort(unlike, kind="stable")]
        rest = alike[~np.isin(alike, latest)][: max(self._neighbours - LATEST, 0)]
        return np.concatenate([latest, rest])

    def _laid_on(
        self,
        new: int,
        targets: NDArray[np.int64],
        expected: FloatArray,
        prior_information: FloatArray,
    ) -> Links | None:
        """Lay the new scan on others; links to those it fits best, None if it fits none."""
        if len(targets) == 0:
            return None
        store = PointStore.of([self.scans[k] for k in (*targets, new)])
        pose = np.vstack([self._pose[targets], expected])
        grid = nearness_grid(self.points_of(targets), expected[:2])
        sigma = 1.0 / np.sqrt(np.diag(prior_information))
        likely = np.maximum(LEAST_WINDOW, 3.0 * sigma[[0, 2]])
        found = _fitted(store, pose, grid, likely, prior_information)
        if found.matched < WELL_MATCHED_SHARE:
            wide = np.maximum(WIDE_WINDOW, likely)
            other = _fitted(store, pose, grid, wide, 0.01 * prior_information)
            if other.matched > found.matched + CLEARLY_BETTER:
                found = other
        if found.matched < LEAST_MATCHED_SHARE:
            return None
        pose[-1] = self._pose[new] = found.pose
        self._trust[new - 1] = _trust(found.pose, expected, prior_information)
        pairs = np.stack([np.full(len(targets), len(targets)), np.arange(len(targets))], axis=-1)
        fits = pair_fits(store, pose, pairs, gate_m=GATES_M[-1])
        links = scan_links(pose, pairs, fits, least_matched=LEAST_MATCHED)
        strength = np.linalg.det(links.information + WEAKEST * np.eye(3))
        best = np.argsort(-strength, kind="stable")[:MOST_LINKS]
        if len(best) == 0:
            return None
        index = np.append(targets, new)
        return Links(index[links.pairs[best]], links.measured[best], links.information[best])

    def points_of(self, index: NDArray[np.int64]) -> FloatArray:
        """Returns of some scans in the map frame, shape (P, 2) [m]."""
        return np.concatenate([transformed(self._pose[k], self.scans[k].end_m) for k in index])


def _fitted(
    store: PointStore,
    pose: FloatArray,
    grid: NearnessGrid,
    window: FloatArray,
    prior_information: FloatArray,
) -> Alignment:
    """The last of some scans searched for in a window [m, rad] and laid on the others."""
    moving = len(pose) - 1
    found = best_placement(
        grid,
        store.end_m[store.first[moving] :],
        pose[moving],
        window_m=float(window[0]),
        window_rad=float(window[1]),
        least_score=0.2,
    )
    start = pose.copy()
    if found is not None:
        start[moving] = found.pose
    trust = _trust(start[moving], pose[moving], prior_information)
    return aligned_scan(
        store,
        start,
        moving=moving,
        prior=pose[moving],
        prior_information=trust * prior_information,
        gates_m=GATES_M,
    )


def _trust(found: FloatArray, expected: FloatArray, information: FloatArray) -> float:
    """Weight of an expectation that what was found contradicts (Cauchy)."""
    off = found - expected
    off[2] = wrapped_angle(off[2])
    return float(1.0 / (1.0 + off @ information @ off / 9.0))
