"""The clear peaks of all audio scans over the bearings, and how well each tells a bearing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray

LEAST_CONTRAST = 0.25
"""A peak stands out from the median over the bearings by this share of it, or more."""
LEAST_OF_STRONGEST = 0.2
"""... and by this share of what the strongest peak of its scan does: side lobes do not."""
SIGMA_RAD, SIGMA_AT_CONTRAST_1_RAD = np.radians(0.4), np.radians(0.6)
"""Error of a peak's bearing, as seen on simulated sites: of a clear one, and of a faint one."""
SEEN_WITH_M_HZ, SEEN_WITH_SPACING_RAD = 0.155 * 4677.0, np.radians(3.0)
"""Array, radius times frequency, and bearings for which these hold; wider beams err more."""


@dataclass(frozen=True)
class Peaks:
    """Peaks of many scans.

    Attributes
    ----------
    scan : ndarray of int, shape (P,)
        Whose peak it is, rising.
    bearing_rad : ndarray, shape (P,)
        In the array's frame [rad].
    contrast : ndarray, shape (P,)
        How far it stands out from the median over the bearings, over that median [-].
    blur : float
        Width of the array's beam over that of a ring of 31 cm between 1 and 6 kHz [-].
    """

    scan: NDArray[np.int64]
    bearing_rad: FloatArray
    contrast: FloatArray
    blur: float = 1.0

    def __len__(self) -> int:
        return len(self.scan)

    @property
    def sigma_rad(self) -> FloatArray:
        """Standard deviation of each bearing, but for what its place adds [rad], shape (P,)."""
        return self.blur * np.hypot(SIGMA_RAD, SIGMA_AT_CONTRAST_1_RAD / self.contrast)


def beam_blur(positions_m: FloatArray, bearings: int, *, low_hz: float, high_hz: float) -> float:
    """How wide the beam of an array is in a sharp scan; see `Peaks.blur`.

    Examples
    --------
    >>> angle = 2.0 * np.pi * np.arange(8) / 8
    >>> ring = 0.0775 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)
    >>> round(beam_blur(ring, 120, low_hz=1000.0, high_hz=6000.0), 2)
    2.0
    """
    centred = positions_m[:, :2] - positions_m[:, :2].mean(axis=0)
    radius = max(float(np.sqrt(np.mean(np.sum(centred**2, axis=1)))), 1e-3)
    frequency = np.linspace(low_hz, high_hz, 100)
    mean_hz = float(np.sqrt(np.sum(frequency**4) / np.sum(frequency**2)))
    spacing = 2.0 * np.pi / bearings
    return max(1.0, SEEN_WITH_M_HZ / (radius * mean_hz), spacing / SEEN_WITH_SPACING_RAD)


def clear_peaks(sharp: NDArray[np.float32], *, blur: float = 1.0) -> Peaks:
    """The peaks that stand out.

    Parameters
    ----------
    sharp : ndarray of float32, shape (S, N)
        Of each scan on the bearings 2 pi n / N, as `AudioScan.sharp`.
    blur : float
        Of the array.

    Examples
    --------
    >>> scan = np.ones((1, 8), dtype=np.float32)
    >>> scan[0, 1:4] = 2.0, 5.0, 2.0
    >>> peaks = clear_peaks(scan)
    >>> np.degrees(peaks.bearing_rad).round(1).tolist(), peaks.contrast.round(1).tolist()
    ([90.0], [4.0])
    """
    power = sharp.astype(np.float64)
    before, after = np.roll(power, 1, axis=1), np.roll(power, -1, axis=1)
    scan, bearing = np.nonzero((power > before) & (power >= after))
    left, here, right = before[scan, bearing], power[scan, bearing], after[scan, bearing]
    offset = 0.5 * (left - right) / (left - 2.0 * here + right)
    floor = np.median(power, axis=1)
    above = here - 0.25 * (left - right) * offset - floor[scan]
    strongest = (power.max(axis=1, initial=0.0) - floor)[scan]
    clear = (above > LEAST_CONTRAST * floor[scan]) & (above > LEAST_OF_STRONGEST * strongest)
    clear &= floor[scan] > 0.0
    scan, above = scan[clear], above[clear]
    angle = (bearing[clear] + offset[clear]) * 2.0 * np.pi / power.shape[1]
    return Peaks(scan.astype(np.int64), angle % (2.0 * np.pi), above / floor[scan], blur)
