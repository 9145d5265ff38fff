"""Joining: clock and yaw by the bearings of peaks, and by the sparse fit, as one.

Both look at the same scans, but err in ways of their own: peaks are pulled by what sounds beside
them, the fit by what it takes to sound there.
"""

from __future__ import annotations

import numpy as np

from soundmap.calibrate.peaks import beam_blur
from soundmap.calibrate.verdict import judged
from soundmap.config import CalibrateConfig, ScanConfig
from soundmap.geometry import FloatArray
from soundmap.sensors import ArrayOffsets, MicArray

SYSTEMATIC = np.array([0.003, np.radians(0.28)])
"""What the covariance of the fit does not know of, as seen on simulated sites [s, rad]; more where
the array's beam is wide."""
AGREEING_SIGMAS = 3.5
"""A fit that differs by more from what peaks tell is not believed."""


def joined_offsets(
    by_peaks: ArrayOffsets,
    by_fit: tuple[FloatArray, FloatArray],
    array: MicArray,
    scan: ScanConfig,
    calibrate: CalibrateConfig,
    *,
    bearings: int,
) -> ArrayOffsets:
    """Clock and yaw with their verdicts; those by peaks where the fit disagrees with them.

    Parameters
    ----------
    by_peaks : ArrayOffsets
        See `soundmap.calibrate.calibration`.
    by_fit : tuple of ndarray, shapes (2,) and (2, 2)
        Clock [s] and yaw [rad], and their covariance.
    array : MicArray
    scan : ScanConfig
    calibrate : CalibrateConfig
    bearings : int
        N, of a scan.
    """
    fitted, covariance = by_fit
    blur = beam_blur(array.positions_m, bearings, low_hz=scan.low_hz, high_hz=scan.high_hz)
    sigma = np.sqrt(np.diag(covariance) + (blur * SYSTEMATIC) ** 2)
    peaks = np.array([by_peaks.clock.value, by_peaks.yaw.value])
    peaks_sigma = np.array([by_peaks.clock.sigma, by_peaks.yaw.sigma])
    if np.any(np.abs(fitted - peaks) > AGREEING_SIGMAS * np.hypot(sigma, peaks_sigma)):
        return by_peaks
    weight = sigma**-2 / (sigma**-2 + peaks_sigma**-2)
    joined = weight * fitted + (1.0 - weight) * peaks
    correct = calibrate.mode == "correct"
    return judged(joined, sigma, by_peaks.explained, by_peaks.places, correct=correct)
