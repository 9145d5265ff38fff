"""Audio scans, laser scans and trajectory fused into the power map. Sect. 2.4."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.config import FuseConfig
from soundmap.deskew import deskewed_rays
from soundmap.fuse.accumulate import PowerAccumulator, strongest_candidate
from soundmap.fuse.bearing_range import ranges_on_bearings
from soundmap.fuse.emitted_power import emitted_power
from soundmap.geometry import FloatArray, Mount, Trajectory, transformed
from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.losses import LossLedger
from soundmap.sensors import LaserScan
from soundmap.sound import AudioScan, LevelReference

STAGE = "fuse"
DIRECTIONS = 360
"""Directions around the array in which the surroundings of each scan are kept."""
LASER_AGE_NS = 200_000_000
"""A laser scan farther from an audio scan than this no longer shows the same surroundings."""


@dataclass(frozen=True)
class FusedScan:
    """What became of one audio scan.

    Attributes
    ----------
    time_ns : int
        Middle of the audio scan [ns since epoch].
    pose : ndarray, shape (3,)
        Base in the map frame; NaN where unknown.
    point_m : ndarray, shape (2,) or None
        Where its strongest candidate lies in the map frame [m]; None if it added nothing.
    power : float
        :math:`C_m` [linear]; NaN if it added nothing.
    around_m : ndarray of float32, shape (M,)
        Range to the first surface all around, on the array's own bearings 2 pi m / M [m]; NaN
        where unknown.
    """

    time_ns: int
    pose: FloatArray
    point_m: FloatArray | None
    power: float
    around_m: NDArray[np.float32]


def power_map_frame(room: OccupancyGrid, cell_m: float) -> GridFrame:
    """Grid of the power map: covers the geometric map, from the same lower-left corner."""
    left, right, bottom, top = room.frame.extent_m
    rows = int(np.ceil((top - bottom) / cell_m - 1e-6))
    columns = int(np.ceil((right - left) / cell_m - 1e-6))
    return GridFrame(cell_m, (left, bottom), (max(rows, 1), max(columns, 1)))


def fused_scans(
    scans: Iterable[AudioScan],
    lasers: Iterable[LaserScan],
    trajectory: Trajectory,
    accumulator: PowerAccumulator,
    array_mount: Mount,
    config: FuseConfig,
    *,
    losses: LossLedger,
) -> Iterator[FusedScan]:
    r"""Adds every audio scan to the accumulator, and tells what became of it.

    After each scan the accumulator holds the power map so far. The ranges :math:`\rho_n` come
    from the laser scans of all scanners nearest in time, each ray taken from its own time to the
    audio scan's; the array's own pose at that time turns bearing and range into a place.

    Parameters
    ----------
    scans : iterable of AudioScan
    lasers : iterable of LaserScan
        Both ordered by time.
    trajectory : Trajectory
        Base in the map frame.
    accumulator : PowerAccumulator
    array_mount : Mount
        Microphone array in the base frame.
    config : FuseConfig
    losses : LossLedger

    Yields
    ------
    FusedScan
    """
    nearest = _NearestScans(lasers)
    directions = array_mount.base_bearing(2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS)
    unknown = np.full(DIRECTIONS, np.nan, dtype=np.float32)
    for scan in scans:
        pose = trajectory.at(scan.time_ns)
        nothing = FusedScan(scan.time_ns, pose, None, np.nan, unknown)
        around = nearest.at(scan.time_ns)
        if not np.isfinite(pose).all():
            losses.remark(
                "audio scan before the first or after the last laser scan used",
                STAGE,
                effect="not fused",
            )
            yield nothing
            continue
        if not trajectory.usable_at(scan.time_ns):
            losses.add("audio scan without a trusted pose", STAGE, effect="not fused")
            yield nothing
            continue
        if not around:
            losses.add("audio scan without a laser scan at its time", STAGE, effect="not fused")
            yield nothing
            continue
        rays = [deskewed_rays(laser, trajectory, scan.time_ns) for laser in around]
        points = np.concatenate([swept.end_m for swept in rays]) - array_mount.translation_m[:2]
        ranges = ranges_on_bearings(points, directions, tolerance_rad=np.pi / DIRECTIONS)
        seen = ranges.astype(np.float32)
        nothing = FusedScan(scan.time_ns, pose, None, np.nan, seen)
        candidate = _candidate(scan, pose, points, array_mount, config)
        if candidate is None:
            losses.remark("audio scan without a surface in range", STAGE, effect="not fused")
            yield nothing
            continue
        point, power, distance = candidate
        spacing = 2.0 * np.pi / len(scan.bearing_rad)
        if accumulator.add(point, power, size_m=spacing * distance):
            yield FusedScan(scan.time_ns, pose, point, power, seen)
        else:
            losses.remark("surface outside the map", STAGE, effect="not fused")
            yield nothing


def level_reference(pascal_per_count: float | None) -> LevelReference:
    """What powers refer to: sound pressure only if the array is calibrated."""
    if pascal_per_count is None:
        return LevelReference.FULL_SCALE
    return LevelReference.SOUND_PRESSURE


def _candidate(
    scan: AudioScan,
    pose: FloatArray,
    points_m: FloatArray,
    array_mount: Mount,
    config: FuseConfig,
) -> tuple[FloatArray, float, float] | None:
    """Place [m, map frame], emitted power and range [m] of the scan's strongest candidate."""
    centre = array_mount.translation_m[:2]
    bearing, received = scan.bearing_rad, scan.power
    spacing = 2.0 * np.pi / len(bearing)
    if config.candidates == "peaks":
        bearing, received = scan.peaks()
    bearing = array_mount.base_bearing(bearing)
    ranges = ranges_on_bearings(points_m, bearing, tolerance_rad=0.5 * spacing)
    emitted = emitted_power(
        received, ranges, alpha=config.alpha, d_min=config.d_min_m, d_max=config.d_max_m
    )
    best = strongest_candidate(emitted)
    if best is None:
        return None
    direction = np.array([np.cos(bearing[best]), np.sin(bearing[best])])
    point = transformed(pose, centre + ranges[best] * direction)
    return point, float(emitted[best]), float(ranges[best])


class _NearestScans:
    """For increasing times, the laser scan nearest in time of each scanner."""

    def __init__(self, lasers: Iterable[LaserScan]) -> None:
        self._lasers = iter(lasers)
        self._ahead: LaserScan | None = next(self._lasers, None)
        self._around: deque[LaserScan] = deque()

    def at(self, time_ns: int) -> list[LaserScan]:
        """Scans within `LASER_AGE_NS` of a time, one a scanner, in the scanners' order."""
        while self._ahead is not None and self._ahead.middle_ns <= time_ns + LASER_AGE_NS:
            self._around.append(self._ahead)
            self._ahead = next(self._lasers, None)
        while self._around and self._around[0].middle_ns < time_ns - LASER_AGE_NS:
            self._around.popleft()
        nearest: dict[int, LaserScan] = {}
        for scan in sorted(self._around, key=lambda scan: abs(scan.middle_ns - time_ns)):
            nearest.setdefault(scan.scanner, scan)
        return [nearest[scanner] for scanner in sorted(nearest)]
