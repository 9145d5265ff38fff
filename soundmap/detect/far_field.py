r"""Far field: what comes from the same bearings of the map wherever the robot stands.

Reverberation that has long forgotten its source, a hall behind an open door, traffic: such sound
has no place, but it is not the same from all sides either. Its power over the bearings of the map
has harmonics f, unknown ones, in each sub-band, and scan s hears

.. math:: A_s f = w_s \, T \, R(\alpha_s) \, f,

R turning them into the array's axes, T being the array's response and w one over the noise. A fit
of the components' strengths q beside it has the normal equations

.. math:: \begin{pmatrix} G & C \\ C^T & F \end{pmatrix} \begin{pmatrix} q \\ f \end{pmatrix} =
          \begin{pmatrix} b \\ a \end{pmatrix}, \quad
          F = \sum_s A_s^T \Sigma_s^{-1} A_s + \lambda I,

from which f is taken out: :math:`(G - C F^{-1} C^T) q = b - C F^{-1} a`. Held to nought by
:math:`\lambda`, the far field leaves to the components what either could explain.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numba import njit

from soundmap.detect.evidence import Evidence
from soundmap.detect.harmonics import Single
from soundmap.detect.model_errors import Precision, parts
from soundmap.geometry import FloatArray
from soundmap.side_by_side import side_by_side

USUAL = 1.0
"""Standard deviation of what the far field adds to a scan, over that of the noise."""


class FarField:
    """The far field's part in the normal equations of a fit.

    Parameters
    ----------
    evidence : Evidence
    """

    def __init__(self, evidence: Evidence) -> None:
        self.starts = evidence.table.starts
        self._bands = [
            FarFieldBand(evidence, band, slice(start, stop))
            for band, (start, stop) in enumerate(pairwise(self.starts))
        ]

    def inverse(self, precision: Precision) -> FloatArray:
        r"""Inverse of :math:`F`, shape (D, D)."""
        inverse = np.zeros((int(self.starts[-1]),) * 2)
        bands = zip(self._bands, pairwise(self.starts), precision.inverse, strict=True)
        for turning, own, weights in bands:
            inverse[slice(*own), slice(*own)] = np.linalg.inv(turning.normal(weights))
        return inverse

    def pull(self, weighted: Single) -> FloatArray:
        r""":math:`\sum_s A_s^T` times columns (..., S, D), shape (..., D)."""
        told = [
            self.pull_band(band, weighted[..., slice(*own)], slice(None))
            for band, own in enumerate(pairwise(self.starts))
        ]
        return np.concatenate(told, axis=-1).astype(np.float64)

    def pull_band(self, band: int, weighted: Single, scans: slice) -> Single:
        """The same of one sub-band and some scans, columns (..., s, d) to (..., d)."""
        return self._bands[band].pull(weighted, scans)

    def pulls(self, weighted: Single) -> Single:
        r""":math:`A_s^T` times a column (S, D), scan by scan, shape (S, D)."""
        bands = zip(self._bands, pairwise(self.starts), strict=True)
        return np.hstack([turning.pulls(weighted[:, slice(*own)]) for turning, own in bands])

    def heard(self, field: FloatArray) -> Single:
        """What a far field (D,) adds to each scan, shape (S, D)."""
        bands = zip(self._bands, pairwise(self.starts), strict=True)
        single = field.astype(np.float32)
        return np.hstack([turning.heard(single[slice(*own)]) for turning, own in bands])

    def turned(self, field: FloatArray) -> Single:
        """Change of what a far field (D,) adds with the array's direction, shape (S, D) [1/rad]."""
        change = np.empty_like(field)
        for start, stop in pairwise(self.starts):
            cos, sin = np.split(field[start:stop], 2)
            number = np.arange(1, len(cos) + 1)
            change[start:stop] = np.concatenate([number * sin, -number * cos])
        return self.heard(change)


class FarFieldBand:
    """Response of the array to a far field of a sub-band, turned as it stood in each scan.

    Parameters
    ----------
    evidence : Evidence
    band : int
    own : slice
        The sub-band's part of D.
    aperture : int
        Number of the aperture that the waves have, of `APERTURES`.

    Attributes
    ----------
    held : float
        How firmly each harmonic is held to nought.
    """

    def __init__(self, evidence: Evidence, band: int, own: slice, aperture: int = 0) -> None:
        table = evidence.table
        beams = table.beams[aperture, :, own].astype(np.float64)
        number = np.arange(1, beams.shape[1] // 2 + 1)
        phase = 2.0 * np.pi / table.waves * np.arange(table.waves)[:, None] * number
        by_cos, by_sin = beams.T @ np.cos(phase), beams.T @ np.sin(phase)
        size = np.sqrt(0.5 * np.sum(by_cos**2 + by_sin**2, axis=0)) + 1e-12
        self._by_cos = (by_cos / size).astype(np.float32)
        self._by_sin = (by_sin / size * evidence.handedness).astype(np.float32)
        self._by_both = np.hstack([self._by_cos, self._by_sin])
        smeared = (1.0 + 2.0 * np.cos(evidence.turn_rad[:, None] * number / np.sqrt(8.0))) / 3.0
        smeared *= evidence.weight[:, band : band + 1]
        turn = evidence.axis_rad[:, None] * number
        self._cos = (smeared * np.cos(turn)).astype(np.float32)
        self._sin = (smeared * np.sin(turn)).astype(np.float32)
        self.held = float(np.mean(evidence.weight[:, band] ** 2)) / USUAL**2

    def normal(self, weights: Single) -> FloatArray:
        r""":math:`\sum_s A_s^T \Sigma_s^{-1} A_s + \lambda I`, weights (S, d, d), shape (d, d)."""

        def of_some(scans: slice) -> Single:
            columns = self.columns(scans)
            weighted = np.matmul(weights[scans], columns)
            return columns.reshape(-1, columns.shape[2]).T @ weighted.reshape(-1, columns.shape[2])

        normal = self.held * np.eye(weights.shape[1])
        for square in side_by_side(of_some, parts(len(weights))):
            normal += square
        return normal

    def columns(self, scans: slice) -> Single:
        """What each harmonic adds to some scans, shape (s, d, d)."""
        cos, sin = self._cos[scans, None], self._sin[scans, None]
        return np.concatenate(
            [self._by_cos * cos - self._by_sin * sin, self._by_cos * sin + self._by_sin * cos],
            axis=2,
        )

    def pull(self, weighted: Single, scans: slice) -> Single:
        """Sum of the columns' products with others (..., s, d), shape (..., d)."""
        both = np.ascontiguousarray(weighted) @ self._by_both
        told = np.zeros((*both.shape[:-2], both.shape[-1]), dtype=np.float32)
        flat = told.reshape(-1, told.shape[-1]), both.reshape(-1, *both.shape[-2:])
        _add_turned(*flat, self._cos[scans], self._sin[scans])
        return told

    def pulls(self, weighted: Single) -> Single:
        """The columns' products with another (S, d), scan by scan, shape (S, d)."""
        even, odd = np.split(weighted @ self._by_both, 2, axis=-1)
        return np.hstack([self._cos * even - self._sin * odd, self._sin * even + self._cos * odd])

    def heard(self, field: Single) -> Single:
        """What a field (d,) adds to each scan, shape (S, d)."""
        cos, sin = np.split(field, 2)
        even, odd = self._cos * cos + self._sin * sin, self._cos * sin - self._sin * cos
        return even @ self._by_cos.T + odd @ self._by_sin.T


@njit(cache=True, nogil=True)
def _add_turned(out: Single, both: Single, cos: Single, sin: Single) -> None:
    """Sums (K, d) of products (K, s, d) with both parts of each harmonic, turned scan by scan."""
    half = cos.shape[1]
    for k in range(len(both)):
        for s in range(len(cos)):
            for h in range(half):
                even, odd = both[k, s, h], both[k, s, half + h]
                out[k, h] += cos[s, h] * even - sin[s, h] * odd
                out[k, half + h] += sin[s, h] * even + cos[s, h] * odd
