r"""Harmonics: scans and beams as Fourier series over the bearings, evened out.

What a beamformer shows over the bearings is smooth: few harmonics hold all of it, the fewer the
lower the frequency. Noise that microphones do not share has a covariance over the bearings that is
the beam itself; dividing each harmonic by the square root of the beam's makes such noise as loud in
all of them. Beams then are as narrow as the array allows, which tells neighbours apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from soundmap.beam import beam_patterns
from soundmap.geometry import FloatArray
from soundmap.sensors import MicArray

APERTURES = np.array([1.0, 0.97, 0.93, 0.87, 0.79, 0.68, 0.55, 0.4])
"""Cosines of the elevations for which beams are worked out, falling."""
FREQUENCIES = 6
"""Frequencies that stand for a sub-band."""
LEAST_HARMONIC = 0.004
"""Harmonics weaker than this share of the strongest are left out."""
NOISE_FLOOR = 0.03
"""Part of the noise that does not follow the beam: keeps weak harmonics from being blown up."""

Single = NDArray[np.float32]


@dataclass(frozen=True)
class BeamTable:
    """Beams toward all directions, as evened-out harmonics.

    Attributes
    ----------
    beams : ndarray of float32, shape (E, M, D)
        Of waves of each aperture from M directions. D runs over the sub-bands, in each over the
        real, then the imaginary parts.
    starts : ndarray of int, shape (B + 1,)
        Where each sub-band begins in D.
    factor : tuple of ndarray
        For each sub-band what its harmonics 1, 2, ... are multiplied by.
    width_rad : ndarray, shape (B,)
        Half the width of the main lobe at half its height [rad].
    """

    beams: Single
    starts: NDArray[np.int64]
    factor: tuple[FloatArray, ...]
    width_rad: FloatArray

    @property
    def waves(self) -> int:
        """M, directions of the waves."""
        return self.beams.shape[1]

    @cached_property
    def turned(self) -> Single:
        """Change of the beams with the direction of the wave, shape (E, M, D) [1/rad]."""
        after, before = np.roll(self.beams, -1, axis=1), np.roll(self.beams, 1, axis=1)
        return np.asarray((after - before) * np.float32(self.waves / (4.0 * np.pi)))

    @property
    def part(self) -> NDArray[np.int64]:
        """Sub-band of each of the D numbers."""
        return np.repeat(np.arange(len(self.factor)), np.diff(self.starts))

    def harmonics(self, power: NDArray[np.floating[Any]]) -> FloatArray:
        """Scans (..., B, N) of each sub-band as evened-out harmonics (..., D)."""
        return np.concatenate(
            [
                _evened(power[..., index, :], factor, len(factor) + 1)
                for index, factor in enumerate(self.factor)
            ],
            axis=-1,
        )


def beam_table(
    array: MicArray,
    edges_hz: Sequence[float],
    *,
    bearings: int,
    waves: int,
    speed_of_sound_m_s: float,
) -> BeamTable:
    """Beams of an array in each sub-band.

    Parameters
    ----------
    array : MicArray
    edges_hz : sequence of float, length B + 1
        Of the sub-bands [Hz].
    bearings : int
        N, of a scan.
    waves : int
        M, directions of the waves.
    speed_of_sound_m_s : float
    """
    beams, factors, widths = [], [], []
    for low_hz, high_hz in pairwise(edges_hz):
        step = (high_hz - low_hz) / FREQUENCIES
        patterns = np.stack(
            [
                beam_patterns(
                    array.positions_m,
                    bearings=bearings,
                    waves=waves,
                    frequency_hz=np.asarray(low_hz + step * (np.arange(FREQUENCIES) + 0.5)),
                    aperture=aperture,
                    speed_of_sound_m_s=speed_of_sound_m_s,
                )
                for aperture in APERTURES
            ]
        )
        size = np.abs(np.fft.rfft(patterns[0], axis=1)[:, 1:]) / bearings
        beam = np.sqrt(np.mean(size**2, axis=0))
        last = int(np.flatnonzero(beam > LEAST_HARMONIC * beam.max())[-1]) + 1
        factor = 1.0 / np.sqrt(beam[:last] / beam.max() + NOISE_FLOOR)
        beams.append(_evened(patterns, factor, last + 1).astype(np.float32))
        factors.append(factor)
        widths.append(_half_width(patterns[0]))
    starts = np.cumsum([0, *(part.shape[-1] for part in beams)])
    return BeamTable(np.concatenate(beams, axis=-1), starts, tuple(factors), np.array(widths))


def _evened(power: NDArray[np.floating[Any]], factor: FloatArray, end: int) -> FloatArray:
    """Real and imaginary parts of the harmonics 1 to ``end`` - 1, each times its factor."""
    series = np.fft.rfft(power, axis=-1)[..., 1:end] * (factor * np.sqrt(2.0 / power.shape[-1]))
    return np.concatenate([series.real, series.imag], axis=-1).astype(np.float64)


def _half_width(patterns: FloatArray) -> float:
    """Mean over the waves of half the main lobe's width at half its height [rad]."""
    above = np.sum(patterns > 0.5, axis=1)
    return float(np.pi * np.mean(above) / patterns.shape[1])


@njit(cache=True, nogil=True)
def look_up(
    beam: Single, beams: Single, weight: Single, wave: float, aperture: float, turn: float
) -> None:
    """Put a beam (D,), times a weight (D,), interpolated between directions and apertures.

    While the array turns the beam is smeared: three directions with the variance of an even turn
    stand for it.

    Parameters
    ----------
    beam : ndarray of float32, shape (D,)
        Where it is put.
    beams : ndarray of float32, shape (E, M, D)
        `BeamTable.beams`, or how they change with the direction.
    weight : ndarray of float32, shape (D,)
    wave, turn : float
        Direction, and how far the array turned, in steps of the beams' directions.
    aperture : float
    """
    directions = beams.shape[1]
    step = turn / np.sqrt(8.0)
    looks = 3 if step > 0.2 else 1
    e = 0
    while e < len(APERTURES) - 2 and APERTURES[e + 1] > aperture:
        e += 1
    low = (APERTURES[e] - aperture) / (APERTURES[e] - APERTURES[e + 1])
    low = min(max(low, 0.0), 1.0)
    beam[:] = 0.0
    for j in range(looks):
        at = wave + (j - 1) * step if looks == 3 else wave
        at -= np.floor(at / directions) * directions
        left = int(at)
        share = at - left
        left %= directions
        right = (left + 1) % directions
        a0, a1 = np.float32((1 - low) * (1 - share) / looks), np.float32((1 - low) * share / looks)
        b0, b1 = np.float32(low * (1 - share) / looks), np.float32(low * share / looks)
        for d in range(len(beam)):
            beam[d] += weight[d] * (
                a0 * beams[e, left, d]
                + a1 * beams[e, right, d]
                + b0 * beams[e + 1, left, d]
                + b1 * beams[e + 1, right, d]
            )


@njit(cache=True, nogil=True)
def add(out: Single, factor: float, beam: Single) -> None:
    """Add a multiple of a beam to what is heard, both (D,)."""
    single = np.float32(factor)
    for d in range(len(beam)):
        out[d] += single * beam[d]
