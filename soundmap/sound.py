"""What is heard, and where it comes from: audio scans, power maps, sources."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, Mount
from soundmap.grid import GridFrame

REFERENCE_PRESSURE_PA = 20e-6


class LevelReference(StrEnum):
    """What a power of 1 (0 dB) stands for."""

    FULL_SCALE = "dB re (full scale)^2"
    SOUND_PRESSURE = "dB re (20 uPa)^2"


def decibels(power: FloatArray | float) -> FloatArray:
    """10 log10 of a power; -inf for 0, NaN for NaN, without a warning."""
    with np.errstate(divide="ignore"):
        return np.asarray(10.0 * np.log10(power), dtype=np.float64)


@dataclass(frozen=True)
class AudioScan:
    r"""Steered response power over all bearings, averaged over about 100 ms.

    Attributes
    ----------
    time_ns : int
        Middle of the scan [ns since epoch].
    bearing_rad : ndarray, shape (N,)
        :math:`\theta_n`, counter-clockwise in the array's frame, in [0, 2 pi) [rad].
    power : ndarray, shape (N,)
        :math:`J_n`, mean square of the beamformer output over the band [linear].
    sharp : ndarray of float32, shape (N,), or None
        The same with the sound whitened and high frequencies favoured: 1 for a plane wave alone,
        1 over the number of microphones for noise that they do not share [-]. Its peaks lie nearer
        to the true bearings; how loud they are it does not tell.
    sub_bands : ndarray, shape (B, N), or None
        The same of each part of the band, which sum up to it; None if they are not told apart.
    """

    time_ns: int
    bearing_rad: FloatArray
    power: FloatArray
    sharp: NDArray[np.float32] | None = None
    sub_bands: NDArray[np.floating[Any]] | None = None

    def __post_init__(self) -> None:
        if self.power.shape != self.bearing_rad.shape:
            raise ValueError("an audio scan needs one power a bearing")

    def peaks(self) -> tuple[FloatArray, FloatArray]:
        """Local maxima over the circle, finer than the bearings are spaced.

        Each is the vertex of the parabola through a bearing that is louder than both of its
        neighbours and those two.

        Returns
        -------
        bearing_rad : ndarray, shape (P,)
            In the array's frame [rad], loudest first.
        power : ndarray, shape (P,)
            [linear]

        Examples
        --------
        >>> bearing = np.radians([0.0, 90.0, 180.0, 270.0])
        >>> scan = AudioScan(0, bearing, np.array([3.0, 2.0, 0.0, 1.0]))
        >>> np.degrees(scan.peaks()[0]).round(3).tolist()
        [15.0]
        """
        bearing, power = interpolated_peaks(self.power)
        tops = np.flatnonzero(np.isfinite(bearing))
        tops = tops[np.argsort(-self.power[tops], kind="stable")]
        return bearing[tops] % (2.0 * np.pi), power[tops]


def interpolated_peaks(power: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Local maxima of many scans over the circle, finer than the bearings are spaced.

    Parameters
    ----------
    power : ndarray, shape (..., N)
        On the bearings 2 pi n / N [linear].

    Returns
    -------
    bearing_rad : ndarray, shape (..., N)
        Where a bearing is louder than both of its neighbours, the vertex of the parabola through
        the three, within half a spacing of it [rad]; NaN elsewhere.
    power : ndarray, shape (..., N)
        That of the vertex [linear]; NaN elsewhere.
    """
    before, after = np.roll(power, 1, axis=-1), np.roll(power, -1, axis=-1)
    is_top = (power > before) & (power >= after)
    curvature = np.where(is_top, before - 2.0 * power + after, np.nan)
    offset = 0.5 * (before - after) / curvature
    spacing = 2.0 * np.pi / power.shape[-1]
    bearing = (np.arange(power.shape[-1]) + offset) * spacing
    return bearing, power - 0.25 * (before - after) * offset


@dataclass(frozen=True)
class AudioScans:
    """All audio scans of a run, as kept.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (S,)
        Middle of each scan [ns since epoch].
    bearing_rad : ndarray, shape (N,)
        In the array's frame [rad].
    power : ndarray of float32, shape (S, N)
        [linear].
    reference : LevelReference
    mount : Mount or None
        Where the array sits on the robot, and its bearings with it; None if nobody knows.
    sub_bands : ndarray of float32, shape (S, B, N), or None
        Power of each part of the band [linear]; None if they were not told apart.
    sub_band_hz : tuple of float
        The B + 1 edges of those parts [Hz].
    sharp : ndarray of float32, shape (S, N), or None
        As `AudioScan.sharp`; None if it was not asked for, or is no longer needed.
    """

    time_ns: NDArray[np.int64]
    bearing_rad: FloatArray
    power: NDArray[np.float32]
    reference: LevelReference
    mount: Mount | None = None
    sub_bands: NDArray[np.float32] | None = None
    sub_band_hz: tuple[float, ...] = ()
    sharp: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        scans, bearings = len(self.time_ns), len(self.bearing_rad)
        if self.sharp is not None and self.sharp.shape != (scans, bearings):
            raise ValueError("audio scans need one sharp power a time and bearing")
        if self.power.shape != (scans, bearings):
            raise ValueError("audio scans need one power a time and bearing")
        parts = max(len(self.sub_band_hz) - 1, 0)
        if self.sub_bands is not None and self.sub_bands.shape != (scans, parts, bearings):
            raise ValueError("audio scans need one power a time, sub-band and bearing")

    def __len__(self) -> int:
        return len(self.time_ns)


@dataclass(frozen=True)
class PowerMap:
    """Mean emitted power of the surfaces, and how often each cell was visited. Eqs. (4)-(5).

    Attributes
    ----------
    frame : GridFrame
    power_sum : ndarray, shape (H, W)
        :math:`P_{ij} K_{ij}`, sum of the shares that each cell received [linear]. Sums and
        visits of two runs add up to those of both.
    visits : ndarray of int64, shape (H, W)
        :math:`K_{ij}`.
    reference : LevelReference
    square_sum : ndarray, shape (H, W), or None
        Sum of the squares of the shares, which tells how they scatter; None if unknown.
    is_limit : ndarray of bool, shape (H, W), or None
        Where the power is only the most that can be there: no source was found in that cell. None
        if all cells hold what was measured.
    """

    frame: GridFrame
    power_sum: FloatArray
    visits: NDArray[np.int64]
    reference: LevelReference
    square_sum: FloatArray | None = None
    is_limit: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        if self.is_limit is not None and self.is_limit.shape != self.frame.shape:
            raise ValueError("a power map needs one mark of limits a cell")
        if self.power_sum.shape != self.frame.shape or self.visits.shape != self.frame.shape:
            raise ValueError("a power map needs one sum and one count a cell")
        if self.square_sum is not None and self.square_sum.shape != self.frame.shape:
            raise ValueError("a power map needs one sum of squares a cell")

    def power(self, *, min_visit_share: float = 0.0) -> FloatArray:
        """:math:`P_{ij}`, shape (H, W) [linear]; NaN where not measured or visited too rarely.

        A cell counts when :math:`K_{ij}` is greater than ``min_visit_share`` of the greatest
        count (Sect. 4 uses 0.1).
        """
        seen = self.visits > min_visit_share * self.visits.max(initial=0)
        seen &= self.visits > 0
        with np.errstate(invalid="ignore"):
            return np.where(seen, self.power_sum / np.maximum(self.visits, 1), np.nan)

    def spread(self) -> FloatArray:
        """Standard deviation of the shares that each cell received, shape (H, W) [linear].

        NaN where fewer than two visits, or nothing, tells of it.
        """
        if self.square_sum is None:
            return np.full(self.frame.shape, np.nan)
        many = np.maximum(self.visits, 2)
        excess = self.square_sum - self.power_sum**2 / many
        variance = np.maximum(excess, 0.0) / (many - 1)
        return np.where(self.visits > 1, np.sqrt(variance), np.nan)


@dataclass(frozen=True)
class SourceFit:
    """What the fit to all scans tells of a source beyond its place.

    Attributes
    ----------
    power_1m : float
        Mean square in the band at 1 m [linear].
    covariance_m2 : ndarray, shape (2, 2)
        Of x and y [m^2].
    false_alarm_probability : float
        That anything in a run would seem as much of a source by chance, or as a ghost of others.
    arc_rad : float
        Width of the arc of directions that it was heard from [rad].
    flags : tuple of str
        ``not_seen_by_laser``, ``reflection_suspected``, ``seen_from_one_side``, ``unsteady``,
        ``moving``.
    level_sigma_db : float or None
        Standard error of the level, from how it scatters along the way [dB]; None if unknown.
    """

    power_1m: float
    covariance_m2: FloatArray
    false_alarm_probability: float
    arc_rad: float
    flags: tuple[str, ...]
    level_sigma_db: float | None = None


@dataclass(frozen=True)
class Source:
    """Where sound comes from: a local maximum of the power map, or a source of the fit.

    Attributes
    ----------
    x_m, y_m : float
        Position in the map frame [m].
    power : float
        :math:`P_{ij}` there [linear]; of a fitted source, that at 1 m.
    visits : int
        :math:`K_{ij}` there; of a fitted source, the audio scans that heard it.
    fit : SourceFit or None
        None if it is a mere maximum.
    """

    x_m: float
    y_m: float
    power: float
    visits: int
    fit: SourceFit | None = None


@dataclass(frozen=True)
class Reflection:
    """The mirror image of a source, behind the surface that reflects it.

    Attributes
    ----------
    x_m, y_m : float
        Position of the image in the map frame [m].
    power : float
        Mean square in the band at 1 m from the image [linear].
    source : int or None
        Index of the source that it belongs to; None if none fits.
    """

    x_m: float
    y_m: float
    power: float
    source: int | None


@dataclass(frozen=True)
class SourceList:
    """Sources, loudest first. Without any source it is empty, not None.

    Attributes
    ----------
    sources : tuple of Source
    reference : LevelReference
        What their power refers to.
    reflections : tuple of Reflection
        Mirror images, loudest first; known only from a fit.
    """

    sources: tuple[Source, ...]
    reference: LevelReference
    reflections: tuple[Reflection, ...] = ()

    def __iter__(self) -> Iterator[Source]:
        return iter(self.sources)

    def __len__(self) -> int:
        return len(self.sources)
