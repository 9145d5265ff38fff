r"""Sound from afar: what lies on the same bearings of the map wherever the robot stands.

Reverberation that has long forgotten its source, a hall behind an open door, traffic: all this
hardly changes along some metres of the way, but it is not the same on all bearings. Seen from the
array it turns against the robot as the robot turns, whatever lies near. So it does two things.

It adds a slope under every peak, and pulls all bearings of near places toward where it is loud: it
is taken out of the scans before peaks are sought. And it tells the clock: with the fixed places'
own beams projected out, scans are

.. math:: z_s = T \, R(\alpha(t_s + \delta)) \, d + \epsilon_s,

with d the harmonics of the far field over the map's bearings, R what turns them into the array's
axes, T the array's response, and :math:`\delta` what its clock lacks. It tells nothing of the yaw.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soundmap.beam import beam_patterns
from soundmap.calibrate.way import Way, WayAt
from soundmap.geometry import FloatArray
from soundmap.sensors import MicArray

LOWER_SHARE = 25.0
"""Percentile over the scans that stands for the far field: near sources are on a bearing of the map
for a smaller part of them than they are not."""
WAVES, FREQUENCIES = 180, 8
"""Directions for which beams are worked out, and frequencies that stand for the band."""
LEAST_HARMONIC, NOISE_FLOOR = 0.01, 0.05
"""Harmonics weaker than this share of the strongest are left out; those that are kept are evened
out, but for a floor."""
MOST_HARMONICS = 24
HELD, HELD_PLACES = 0.003, 0.02
"""How firmly unknowns are held to nought, over what the scans tell of them on average: harmonics
of the far field, and what places add to a scan."""
OFF_RAD = np.radians(4.0)
"""Places may lie so far off their bearing: beams there are projected out as well."""
ROUNDS, SETTLED_S, GREATEST_STEP_S = 5, 3e-4, 0.04
REWEIGHTED = 3
PIECE_M, LEAST_REST = 1.5, 0.05
"""Pieces of the way for the jackknife, and the least share of all that the others tell."""
SYSTEMATIC_S, ALIKE = 0.003, 0.09
"""What the jackknife does not know of, as seen on simulated sites: of the clock itself, and of
what is left of a scan, over what chance would make of it."""
USEFUL_S = 0.02
"""What tells the clock less surely than this is not asked."""


@dataclass(frozen=True)
class ArrayBeam:
    """The array's beam in sharp scans, as evened-out harmonics over the bearings.

    Attributes
    ----------
    factor : ndarray, shape (D,)
        What evens them out: first the cosines, then the sines of harmonics 1 to D / 2.
    wave, slope : ndarray, shape (WAVES, D)
        Of waves from all directions, and their derivative by the direction [1/rad].
    response : ndarray, shape (D, D)
        Of a field whose power over the directions has these cosines and sines.
    """

    factor: FloatArray
    wave: FloatArray
    slope: FloatArray
    response: FloatArray

    def harmonics(self, sharp: NDArray[np.float32]) -> FloatArray:
        """Scans (S, N) as evened-out harmonics (S, D)."""
        return _series(sharp.astype(np.float64), len(self.factor) // 2) * self.factor


@dataclass(frozen=True)
class Surveyed:
    """A stretch of the way: its scans, the first of which is number ``first``, and its places."""

    first: int
    harmonics: FloatArray
    place_m: FloatArray


@dataclass(frozen=True)
class FarClock:
    """What the clock lacks by the far field, and the standard deviation of that [s]."""

    value: float
    sigma: float


UNTOLD = FarClock(0.0, np.inf)


def level_scans(sharp: NDArray[np.float32], array: MicArray) -> NDArray[np.float32]:
    """Scans with bearings that run counter-clockwise seen from above, however the array hangs."""
    return sharp if array.mount.handedness > 0 else np.roll(sharp[:, ::-1], 1, axis=1)


def without_far_field(sharp: NDArray[np.float32], axis_rad: FloatArray) -> NDArray[np.float32]:
    """Scans without what lies on the same bearings of the map in most of them.

    Parameters
    ----------
    sharp : ndarray of float32, shape (S, N)
        As `level_scans` returns them.
    axis_rad : ndarray, shape (S,)
        Direction of the array's x axis in the map frame [rad].

    Examples
    --------
    >>> scans = np.ones((3, 8), dtype=np.float32)
    >>> scans[[0, 1, 2], [5, 4, 3]] = 2.0  # always at 225 degrees of the map
    >>> left = without_far_field(scans, np.radians([0.0, 45.0, 90.0]))
    >>> float(np.ptp(left).round(6))
    0.0
    """
    on_map = _turned(sharp, -axis_rad)
    field = np.percentile(on_map, LOWER_SHARE, axis=0)
    far = _turned(np.broadcast_to(field - field.mean(), sharp.shape), axis_rad)
    return np.asarray(sharp - far, dtype=np.float32)


def _turned(scans: NDArray[np.floating], by_rad: FloatArray) -> FloatArray:
    """Scans with bearing b where b + by was."""
    series = np.fft.rfft(scans, axis=1)
    turn = np.exp(1j * by_rad[:, None] * np.arange(series.shape[1]))
    return np.fft.irfft(series * turn, n=scans.shape[1], axis=1)


def array_beam(
    array: MicArray, bearings: int, *, low_hz: float, high_hz: float, speed_of_sound_m_s: float
) -> ArrayBeam:
    """The beam of an array in sharp scans, in which loudness grows with frequency squared."""
    level = array.positions_m * np.array([1.0, array.mount.handedness, 1.0])
    share = (np.arange(FREQUENCIES) + 0.5) / FREQUENCIES
    patterns = beam_patterns(
        level,
        bearings=bearings,
        waves=WAVES,
        frequency_hz=np.cbrt(low_hz**3 + share * (high_hz**3 - low_hz**3)),
        speed_of_sound_m_s=speed_of_sound_m_s,
    )
    size = np.sqrt(np.mean(np.abs(np.fft.rfft(patterns, axis=1)[:, 1:]) ** 2, axis=0))
    last = int(np.flatnonzero(size > LEAST_HARMONIC * size.max())[-1]) + 1
    last = min(last, MOST_HARMONICS)
    factor = np.tile(1.0 / np.sqrt(size[:last] / size.max() + NOISE_FLOOR), 2)
    wave = _series(patterns, last) * factor
    step = 2.0 * np.pi / WAVES
    phase = step * np.arange(WAVES)[:, None] * np.arange(1, last + 1)
    swell = np.hstack([np.cos(phase), np.sin(phase)])
    slope = (np.roll(wave, -1, axis=0) - np.roll(wave, 1, axis=0)) / (2.0 * step)
    return ArrayBeam(factor, wave, slope, wave.T @ swell * (2.0 / WAVES))


def _series(scans: FloatArray, last: int) -> FloatArray:
    """Real and imaginary parts of harmonics 1 to ``last``."""
    series = np.fft.rfft(scans, axis=1)[:, 1 : last + 1] * (np.sqrt(2.0) / scans.shape[1])
    return np.hstack([series.real, series.imag])


def far_field_clock(
    stretches: Sequence[Surveyed],
    way_at: WayAt,
    beam: ArrayBeam,
    *,
    clock_s: float,
    yaw_rad: float,
) -> FarClock:
    """The clock that lets the far field of each stretch stand still while the robot turns.

    Parameters
    ----------
    stretches : sequence of Surveyed
    way_at : callable
        The way over all scans by the clock's offset.
    beam : ArrayBeam
    clock_s, yaw_rad : float
        Offsets to begin from.
    """
    for _ in range(ROUNDS):
        way = way_at(clock_s)
        pull, information = np.zeros((2, len(way)))
        for stretch in stretches:
            scans = slice(stretch.first, stretch.first + len(stretch.harmonics))
            pull[scans], information[scans] = _told(stretch, way.part(scans), beam, yaw_rad)
        total = max(float(information.sum()), 1.0)
        step = float(pull.sum()) / total
        clock_s += float(np.clip(step, -GREATEST_STEP_S, GREATEST_STEP_S))
        if abs(step) < SETTLED_S:
            break
    piece = np.floor(way.driven_m() / PIECE_M).astype(np.int64)
    chance = max(_leaving_one_out(pull, information, piece), total**-0.5)
    # Of one scan that tells much. What the field is not like repeats itself from scan to scan and
    # from lap to lap, so that no number of scans makes up for it.
    single = max(float(information @ information) / total, 1e-9)
    alike = ALIKE * float(np.sqrt(len(beam.factor) / single))
    sigma = float(np.sqrt(SYSTEMATIC_S**2 + alike**2 + chance**2))
    return FarClock(clock_s, sigma) if sigma < USEFUL_S else UNTOLD


def _leaving_one_out(pull: FloatArray, information: FloatArray, piece: NDArray[np.int64]) -> float:
    """Standard deviation of the clock by the jackknife over pieces of the way [s]."""
    own_pull, own = (np.bincount(piece, each).astype(np.float64) for each in (pull, information))
    total = max(float(own.sum()), 1.0)
    rest = np.maximum(total - own, LEAST_REST * total)
    return float(np.sqrt(np.sum(own_pull**2 / (total * rest))))


def _told(
    stretch: Surveyed, way: Way, beam: ArrayBeam, yaw_rad: float
) -> tuple[FloatArray, FloatArray]:
    """What each scan tells of the clock, its far field unknown: pull [1/s], information [1/s^2]."""
    axis = way.axis_rad + yaw_rad
    project = _projection(stretch.place_m, way, axis, beam)
    heard = project(stretch.harmonics[:, :, None])[:, :, 0]
    expected = project(_turned_response(beam.response, axis))
    size = len(beam.factor)
    columns = expected.reshape(-1, size)
    weight = np.ones(len(heard))
    for _ in range(REWEIGHTED):
        weighted = (expected * weight.astype(np.float32)[:, None, None]).reshape(-1, size)
        normal = (weighted.T @ columns).astype(np.float64)
        normal += HELD * np.trace(normal) / size * np.eye(size)
        field = np.linalg.solve(normal, weighted.T @ heard.ravel())
        left = heard - _applied(expected, field)
        usual = np.sqrt(np.mean(left**2, axis=1))
        weight = np.maximum(usual, max(float(np.median(usual)), 1e-9)) ** -2.0
    number = np.arange(1, size // 2 + 1)
    quarter = np.concatenate([number * field[size // 2 :], -number * field[: size // 2]])
    turned = project((_turned_field(quarter, axis) @ beam.response.T)[:, :, None])[:, :, 0]
    turned *= way.turn_rad_s[:, None]
    coupling = weighted.T @ turned.ravel()
    alone = turned - _applied(expected, np.linalg.solve(normal, coupling))
    return weight * np.sum(alone * left, axis=1), weight * np.sum(alone * turned, axis=1)


def _applied(expected: NDArray[np.float32], field: NDArray[np.floating[Any]]) -> FloatArray:
    """What a field makes of each scan, shape (S, D): in single precision, since it is large."""
    return np.asarray(expected @ field.astype(np.float32), dtype=np.float64)


def _projection(
    place_m: FloatArray, way: Way, axis_rad: FloatArray, beam: ArrayBeam
) -> Callable[[NDArray[Any]], NDArray[np.float32]]:
    """What takes columns (S, D, C) free of the beams of all places."""
    step = place_m - way.place_m[:, None]
    bearing = np.arctan2(step[..., 1], step[..., 0]) - axis_rad[:, None]
    wave = np.rint(bearing * (WAVES / (2.0 * np.pi))).astype(np.int64) % WAVES
    own = np.concatenate([beam.wave[wave], OFF_RAD * beam.slope[wave]], axis=1)
    gram = own @ own.transpose(0, 2, 1)
    held = HELD_PLACES * np.trace(gram, axis1=1, axis2=2) / gram.shape[1]
    inverse = np.linalg.solve(gram + held[:, None, None] * np.eye(gram.shape[1]), own)
    from_own, to_own = own.transpose(0, 2, 1).astype(np.float32), inverse.astype(np.float32)

    def project(columns: NDArray[Any]) -> NDArray[np.float32]:
        single = columns.astype(np.float32)
        return np.asarray(single - from_own @ (to_own @ single))

    return project


def _turned_response(response: FloatArray, axis_rad: FloatArray) -> NDArray[np.float32]:
    """Response to a field's harmonics in the map's axes, shape (S, D, D)."""
    cos, sin = _steps(axis_rad, response.shape[1] // 2)
    by_cos, by_sin = np.hsplit(response.astype(np.float32), 2)
    turned = np.empty((len(axis_rad), *response.shape), dtype=np.float32)
    turned[:, :, : cos.shape[1]] = by_cos * cos[:, None] - by_sin * sin[:, None]
    turned[:, :, cos.shape[1] :] = by_cos * sin[:, None] + by_sin * cos[:, None]
    return turned


def _turned_field(field: FloatArray, axis_rad: FloatArray) -> FloatArray:
    """A field's harmonics in the array's axes, shape (S, D)."""
    cos, sin = _steps(axis_rad, len(field) // 2)
    by_cos, by_sin = np.split(field, 2)
    return np.hstack([by_cos * cos + by_sin * sin, by_sin * cos - by_cos * sin])


def _steps(axis_rad: FloatArray, last: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    phase = axis_rad[:, None] * np.arange(1, last + 1)
    return np.cos(phase).astype(np.float32), np.sin(phase).astype(np.float32)
