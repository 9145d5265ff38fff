r"""Clock, yaw and fixed places that agree best with the bearings of all peaks.

A peak of scan s at bearing :math:`\theta`, which comes from a fixed place m, leaves the residual

.. math:: \epsilon = \mathrm{wrap}(\theta - \mathrm{atan2}(m - a(t_s + \delta))
          + \alpha(t_s + \delta) + \psi),

with a the array's place and :math:`\alpha` the direction of its axis at the scan's time, if its
clock is :math:`\delta` behind and its mount turned :math:`\psi` further than believed. Sources are
fixed places, and so are their mirror images: nothing needs to be known of walls.

Reflections pull the bearing of a source off by a good half degree, and the same way as long as the
robot moves little. So each place's bearings may drift along the way, as far as a prior lets them:
this gives sudden changes, where a turn begins or ends, the weight they deserve, and the result an
honest variance. Clock and yaw bind all places together; given them, each place is on its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from soundmap.calibrate.far_field import FarClock
from soundmap.calibrate.peaks import Peaks
from soundmap.calibrate.way import Way, WayAt
from soundmap.geometry import FloatArray, wrapped_angle

ROUNDS, DRIFT_ROUNDS = 24, 6
WIDEST, NARROWING_ROUNDS = 4.0, 8
"""Gates begin so many times wider than they end, to catch what the start has wrong."""
GATE = 3.0
"""Residuals of so many standard deviations or more have no weight (Tukey's biweight)."""
DRIFT_RAD, DRIFT_OVER_M = np.radians(0.5), 0.4
"""Standard deviation of a drift, and the way over which it changes."""
UNRESOLVED_RAD, UNRESOLVED_SIGMAS = np.radians(8.0), 2.0
"""Peaks of places nearer in bearing than this are one: their bearings are the less certain."""
NEAREST_M, GREATEST_STEP_M = 0.4, 0.5
PLACE_DAMPING = 65.0
DAMPING = np.array([30.0, 0.3])
"""Information that damps each step: of places [1/m^2], clock [1/s^2] and yaw [1/rad^2]."""
GREATEST_STEP = np.array([0.04, 0.1])
FARTHEST = np.array([0.2, 0.4])
"""Clock [s] and yaw [rad] beyond which nothing is sought."""
SETTLED = 1e-4


@dataclass(frozen=True)
class Stretch:
    """A stretch of the way and what was heard on it.

    Attributes
    ----------
    scans : slice
        Its audio scans.
    first, last : int
        Its peaks are those from ``first`` to before ``last``.
    place_m : ndarray, shape (K, 2)
        Fixed places, in the map frame.
    """

    scans: slice
    first: int
    last: int
    place_m: FloatArray


@dataclass(frozen=True)
class BearingFit:
    """What a fit found.

    Attributes
    ----------
    state : ndarray, shape (2,)
        Clock [s] and yaw [rad].
    covariance : ndarray, shape (2, 2)
        Of both.
    stretches : tuple of Stretch
        With the places found.
    information : ndarray, shape (len(stretches), 2)
        That the peaks of each stretch hold: of those that come from its fixed places, and of all.
    spread : ndarray, shape (2,)
        Standard deviation of both by the jackknife over the places [s, rad]: what a place whose
        sound is mixed with another's may do; nought for a single one.
    """

    state: FloatArray
    covariance: FloatArray
    stretches: tuple[Stretch, ...]
    information: FloatArray
    spread: FloatArray

    @property
    def explained(self) -> float:
        """Share of what was heard, by the information it holds, that comes from fixed places."""
        told, held = self.information.sum(axis=0)
        return float(told / max(held, 1e-12))

    def where_explained(self, least: float) -> BearingFit:
        """The fit with those stretches alone where that share is so great or more."""
        chosen = self.information[:, 0] >= least * self.information[:, 1]
        stretches = tuple(s for s, good in zip(self.stretches, chosen, strict=True) if good)
        return replace(self, stretches=stretches, information=self.information[chosen])


def rigid_fit(
    peaks: Peaks, way_at: WayAt, stretches: Sequence[Stretch], state: Sequence[float]
) -> BearingFit:
    """Fit without drifts, from a rough start; each peak belongs to the place that fits it best."""
    at, stretches = np.array(state), tuple(stretches)
    for round_ in range(ROUNDS):
        gate = GATE * WIDEST ** max(0.0, 1.0 - round_ / NARROWING_ROUNDS)
        way = way_at(float(at[0]))
        blocks, explained = [], []
        for stretch in stretches:
            seen = _seen(peaks, way, stretch, float(at[1]))
            information = seen.sigma_rad**-2
            weight = information * _biweight(seen.error_rad / (gate * seen.sigma_rad))
            near = np.sqrt(_biweight(seen.error_rad / (GATE * seen.sigma_rad)))
            explained.append((float(information @ near), float(information.sum())))
            blocks.append(
                [
                    _block(seen, weight, np.flatnonzero(seen.place == k))
                    for k in range(len(stretch.place_m))
                ]
            )
        step, covariance = _common_step(blocks)
        stretches = tuple(_moved(s, b, step) for s, b in zip(stretches, blocks, strict=True))
        at = np.clip(at + step, -FARTHEST, FARTHEST)
        if round_ > NARROWING_ROUNDS and np.all(np.abs(step) < SETTLED):
            break
    return BearingFit(at, covariance, stretches, np.array(explained), np.zeros(2))


def drifting_fit(peaks: Peaks, way_at: WayAt, fit: BearingFit, far: FarClock) -> BearingFit:
    """The same with drifts and with what the far field tells, from where the rigid fit ended."""
    at, stretches = fit.state, fit.stretches
    driven = way_at(float(at[0])).driven_m() / DRIFT_OVER_M
    knots = [
        _Knots.over(driven[peaks.scan[s.first : s.last]], (peaks.blur * DRIFT_RAD) ** -2)
        for s in stretches
    ]
    drifts = [np.zeros((len(s.place_m), k.count)) for s, k in zip(stretches, knots, strict=True)]
    for round_ in range(DRIFT_ROUNDS):
        way = way_at(float(at[0]))
        blocks = []
        for stretch, knot, drift in zip(stretches, knots, drifts, strict=True):
            seen = _seen(peaks, way, stretch, float(at[1]))
            error = seen.error_rad - knot.between(drift, seen.place)
            sigma = seen.sigma_rad
            unresolved = seen.gap_rad < peaks.blur * UNRESOLVED_RAD
            sigma = np.where(unresolved, UNRESOLVED_SIGMAS * sigma, sigma)
            scale = sigma if round_ else np.hypot(sigma, peaks.blur * DRIFT_RAD)
            weight = sigma**-2 * _biweight(error / (GATE * scale))
            seen = replace(seen, error_rad=error)
            blocks.append(
                [
                    _block(seen, weight, np.flatnonzero(seen.place == k), knot, drift[k])
                    for k in range(len(stretch.place_m))
                ]
            )
        known = _known(far, at)
        step, covariance = _common_step(blocks, known)
        stretches = tuple(_moved(s, b, step) for s, b in zip(stretches, blocks, strict=True))
        drifts = [
            drift + np.array([block.own_step(step)[2:] for block in b]).reshape(drift.shape)
            for drift, b in zip(drifts, blocks, strict=True)
        ]
        at = np.clip(at + step, -FARTHEST, FARTHEST)
        if np.all(np.abs(step) < SETTLED):
            break
    return BearingFit(at, covariance, stretches, fit.information, _leaving_one_out(blocks, known))


@dataclass(frozen=True)
class _Seen:
    """Residuals of the peaks of a stretch, shape (P,), and their derivatives, (P, 2) each.

    ``gap_rad`` is the angle between a peak's place and the next one in bearing.
    """

    place: NDArray[np.int64]
    error_rad: FloatArray
    gap_rad: FloatArray
    sigma_rad: FloatArray
    by_place: FloatArray
    by_state: FloatArray


def _seen(peaks: Peaks, way: Way, stretch: Stretch, yaw_rad: float) -> _Seen:
    scan = peaks.scan[stretch.first : stretch.last]
    bearing = peaks.bearing_rad[stretch.first : stretch.last]
    sigma = peaks.sigma_rad[stretch.first : stretch.last]
    step = stretch.place_m - way.place_m[scan, None]
    predicted = np.arctan2(step[..., 1], step[..., 0]) - way.axis_rad[scan, None] - yaw_rad
    error = np.asarray(wrapped_angle(bearing[:, None] - predicted))
    place = np.argmin(np.abs(error), axis=1)
    row = np.arange(len(scan))
    dx, dy = step[row, place].T
    square = np.maximum(dx**2 + dy**2, NEAREST_M**2)
    by_place = np.stack([-dy, dx], axis=-1) / square[:, None]
    by_clock = -np.einsum("pc,pc->p", by_place, way.velocity_m_s[scan]) - way.turn_rad_s[scan]
    by_state = np.stack([by_clock, np.full(len(scan), -1.0)], axis=-1)
    away = np.abs(wrapped_angle(predicted - predicted[row, place][:, None]))
    away[row, place] = np.inf
    return _Seen(place, error[row, place], away.min(axis=1), sigma, by_place, by_state)


def _biweight(ratio: FloatArray) -> FloatArray:
    return np.maximum(1.0 - ratio**2, 0.0) ** 2


@dataclass(frozen=True)
class _Knots:
    """Drifts are told at knots along the way, linear between them.

    ``left`` (P,) is the knot before each peak, ``share`` (P,) how far it is on to the next; the
    ``prior`` holds each drift to nought [1/rad^2].
    """

    count: int
    left: NDArray[np.int64]
    share: FloatArray
    prior: float

    @classmethod
    def over(cls, along: FloatArray, prior: float) -> _Knots:
        """For peaks that are so many knots' distances along the way."""
        along = along - along.min(initial=np.inf) if len(along) else along
        left = along.astype(np.int64)
        return cls(int(left.max(initial=0)) + 2, left, along - left, prior)

    def between(self, drift: FloatArray, place: NDArray[np.int64]) -> FloatArray:
        """Drift of each peak, from those of its place at the knots."""
        before, after = drift[place, self.left], drift[place, self.left + 1]
        return (1.0 - self.share) * before + self.share * after

    def columns(self, own: NDArray[np.int64]) -> FloatArray:
        """Derivative of some peaks' drift by the drift at the knots."""
        columns = np.zeros((len(own), self.count))
        row = np.arange(len(own))
        columns[row, self.left[own]] = 1.0 - self.share[own]
        columns[row, self.left[own] + 1] = self.share[own]
        return columns


@dataclass(frozen=True)
class _Block:
    """The normal equations of one place, its own unknowns eliminated.

    ``information`` (2, 2) and ``pull`` (2,) are of clock and yaw. The step of the place's own
    unknowns is ``alone`` less ``bound`` times that of clock and yaw.
    """

    information: FloatArray
    pull: FloatArray
    alone: FloatArray
    bound: FloatArray

    def own_step(self, step: FloatArray) -> FloatArray:
        return self.alone - self.bound @ step


def _block(
    seen: _Seen,
    weight: FloatArray,
    own: NDArray[np.int64],
    knots: _Knots | None = None,
    drift: FloatArray | None = None,
) -> _Block:
    columns, prior, bias = seen.by_place[own], np.full(2, PLACE_DAMPING), np.zeros(2)
    if knots is not None and drift is not None:
        columns = np.hstack([columns, knots.columns(own)])
        prior = np.concatenate([prior, np.full(knots.count, knots.prior)])
        bias = np.concatenate([bias, drift * knots.prior])
    common, weight, error = seen.by_state[own], weight[own], seen.error_rad[own]
    weighted = columns * weight[:, None]
    coupling = weighted.T @ common
    right = np.column_stack([coupling, weighted.T @ error - bias])
    solved = np.linalg.solve(weighted.T @ columns + np.diag(prior), right).astype(np.float64)
    bound, alone = solved[:, :2], solved[:, 2]
    weighted = common * weight[:, None]
    return _Block(
        weighted.T @ common - coupling.T @ bound,
        weighted.T @ error - coupling.T @ alone,
        alone,
        bound,
    )


_Known = tuple[FloatArray, FloatArray]
"""Information (2, 2) on clock and yaw that is not the places', and its pull (2,)."""
NOTHING_KNOWN: _Known = (np.diag(DAMPING), np.zeros(2))


def _known(far: FarClock, at: FloatArray) -> _Known:
    information = far.sigma**-2
    damping, pull = NOTHING_KNOWN
    clock = np.array([1.0, 0.0])
    return damping + np.diag(information * clock), pull + information * (far.value - at[0]) * clock


def _common_step(
    blocks: Sequence[Sequence[_Block]], known: _Known = NOTHING_KNOWN
) -> tuple[FloatArray, FloatArray]:
    """Step of clock and yaw that all places ask for together, and its covariance."""
    information, pull = known
    for stretch in blocks:
        for block in stretch:
            information = information + block.information
            pull = pull + block.pull
    covariance = np.linalg.inv(information)
    return np.clip(covariance @ pull, -GREATEST_STEP, GREATEST_STEP), np.asarray(covariance)


def _leaving_one_out(blocks: Sequence[Sequence[_Block]], known: _Known) -> FloatArray:
    """Standard deviation of clock and yaw by the jackknife over the places."""
    every = [block for stretch in blocks for block in stretch]
    if len(every) < 2:
        return np.zeros(2)
    information = known[0] + sum(block.information for block in every)
    pull = known[1] + sum(block.pull for block in every)
    without = [np.linalg.solve(information - b.information, pull - b.pull) for b in every]
    return np.std(without, axis=0) * np.sqrt(len(every) - 1.0)


def _moved(stretch: Stretch, blocks: Sequence[_Block], step: FloatArray) -> Stretch:
    moves = np.array([block.own_step(step)[:2] for block in blocks]).reshape(-1, 2)
    limited = np.clip(moves, -GREATEST_STEP_M, GREATEST_STEP_M)
    return replace(stretch, place_m=stretch.place_m + limited)
