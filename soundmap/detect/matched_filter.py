r"""Matched filter: how much of what the fit leaves over one more source would explain.

With the residual r of a scan, the covariance :math:`\Sigma` of noise and model errors and the beam
b of a wave from some direction, a source of unknown spectrum that is heard with gain g explains

.. math:: \sum_B \frac{\max(0, \sum_s g_s \, b_s^T \Sigma_s^{-1} r_s)^2}
                       {\sum_s g_s^2 \, b_s^T \Sigma_s^{-1} b_s}

of the misfit, summed over sub-bands B. Both products are worked out once for all directions around
each scan; a place then takes one look into them a scan.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit, prange

from soundmap.detect.evidence import Evidence
from soundmap.detect.harmonics import APERTURES, Single
from soundmap.detect.model_errors import Precision, parts
from soundmap.detect.sound_paths import NEAREST_M, REACH_M, Kind, seen
from soundmap.geometry import FloatArray
from soundmap.side_by_side import side_by_side

HEIGHTS_M = np.array([0.2, 0.6, 1.1])
"""Heights between array and source that are tried [m]."""
CLASSES = np.array([0, 4])
"""Apertures at which energies are worked out."""
COARSE = 3
"""Directions between those at which energies are worked out."""
LEAST_SCANS = 8.0
"""A place that fewer scans (effective number) tell of is no candidate."""
MANY = 100
"""Places from which on the work is shared among cores; for fewer the sharing costs more."""


@dataclass(frozen=True)
class MatchedScans:
    """Products of each scan with the beams all around.

    Attributes
    ----------
    match : ndarray of float32, shape (S, B, E, M)
        Of the residual.
    energy : ndarray of float32, shape (S, B, len(CLASSES), M / COARSE)
        Of the beams themselves.
    """

    match: Single
    energy: Single


def matched_scans(evidence: Evidence, residual: Single, precision: Precision) -> MatchedScans:
    """Products of a residual (S, D) with all beams."""
    weighted = precision.times(residual)
    return MatchedScans(beam_matches(evidence, weighted), beam_energies(evidence, precision))


def beam_matches(evidence: Evidence, weighted: Single) -> Single:
    r"""Products of all beams with :math:`\Sigma^{-1} r` (S, D), shape (S, B, E, M)."""
    beams = evidence.table.beams
    apertures, waves, _ = beams.shape
    match = np.empty((len(evidence), evidence.sub_bands, apertures, waves), dtype=np.float32)

    def fill(scans: slice) -> None:
        for band, own in enumerate(pairwise(evidence.table.starts)):
            beam = beams[:, :, slice(*own)].reshape(apertures * waves, -1)
            product = weighted[scans, slice(*own)] @ beam.T
            match[scans, band] = product.reshape(-1, apertures, waves)

    side_by_side(fill, parts(len(evidence)))
    return match


def beam_energies(evidence: Evidence, precision: Precision) -> Single:
    r"""Products :math:`b^T \Sigma^{-1} b` of a few beams, shape (S, B, classes, M / COARSE)."""
    beams, starts = evidence.table.beams, evidence.table.starts
    count = beams.shape[1] // COARSE
    energy = np.empty((len(evidence), evidence.sub_bands, len(CLASSES), count), dtype=np.float32)

    def fill(scans: slice) -> None:
        for band, inverse in enumerate(precision.inverse):
            for index, aperture in enumerate(CLASSES):
                few = beams[aperture, : count * COARSE : COARSE, starts[band] : starts[band + 1]]
                few = np.ascontiguousarray(few)
                weighted = np.matmul(few, inverse[scans])
                energy[scans, band, index] = np.einsum("smd,md->sm", weighted, few)

    side_by_side(fill, parts(len(evidence)))
    return energy


def explained(
    evidence: Evidence,
    matched: MatchedScans,
    places_m: FloatArray,
    kind: Kind,
    *,
    least_scans: float = LEAST_SCANS,
) -> FloatArray:
    """Misfit that one source at each place would explain, shape (C, heights).

    Parameters
    ----------
    evidence : Evidence
    matched : MatchedScans
    places_m : ndarray, shape (C, 2)
        [m]
    kind : Kind
    least_scans : float
        A place that fewer (effective number) tell of explains nothing.
    """
    run = _explained_by_many if len(places_m) >= MANY else _explained_by_few
    return np.asarray(
        run(
            np.ascontiguousarray(places_m, dtype=np.float64),
            HEIGHTS_M,
            kind == Kind.IMAGE,
            least_scans,
            evidence.place_m,
            evidence.axis_rad,
            float(evidence.handedness),
            evidence.range_m,
            evidence.weight,
            matched.match,
            matched.energy,
            APERTURES,
        )
    )


def _explained(
    places: FloatArray,
    heights: FloatArray,
    behind: bool,
    least_scans: float,
    stand: FloatArray,
    axis: FloatArray,
    hand: float,
    ranges: Single,
    weight: FloatArray,
    match: Single,
    energy: Single,
    apertures: FloatArray,
) -> FloatArray:
    scans, bands, classes, waves = match.shape
    explained = np.zeros((len(places), len(heights)))
    border = (0.5 * (apertures[:-1] + apertures[1:])) ** 2
    for c in prange(len(places)):
        product = np.zeros((len(heights), bands))
        square = np.zeros((len(heights), bands))
        told, told_twice = np.zeros(len(heights)), np.zeros(len(heights))
        for s in range(scans):
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
            distance = np.sqrt(square_m)
            beyond = distance - ranges[s, left if share < 0.5 else right]
            if not seen(distance, beyond, behind):
                continue
            near = max(distance, NEAREST_M)
            coarse = int(at / COARSE + 0.5) % energy.shape[3]
            for h in range(len(heights)):
                near_by = 1.0 / (near * near + heights[h] * heights[h])
                aperture_squared = near * near * near_by
                e = 0
                while e < classes - 1 and border[e] > aperture_squared:
                    e += 1
                total = 0.0
                for b in range(bands):
                    gain = weight[s, b] * near_by
                    between = (1.0 - share) * match[s, b, e, left] + share * match[s, b, e, right]
                    own = gain * gain * energy[s, b, 0 if e < 3 else 1, coarse]
                    product[h, b] += gain * between
                    square[h, b] += own
                    total += own
                told[h] += total
                told_twice[h] += total * total
        for h in range(len(heights)):
            if told[h] * told[h] > least_scans * told_twice[h]:
                for b in range(bands):
                    if product[h, b] > 0.0 and square[h, b] > 0.0:
                        explained[c, h] += product[h, b] * product[h, b] / square[h, b]
    return explained


def effective_number(gain: FloatArray) -> float:
    """How many scans tell of a source that they hear with these gains."""
    square = gain**2
    return float(square.sum() ** 2 / max(np.sum(square**2), 1e-300))


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


_explained_by_few = njit(cache=True, nogil=True)(_explained)
_explained_by_many = njit(cache=True, nogil=True, parallel=True)(_explained)
