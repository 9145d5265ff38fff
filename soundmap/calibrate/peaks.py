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
    """

    scan: NDArray[np.int64]
    bearing_rad: FloatArray
    contrast: FloatArray

    def __len__(self) -> int:
        return len(self.scan)

    @property
    def sigma_rad(self) -> FloatArray:
        """Standard deviation of each bearing, but for what its place adds [rad], shape (P,)."""
        return np.hypot(SIGMA_RAD, SIGMA_AT_CONTRAST_1_RAD / self.contrast)


def clear_peaks(sharp: NDArray[np.float32]) -> Peaks:
    """The peaks that stand out.

    Parameters
    ----------
    sharp : ndarray of float32, shape (S, N)
        Of each scan on the bearings 2 pi n / N, as `AudioScan.sharp`.

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
    return Peaks(scan.astype(np.int64), angle % (2.0 * np.pi), above / floor[scan])
