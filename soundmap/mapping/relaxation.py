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
from soundmap.mapping.key_scans import KeyScan
from soundmap.mapping.links import scan_links
from soundmap.mapping.pose_graph import Links, solved_graph

REACH_M = 5.0
TURN_M_PER_RAD = 1.0
LEAST_MATCHED = 20
LEAST_SHARE = 0.25
"""Scans overlap if this share of the smaller one's returns meets the other's surfaces."""
ROBUST_SCALE = 4.0
FINE_ROUNDS = 3
"""The last rounds use all returns, those before every other one."""


def overlapping_pairs(pose: FloatArray, neighbours: int) -> NDArray[np.int64]:
    """Pairs of poses near each other: the most alike, and as many spread over the rest.

    Returns
    -------
    ndarray of int64, shape (M, 2)
        The first index is the greater one.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(pose[:, :2])
    pairs = set()
    for k, near in enumerate(tree.query_ball_point(pose[:, :2], REACH_M)):
        others = np.array(near, dtype=np.int64)
        others = others[others != k]
        gap = np.hypot(*(pose[others, :2] - pose[k, :2]).T)
        turn = np.abs(wrapped_angle(pose[others, 2] - pose[k, 2]))
        alike = others[np.argsort(gap + TURN_M_PER_RAD * turn, kind="stable")]
        first, rest = alike[: neighbours // 2], alike[neighbours // 2 :]
        wanted = neighbours - len(first)
        spread = rest[np.linspace(0, len(rest) - 1, min(wanted, len(rest))).astype(np.int64)]
        for other in (*first, *spread):
            pairs.add((max(k, int(other)), min(k, int(other))))
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def relaxed_poses(
    scans: Sequence[KeyScan],
    pose: FloatArray,
    odometry: Links,
    *,
    neighbours: int,
    gates_m: Sequence[float],
    report: Callable[[int], None] = lambda _: None,
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
        Gate of each round [m].
    report : callable
        Told the number of rounds done.
    """
    store = PointStore.of(scans)
    size = np.diff(store.first)
    links = odometry
    for number, gate in enumerate(gates_m):
        if number % 3 == 0:
            pairs = overlapping_pairs(pose, neighbours)
        if len(pairs) == 0:
            return pose, odometry
        both = np.concatenate([pairs, pairs[:, ::-1]])
        coarse = number < len(gates_m) - FINE_ROUNDS
        fits = pair_fits(store, pose, both, gate_m=gate, stride=2 if coarse else 1)
        enough = np.maximum(LEAST_MATCHED, LEAST_SHARE * size[both].min(axis=1))
        overlap = fits.matched >= enough
        kept = PairFits(fits.information[overlap], fits.gradient[overlap], fits.matched[overlap])
        surfaces = scan_links(pose, both[overlap], kept, least_matched=LEAST_MATCHED)
        links = Links.joined([odometry, surfaces])
        # The pairs are fitted anew after every step: more steps with the old fits gain nothing.
        pose = solved_graph(pose, links, most_iterations=1, robust_scale=ROBUST_SCALE).pose
        report(number + 1)
    return pose, links
