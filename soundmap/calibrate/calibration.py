"""From the sharp audio scans of a run to the error of the array's clock and mount.

Nothing is said where the evidence is not clear: where what was heard does not come from fixed
places for the most part, where different starts end in different results, or where the way and
the sources leave a result too uncertain to be of use.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from soundmap.calibrate.bearing_fit import BearingFit, Stretch, drifting_fit, rigid_fit
from soundmap.calibrate.far_field import (
    UNTOLD,
    FarClock,
    Surveyed,
    array_beam,
    far_field_clock,
    level_scans,
    without_far_field,
)
from soundmap.calibrate.peaks import Peaks, beam_blur, clear_peaks
from soundmap.calibrate.search import ballot, fixed_places, starting_points
from soundmap.calibrate.verdict import judged
from soundmap.calibrate.way import Way, WayAt, array_way, moved_apart
from soundmap.config import CalibrateConfig, ScanConfig
from soundmap.geometry import Trajectory
from soundmap.sensors import ArrayOffsets, MicArray, Offset, OffsetVerdict
from soundmap.side_by_side import side_by_side

LEAST_SCANS = 40
STRETCH_M, STRETCH_SCANS, MOST_STRETCHES = 15.0, 400, 20
"""Places are sought on stretches of the way of this length and no more scans; on so many."""
MARGIN_NS = 250_000_000
"""Poses are needed so long before and after a scan."""
LEAST_EXTENT_M = 1.0
"""Bearings from a smaller area cross nowhere, whatever the yaw."""
FAR_FIELD_BLUR = 1.5
"""In wider beams than this what is near and what is far cannot be told apart."""
LEAST_EXPLAINED = 0.7
"""Stretches on which less of what was heard comes from fixed places tell nothing."""
EQUAL_SHARE = 0.02
"""Fits that explain this much less than the best still count as equal to it."""
SYSTEMATIC = np.array([0.003, np.radians(0.2)])
"""What the variance of the fit does not know of, as seen on simulated sites [s, rad]; more where
the array's beam is wide."""
UNCONFIRMED = np.array([0.006, 0.0])
"""... and of the clock where bearings alone tell it: a place may be pulled all through a turn."""
YAW_ALONE = np.array([0.0, 1.0])
"""The yaw rests on where the places are, and one that is wrong may pull it; the clock on turns."""


def array_offsets(
    sharp: NDArray[np.float32],
    time_ns: NDArray[np.int64],
    trajectory: Trajectory,
    array: MicArray,
    scan: ScanConfig,
    calibrate: CalibrateConfig,
) -> ArrayOffsets:
    """How far the array's clock and yaw are off, and whether that is clear enough to correct it.

    Parameters
    ----------
    sharp : ndarray of float32, shape (S, N)
        Of the audio scans, on bearings 2 pi n / N; see `AudioScan.sharp`.
    time_ns : ndarray of int64, shape (S,)
        Middle of each scan, by the audio's clock.
    trajectory : Trajectory
        Base in the map frame.
    array : MicArray
        With its mount as believed.
    scan : ScanConfig
    calibrate : CalibrateConfig
    """
    span_s = (scan.frames - 1) * scan.hop_s + scan.window_s

    def way(scans: NDArray[np.int64], clock_s: float = 0.0) -> Way:
        times = time_ns[scans]
        return array_way(trajectory, times, array.mount, clock_s=clock_s, span_s=span_s)

    usable = trajectory.usable_at(time_ns - MARGIN_NS) & trajectory.usable_at(time_ns + MARGIN_NS)
    scans = np.flatnonzero(usable & np.isfinite(sharp).all(axis=1))
    scans = scans[moved_apart(way(scans), time_ns[scans])]
    if len(scans) < LEAST_SCANS:
        return _nothing("too few audio scans with a trusted pose")
    if trajectory.extent_m() < LEAST_EXTENT_M:
        return _nothing(f"the robot stays within {LEAST_EXTENT_M:.0f} m")
    spans = _stretches(way(scans))
    scans = np.concatenate([scans[first:last] for first, last in spans])
    ends = np.cumsum([0, *(last - first for first, last in spans)])
    level = level_scans(sharp[scans], array)

    def way_at(clock_s: float) -> Way:
        return way(scans, clock_s)

    blur = beam_blur(array.positions_m, sharp.shape[1], low_hz=scan.low_hz, high_hz=scan.high_hz)
    sharp_beam = blur < FAR_FIELD_BLUR
    near = _without_far_fields(level, way_at(0.0), ends) if sharp_beam else level
    peaks = clear_peaks(near, blur=blur)
    fits = _fits(peaks, way_at, ends)
    if not fits:
        return _nothing("no fixed place was heard")
    best = max(fits, key=lambda fit: fit.explained)
    equal = [fit.state for fit in fits if fit.explained > best.explained - EQUAL_SHARE]
    doubt = 0.5 * np.ptp(np.array(equal), axis=0)
    clear = best.where_explained(LEAST_EXPLAINED)
    if not clear.stretches:
        return _nothing(
            f"only {best.explained:.0%} of what was heard comes from fixed places "
            f"({LEAST_EXPLAINED:.0%} is needed)",
            best,
        )
    far = _far_clock(level, way_at, clear, array, scan) if sharp_beam else UNTOLD
    final = drifting_fit(peaks, way_at, clear, far)
    systematic = np.hypot(blur * SYSTEMATIC, UNCONFIRMED * np.isinf(far.sigma))
    mixed = final.spread * YAW_ALONE
    sigma = np.sqrt(np.diag(final.covariance) + systematic**2 + doubt**2 + mixed**2)
    sigma[0] *= max(1.0, _disagreement(final, far))
    places = sum(len(stretch.place_m) for stretch in final.stretches)
    correct = calibrate.mode == "correct"
    return judged(final.state, sigma, final.explained, places, correct=correct)


def _without_far_fields(
    level: NDArray[np.float32], way: Way, ends: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Scans without the far field of each stretch."""
    return np.concatenate(
        [without_far_field(level[a:b], way.axis_rad[a:b]) for a, b in pairwise(ends.tolist())]
    )


def _far_clock(
    level: NDArray[np.float32], way_at: WayAt, fit: BearingFit, array: MicArray, scan: ScanConfig
) -> FarClock:
    """What the far field tells of the clock where a fit has found what is near."""
    beam = array_beam(
        array,
        level.shape[1],
        low_hz=scan.low_hz,
        high_hz=scan.high_hz,
        speed_of_sound_m_s=scan.speed_of_sound_m_s,
    )
    stretches = [
        Surveyed(stretch.scans.start, beam.harmonics(level[stretch.scans]), stretch.place_m)
        for stretch in fit.stretches
    ]
    clock_s, yaw_rad = fit.state.tolist()
    return far_field_clock(stretches, way_at, beam, clock_s=clock_s, yaw_rad=yaw_rad)


def _disagreement(fit: BearingFit, far: FarClock) -> float:
    """How far apart bearings and far field have the clock, in standard deviations of both."""
    variance = float(fit.covariance[0, 0])
    by_bearings = 1.0 / variance - far.sigma**-2
    if np.isinf(far.sigma) or by_bearings < 1e-2 / variance:
        return 0.0
    clock = (float(fit.state[0]) / variance - far.value * far.sigma**-2) / by_bearings
    return abs(clock - far.value) / float(np.sqrt(1.0 / by_bearings + far.sigma**2))


def _fits(peaks: Peaks, way_at: WayAt, ends: NDArray[np.int64]) -> list[BearingFit]:
    """A rigid fit from each of the most promising starts; stretches end before these scans."""
    way = way_at(0.0)
    limits = np.searchsorted(peaks.scan, ends).tolist()
    spans = list(pairwise(ends.tolist()))
    ballots = side_by_side(lambda span: ballot(way, peaks, *span), spans)

    def fit_from(start: tuple[float, float]) -> BearingFit | None:
        stretches = [
            Stretch(slice(*span), first, last, fixed_places(votes, *start))
            for span, (first, last), votes in zip(spans, pairwise(limits), ballots, strict=True)
        ]
        stretches = [s for s in stretches if len(s.place_m) and s.last > s.first]
        return rigid_fit(peaks, way_at, stretches, start) if stretches else None

    fits = side_by_side(fit_from, starting_points(ballots))
    return [fit for fit in fits if fit is not None]


def _stretches(way: Way) -> list[tuple[int, int]]:
    """First and one past the last scan of stretches of the way, all about as long.

    Of a long run, so many as suffice, spread over all of it.
    """
    driven = way.driven_m()
    count = max(1, round(driven[-1] / STRETCH_M), -(-len(way) // STRETCH_SCANS))
    along = np.arange(len(way)) / len(way) + driven / max(driven[-1], 1e-9)
    ends = np.searchsorted(along, np.linspace(0.0, 2.0, count + 1))
    ends[-1] = len(way)
    spans = [(int(a), int(b)) for a, b in pairwise(ends) if b > a]
    chosen = np.linspace(0, len(spans) - 1, min(len(spans), MOST_STRETCHES)).round().astype(int)
    return [spans[index] for index in chosen]


def _nothing(why: str, best: BearingFit | None = None) -> ArrayOffsets:
    unknown = Offset(np.nan, np.nan, OffsetVerdict.UNKNOWN)
    if best is None:
        return ArrayOffsets(unknown, unknown, 0.0, 0, why)
    clock_s, yaw_rad = best.state.tolist()
    return ArrayOffsets(unknown, unknown, best.explained, 0, why, guess=(clock_s, yaw_rad))
