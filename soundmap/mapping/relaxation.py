"""All key scans laid on all others near them at once.

Every pair of scans that see the same surfaces links their poses; the graph of all links is solved
and the pairs are fitted anew, with narrower gates each time (Lu and Milios, 1997; the global
relaxation of the paper's [9]).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, wrapped_angle
from soundmap.mapping.alignment import PairFits, PointStore, pair_fits
from soundmap.mapping.founders import founders
from soundmap.mapping.key_scans import KeyScan
from soundmap.mapping.links import scan_links
from soundmap.mapping.pose_graph import Links, solved_graph

REACH_M = 5.0
LATEST = 2
TURN_M_PER_RAD = 1.0
LEAST_MATCHED = 20
LEAST_SHARE = 0.25
"""Scans overlap if this share of the smaller one's returns meets the other's surfaces."""
ROBUST_SCALE = 4.0
NEAR_M, SETTLED_M = 0.003, 0.0005
"""Poses are nearly where they belong, or there, if hardly any moves farther in a round [m]."""


def overlapping_pairs(
    pose: FloatArray, scanner: NDArray[np.int64], neighbours: int
) -> NDArray[np.int64]:
    """Pairs of poses near each other: with the founders most alike, and as many spread over others.

    Every pose is paired with the `LATEST` before it as well.

    Returns
    -------
    ndarray of int64, shape (M, 2)
        The first index is the greater one.
    """
    from scipy.spatial import cKDTree

    founding = founders(pose, scanner)
    near = cKDTree(pose[founding, :2]).query_ball_point(pose[:, :2], REACH_M)
    pairs = {(k, k - back) for back in range(1, LATEST + 1) for k in range(back, len(pose))}
    for k, members in enumerate(near):
        others = founding[members]
        others = others[others != k]
        gap = np.hypot(*(pose[others, :2] - pose[k, :2]).T)
        turn = np.abs(wrapped_angle(pose[others, 2] - pose[k, 2]))
        alike = others[np.argsort(gap + TURN_M_PER_RAD * turn, kind="stable")]
        first, rest = alike[: neighbours // 2], alike[neighbours // 2 :]
        wanted = neighbours - len(first)
        spread = rest[np.linspace(0, len(rest) - 1, min(wanted, len(rest))).astype(np.int64)]
        pairs.update((max(k, other), min(k, other)) for other in first.tolist())
        pairs.update((max(k, other), min(k, other)) for other in spread.tolist())
    listed = np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)
    apart = np.hypot(*(pose[listed[:, 0], :2] - pose[listed[:, 1], :2]).T)
    return listed[apart <= REACH_M]


def relaxed_poses(
    scans: Sequence[KeyScan],
    pose: FloatArray,
    odometry: Links,
    *,
    neighbours: int,
    gates_m: Sequence[float],
    fine_rounds: int,
    report: Callable[[float], None] = lambda _: None,
) -> tuple[FloatArray, Links]:
    """Poses at which all scans fit one another best, and the links of the last round.

    Parameters
    ----------
    scans : sequence of KeyScan
    pose : ndarray, shape (K, 3)
        Where to begin; the first is held.
    odometry : Links
        They connect all scans.
    neighbours : int
        Scans that each one is laid on, at least.
    gates_m : sequence of float
        Gate of each round, wide to narrow [m]; every other return is used.
    fine_rounds : int
        Rounds with all returns and the last gate, at most.
    report : callable
        Told the share of the rounds that is done.
    """
    store = PointStore.of(scans)
    size = np.diff(store.first)
    scanner = np.array([scan.scanner for scan in scans], dtype=np.int64)
    links, pairs = odometry, overlapping_pairs(pose, scanner, neighbours)
    rounds = [*((gate, 2) for gate in gates_m[:-1]), *[(gates_m[-1], 1)] * fine_rounds]
    number = done = 0
    while number < len(rounds):
        gate, stride = rounds[number]
        if done and done % 3 == 0:
            pairs = overlapping_pairs(pose, scanner, neighbours)
        if len(pairs) == 0:
            return pose, odometry
        both = np.concatenate([pairs, pairs[:, ::-1]])
        fits = pair_fits(store, pose, both, gate_m=gate, stride=stride)
        enough = np.maximum(LEAST_MATCHED, LEAST_SHARE * size[both].min(axis=1))
        overlap = fits.matched >= enough
        kept = PairFits(fits.information[overlap], fits.gradient[overlap], fits.matched[overlap])
        surfaces = scan_links(pose, both[overlap], kept, least_matched=LEAST_MATCHED)
        links = Links.joined([odometry, surfaces])
        # The pairs are fitted anew after every step: more steps with the old fits gain nothing.
        solution = solved_graph(pose, links, most_iterations=1, robust_scale=ROBUST_SCALE)
        step_m = float(np.quantile(np.hypot(*(solution.pose - pose)[:, :2].T), 0.95))
        pose, done = solution.pose, done + 1
        fine = number >= len(gates_m) - 1
        if fine and step_m < SETTLED_M:
            break
        # Poses that hardly move need no wide gate.
        number = len(gates_m) - 1 if not fine and step_m < NEAR_M else number + 1
        report(number / len(rounds))
    report(1.0)
    return pose, links
