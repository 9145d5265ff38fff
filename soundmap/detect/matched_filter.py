r"""Matched filter: how well a source at a place would explain what all scans have heard.

A source of mean square q at 1 m adds to scan s, on bearing n,

.. math:: q \, B(\theta_n, \phi_s) / (\max(r_s, 0.4\,\mathrm{m})^2 + h^2),

if the lasers let it be seen from there: B is the beam, :math:`\phi_s` and :math:`r_s` bearing and
distance of the source, h the height between it and the array.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from soundmap.detect.candidates import REACH_M, Kind
from soundmap.detect.evidence import Evidence, Single
from soundmap.geometry import FloatArray

HEIGHT_M = 0.3
"""Height between source and array that is assumed [m]."""
NEAREST_M = 0.4
ON_SURFACE_M, ON_SURFACE_PER_M = 0.22, 0.03
"""What is on a surface lies within this distance of the laser hit on its bearing [m] [m/m]."""
FARTHEST_BEHIND_M = 2.6
IN_FRONT_M = 0.35
"""What is in the open lies no more than this behind the laser hit on its bearing [m]."""
LEAST_SCANS = 4.0
"""A place that fewer scans (effective number) tell of is no candidate."""


@njit(cache=True, nogil=True)
def _gain(distance: float, surface: float, kind: int) -> float:
    if kind != 2 and np.isnan(surface):
        return 0.0
    beyond = distance - surface
    if kind == 0 and abs(beyond) > ON_SURFACE_M + ON_SURFACE_PER_M * distance:
        return 0.0
    if kind == 1 and (beyond > FARTHEST_BEHIND_M or beyond < 0.0):
        return 0.0
    if kind == 2 and beyond > IN_FRONT_M:
        return 0.0
    near = max(distance, NEAREST_M)
    return 1.0 / (near * near + HEIGHT_M * HEIGHT_M)


@njit(cache=True, nogil=True)
def _gains(distance: FloatArray, surface: FloatArray, kind: int) -> FloatArray:
    gain = np.zeros(len(distance))
    for s in range(len(distance)):
        if distance[s] < REACH_M:
            gain[s] = _gain(distance[s], surface[s], kind)
    return gain


@njit(cache=True, nogil=True)
def fast_arctan2(y: float, x: float) -> float:
    """arctan2 to within 2e-5 rad, by the polynomial of Abramowitz and Stegun 4.4.49."""
    if x == 0.0 and y == 0.0:
        return 0.0
    steep = abs(y) > abs(x)
    z = x / y if steep else y / x
    q = z * z
    series = 0.0208351 * q - 0.0851330
    series = (series * q + 0.1801410) * q - 0.3302995
    angle = z * (series * q + 0.9998660)
    if steep:
        angle = (0.5 * np.pi if z >= 0.0 else -0.5 * np.pi) - angle
        return angle if (y > 0.0) == (angle > 0.0) else angle + (np.pi if y > 0.0 else -np.pi)
    if x < 0.0:
        angle += np.pi if y >= 0.0 else -np.pi
    return angle


def _explained(
    places: FloatArray,
    kinds: NDArray[np.int64],
    stand: FloatArray,
    axis: FloatArray,
    hand: float,
    ranges: Single,
    weight: FloatArray,
    matched: Single,
    energy: FloatArray,
) -> FloatArray:
    slopes, waves = len(matched), ranges.shape[1]
    explained = np.zeros((slopes, len(places)))
    for c in prange(len(places)):
        match, square, fourth = np.zeros(slopes), np.zeros(slopes), np.zeros(slopes)
        for s in range(len(stand)):
            dx, dy = places[c, 0] - stand[s, 0], places[c, 1] - stand[s, 1]
            square_m = dx * dx + dy * dy
            if square_m > REACH_M * REACH_M:
                continue
            turn = hand * (fast_arctan2(dy, dx) - axis[s]) / (2.0 * np.pi)
            at = (turn - np.floor(turn)) * waves
            left = int(at)
            share = at - left
            left %= waves
            right = (left + 1) % waves
            surface = ranges[s, left if share < 0.5 else right]
            gain = weight[s] * _gain(np.sqrt(square_m), surface, kinds[c])
            if gain > 0.0:
                for k in range(slopes):
                    between = (1.0 - share) * matched[k, s, left] + share * matched[k, s, right]
                    match[k] += gain * between
                    part = gain * gain * energy[k, s]
                    square[k] += part
                    fourth[k] += part * part
        for k in range(slopes):
            if match[k] > 0.0 and square[k] * square[k] > LEAST_SCANS * fourth[k]:
                explained[k, c] = match[k] * match[k] / square[k]
    return explained


_explained_by_few = njit(cache=True, nogil=True)(_explained)
_explained_by_many = njit(cache=True, nogil=True, parallel=True)(_explained)
MANY = 1000
"""Places from which on the work is shared among cores; for fewer the sharing costs more."""


def matched_scans(evidence: Evidence, residual: Single, slope: int) -> Single:
    """Product of each scan with the beam toward each direction, shape (S, M)."""
    matched = np.empty((len(evidence), evidence.beams.shape[2]), dtype=np.float32)
    for turn_class in np.unique(evidence.turn_class):
        chosen = evidence.turn_class == turn_class
        matched[chosen] = residual[chosen] @ evidence.beams[slope, turn_class].T
    return matched


def explained_energy(
    evidence: Evidence,
    residual: Single,
    slopes: Sequence[int],
    places_m: FloatArray,
    kinds: NDArray[np.int64],
) -> FloatArray:
    """Energy of the residual that one source at each place would explain, shape (slopes, C).

    Parameters
    ----------
    evidence : Evidence
    residual : ndarray, shape (S, N)
    slopes : sequence of int
        Indices of the beams.
    places_m : ndarray, shape (C, 2)
    kinds : ndarray of int, shape (C,)
        `Kind` of each place.
    """
    matched = np.stack([matched_scans(evidence, residual, slope) for slope in slopes])
    return _explained_by(evidence, matched, slopes, places_m, kinds)


def heard_enough(
    evidence: Evidence, places_m: FloatArray, kinds: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Whether enough scans could tell of a source at each place, shape (C,)."""
    everything = np.ones((1, *evidence.range_m.shape), dtype=np.float32)
    return np.asarray(_explained_by(evidence, everything, [0], places_m, kinds)[0] > 0.0)


def _explained_by(
    evidence: Evidence,
    matched: Single,
    slopes: Sequence[int],
    places_m: FloatArray,
    kinds: NDArray[np.int64],
) -> FloatArray:
    energy = (evidence.beams[list(slopes), :, 0].astype(np.float64) ** 2).sum(axis=2)
    explained = _explained_by_many if len(places_m) >= MANY else _explained_by_few
    return np.asarray(
        explained(
            np.ascontiguousarray(places_m, dtype=np.float64),
            np.ascontiguousarray(kinds, dtype=np.int64),
            evidence.place_m,
            evidence.axis_rad,
            float(evidence.handedness),
            evidence.range_m,
            evidence.weight,
            matched,
            np.ascontiguousarray(energy[:, evidence.turn_class]),
        )
    )


def seen_from(
    evidence: Evidence, place_m: FloatArray, kind: Kind
) -> tuple[NDArray[np.int64], FloatArray, FloatArray, FloatArray]:
    """The scans that hear a place.

    Returns
    -------
    scans : ndarray of int, shape (V,)
    wave : ndarray, shape (V,)
        Bearing of the place in steps of the beams' directions.
    gain : ndarray, shape (V,)
        Received for emitted power, 1 at 1 m.
    beyond_m : ndarray, shape (V,)
        How far behind the first surface on its bearing it lies [m].
    """
    step = place_m - evidence.place_m
    distance = np.hypot(step[:, 0], step[:, 1])
    waves = evidence.range_m.shape[1]
    turn = evidence.handedness * (np.arctan2(step[:, 1], step[:, 0]) - evidence.axis_rad)
    wave = (turn / (2.0 * np.pi)) % 1.0 * waves
    nearest = np.rint(wave).astype(np.int64) % waves
    surface = evidence.range_m[np.arange(len(evidence)), nearest].astype(np.float64)
    gain = _gains(distance, surface, int(kind))
    scans = np.flatnonzero(gain > 0.0)
    return scans, wave[scans], gain[scans], (distance - surface)[scans]


def column(
    evidence: Evidence, scans: NDArray[np.int64], wave: FloatArray, gain: FloatArray, slope: int
) -> Single:
    """What a source of power 1 at 1 m adds to the scans that hear it, shape (V, N)."""
    waves = evidence.beams.shape[2]
    left = wave.astype(np.int64) % waves
    share = (wave - np.floor(wave)).astype(np.float32)[:, None]
    turn = evidence.turn_class[scans]
    beams = evidence.beams[slope]
    beam = (1.0 - share) * beams[turn, left] + share * beams[turn, (left + 1) % waves]
    return np.asarray((evidence.weight[scans] * gain).astype(np.float32)[:, None] * beam)
