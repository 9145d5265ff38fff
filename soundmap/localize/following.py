"""Following one hypothesis through the run: from each view to the next by odometry, then by fit.

Each view is fitted to the map where odometry expects it. Where it fits much worse than those before
it, a better pose is sought nearby: odometry slips, sticks and drifts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from soundmap.geometry import FloatArray
from soundmap.grid import OccupancyGrid
from soundmap.localize.agreement import agreed_shares
from soundmap.localize.global_start import FINE_SIGMA_M, nearness_to_wall, pose_score
from soundmap.localize.map_fit import add_map_pull, map_surface, pull_grids
from soundmap.localize.views import Views

KERNEL_M = 0.15
"""Width of the robust kernel of a fit [m]."""
FIT_STEPS = 8
SETTLED = 1e-4
STEP_SIGMA = (0.01, 0.3, np.radians(0.5), 0.2, 0.3)
"""What is believed of odometry: noise of a step [m], [m/m], [rad], [rad/m], [rad/rad]."""
WORSE = 0.05
"""A view that matches so much less than those before it is sought nearby ..."""
CLEARLY_BETTER = 0.10
"""... and moved if another pose matches so much better."""
LOOKED_FOR_M = 3.0
"""Way over which nothing matched after which a search nearby is given up [m]."""
NEARBY_M = np.linspace(-0.3, 0.3, 7)
NEARBY_RAD = np.radians(np.linspace(-25.0, 25.0, 21))
"""Window of a search nearby."""
FINER_M = (0.05, 0.025)


@dataclass(frozen=True)
class Track:
    """Poses of some views in a row, and how the map agrees with each.

    Attributes
    ----------
    pose : ndarray, shape (N, 3)
    matched, beyond : ndarray, shape (N,)
        As in `soundmap.localize.agreement.Agreement`.
    """

    pose: FloatArray
    matched: FloatArray
    beyond: FloatArray

    def __len__(self) -> int:
        return len(self.pose)

    @property
    def support(self) -> FloatArray:
        """Matched less beyond, shape (N,): how far each view speaks for the track, to 1."""
        return self.matched - self.beyond

    def then(self, other: Track) -> Track:
        """Join this track and another one, which begins with its last view."""
        return Track(
            np.concatenate([self.pose, other.pose[1:]]),
            np.concatenate([self.matched, other.matched[1:]]),
            np.concatenate([self.beyond, other.beyond[1:]]),
        )


class Follower:
    """Follows hypotheses through the views of a run.

    Parameters
    ----------
    room : OccupancyGrid
    views : Views
    hit_sigma_m : float
        Standard deviation of a range that hit what the map shows [m].
    weight : float
        How much of a ray's evidence counts: neighbours are alike.
    min_match : float
        A view matches the map if at least this share of it does.
    """

    def __init__(
        self,
        room: OccupancyGrid,
        views: Views,
        *,
        hit_sigma_m: float,
        weight: float,
        min_match: float,
    ) -> None:
        self._views = views
        resolution = room.frame.resolution_m
        clearance = room.clearance_cells
        nearness = nearness_to_wall(clearance * np.float32(resolution), FINE_SIGMA_M)
        self._map = (*pull_grids(map_surface(room)), clearance, nearness)
        axes = (NEARBY_M, NEARBY_M, NEARBY_RAD)
        self._window = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        self._trust = np.array([hit_sigma_m / np.sqrt(weight), 3.0 * hit_sigma_m, min_match])

    def followed(self, order: NDArray[np.int64], start: FloatArray, *, seek: bool = False) -> Track:
        """The track from the pose of the first view through others.

        Parameters
        ----------
        order : ndarray of int64, shape (N,)
            Views by number, forwards or backwards in time.
        start : ndarray, shape (3,)
            About where the first was taken from.
        seek : bool
            Look for the first view about its place in any case.
        """
        pose = np.empty((len(order), 3))
        matched, beyond = np.empty(len(order)), np.empty(len(order))
        views = self._views
        _follow(
            *self._map,
            self._window,
            self._trust,
            order,
            np.ascontiguousarray(start, dtype=np.float64),
            seek,
            views.odometry,
            views.first,
            views.origin_m,
            views.end_m,
            pose,
            matched,
            beyond,
        )
        return Track(pose, matched, beyond)


@njit(cache=True, nogil=True)
def _follow(
    distance: NDArray[np.float32],
    nearest: NDArray[np.int32],
    normal: FloatArray,
    corner: FloatArray,
    resolution: float,
    clearance: NDArray[np.float32],
    nearness: NDArray[np.float32],
    window: FloatArray,
    trust: FloatArray,
    order: NDArray[np.int64],
    start: FloatArray,
    seek: bool,
    odometry: FloatArray,
    first: NDArray[np.int64],
    origin: NDArray[np.float32],
    end: NDArray[np.float32],
    pose: FloatArray,
    matched: FloatArray,
    beyond: FloatArray,
) -> None:
    sigma, tolerance, min_match = trust
    usual, lost_m = 0.9, 0.0
    expected, spread = start.copy(), np.array([0.1, np.radians(5.0)])
    for n in range(len(order)):
        k = order[n]
        if n > 0:
            spread = _stepped(pose[n - 1], odometry[order[n - 1]], odometry[k], expected)
            lost_m += np.hypot(
                odometry[k, 0] - odometry[order[n - 1], 0],
                odometry[k, 1] - odometry[order[n - 1], 1],
            )
        points, origins = end[first[k] : first[k + 1]], origin[first[k] : first[k + 1]]
        found = _fitted(
            distance, nearest, normal, corner, resolution, expected, spread, points, sigma
        )
        flags = np.empty(len(points), dtype=np.bool_)
        shares = agreed_shares(
            clearance, corner, resolution, found, origins, points, tolerance, flags
        )
        worse = shares[0] < usual - WORSE or shares[0] < min_match or (seek and n == 0)
        if worse and lost_m < LOOKED_FOR_M:
            near = _nearby(nearness, corner, resolution, window, expected, points)
            near = _fitted(
                distance, nearest, normal, corner, resolution, near, spread, points, sigma
            )
            other = agreed_shares(
                clearance, corner, resolution, near, origins, points, tolerance, flags
            )
            if other[0] - other[1] > shares[0] - shares[1] + CLEARLY_BETTER:
                found, shares = near, other
        if shares[0] >= min_match:
            lost_m = 0.0
        usual += 0.1 * (shares[0] - usual)
        pose[n], matched[n], beyond[n] = found, shares[0], shares[1]


@njit(cache=True, nogil=True)
def _stepped(
    pose: FloatArray, before: FloatArray, after: FloatArray, expected: FloatArray
) -> FloatArray:
    """Writes where odometry leads from a pose into ``expected``; the spread there [m, rad]."""
    turn = pose[2] - before[2]
    cos, sin = np.cos(turn), np.sin(turn)
    dx, dy = after[0] - before[0], after[1] - before[1]
    expected[0] = pose[0] + cos * dx - sin * dy
    expected[1] = pose[1] + sin * dx + cos * dy
    expected[2] = (after[2] + turn + np.pi) % (2.0 * np.pi) - np.pi
    way = np.hypot(dx, dy)
    turned = abs((after[2] - before[2] + np.pi) % (2.0 * np.pi) - np.pi)
    least_m, per_m, least_rad, rad_per_m, rad_per_rad = STEP_SIGMA
    return np.array(
        [
            np.hypot(least_m, per_m * way),
            np.sqrt(least_rad**2 + (rad_per_m * way) ** 2 + (rad_per_rad * turned) ** 2),
        ]
    )


@njit(cache=True, nogil=True)
def _fitted(
    distance: NDArray[np.float32],
    nearest: NDArray[np.int32],
    normal: FloatArray,
    corner: FloatArray,
    resolution: float,
    expected: FloatArray,
    spread: FloatArray,
    points: NDArray[np.float32],
    sigma: float,
) -> FloatArray:
    """The pose near the expected one from which the points lie best on the map."""
    pose = expected.copy()
    share = np.ones(len(points))
    prior = np.array([spread[0] ** -2.0, spread[0] ** -2.0, spread[1] ** -2.0])
    for _ in range(FIT_STEPS):
        information, pull = np.zeros((3, 3)), np.zeros(3)
        add_map_pull(
            information,
            pull,
            distance,
            nearest,
            normal,
            corner,
            resolution,
            pose,
            points,
            share,
            sigma,
            KERNEL_M,
        )
        for m in range(3):
            off = pose[m] - expected[m]
            if m == 2:
                off = (off + np.pi) % (2.0 * np.pi) - np.pi
            information[m, m] += prior[m]
            pull[m] -= prior[m] * off
        step = np.linalg.solve(information, pull)
        pose += step
        if np.abs(step).max() < SETTLED:
            break
    pose[2] = (pose[2] + np.pi) % (2.0 * np.pi) - np.pi
    return pose


@njit(cache=True, nogil=True)
def _nearby(
    nearness: NDArray[np.float32],
    corner: FloatArray,
    resolution: float,
    window: FloatArray,
    expected: FloatArray,
    points: NDArray[np.float32],
) -> FloatArray:
    """The best pose of the window about the expected one, and then of finer steps."""
    best, score = expected.copy(), -1.0
    for n in range(len(window)):
        trial = expected + window[n]
        found = pose_score(nearness, corner, resolution, trial, points)
        if found > score:
            best, score = trial, found
    for step in FINER_M:
        middle = best.copy()
        for n in range(27):
            turn = step / 3.0
            trial = middle + np.array(
                [(n % 3 - 1) * step, (n // 3 % 3 - 1) * step, (n // 9 - 1) * turn]
            )
            found = pose_score(nearness, corner, resolution, trial, points)
            if found > score:
                best, score = trial, found
    return best
