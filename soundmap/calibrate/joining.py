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

TOO_SURE, USUALLY_LEFT = 1.4, 0.3
"""Standard deviations of the fit are this much too small, as seen on simulated sites: sound that
interferes with its reflections errs alike in scans taken near to each other. If more than the
second is left unexplained of what was heard, by so much the more."""
SYSTEMATIC = np.array([0.001, np.radians(0.28)])
"""What does not grow less the more turns there are [s, rad], microphones that are not quite where
they are said to be among it; more where the array's beam is wide."""
LEAST_EXPLAINED = 0.65
"""Where peaks tell nothing, or something else, a fit is believed that explains at least this share
of what was heard: on such simulated sites 0.67 to 0.77 where all sources stood still, 0.57 at most
where all moved."""
AGREEING_SIGMAS = 3.5
"""Estimates that are apart by more tell different things."""
CORRELATION = 0.5
"""Of the errors of both, which look at the same scans: whichever is twice as sure says it all."""


def joined_offsets(
    by_peaks: ArrayOffsets,
    by_fit: tuple[FloatArray, FloatArray, float],
    array: MicArray,
    scan: ScanConfig,
    calibrate: CalibrateConfig,
    *,
    bearings: int,
) -> ArrayOffsets:
    """Clock and yaw with their verdicts.

    Where both are apart by more than they should, standard deviations grow by as much. Where the
    peaks tell nothing, or both differ altogether, they are those of the fit if it explains enough,
    else those of the peaks.

    Parameters
    ----------
    by_peaks : ArrayOffsets
        See `soundmap.calibrate.calibration`.
    by_fit : tuple of two ndarray, shapes (2,) and (2, 2), and float
        Clock [s] and yaw [rad], their covariance, and the share of what was heard that is
        explained.
    array : MicArray
    scan : ScanConfig
    calibrate : CalibrateConfig
    bearings : int
        N, of a scan.
    """
    fitted, covariance, explained = by_fit
    blur = beam_blur(array.positions_m, bearings, low_hz=scan.low_hz, high_hz=scan.high_hz)
    own = TOO_SURE * max((1.0 - explained) / USUALLY_LEFT, 1.0) * np.sqrt(np.diag(covariance))
    sigma = np.hypot(own, blur * SYSTEMATIC)
    correct = calibrate.mode == "correct"
    peaks = np.array([by_peaks.clock.value, by_peaks.yaw.value])
    peaks_sigma = np.array([by_peaks.clock.sigma, by_peaks.yaw.sigma])
    apart = np.abs(fitted - peaks) / np.hypot(sigma, peaks_sigma)
    if np.all(apart < AGREEING_SIGMAS):  # not where the peaks tell nothing
        weight = _weight(own / peaks_sigma)
        fitted = weight * fitted + (1.0 - weight) * peaks
        sigma = sigma * np.maximum(apart, 1.0)  # the scale factor of the Particle Data Group
    elif explained < LEAST_EXPLAINED:
        return by_peaks
    return judged(fitted, sigma, by_peaks.explained, by_peaks.places, correct=correct)


def _weight(ratio: FloatArray) -> FloatArray:
    """Best weight of an estimate beside another with errors in its part, by standard deviations.

    ``ratio`` is that of its standard deviation to the other's; microphones that are not where they
    are said to be err both alike, and have no part in it.
    """
    both = 1.0 + ratio**2 - 2.0 * CORRELATION * ratio
    return np.clip((1.0 - CORRELATION * ratio) / both, 0.0, 1.0)
