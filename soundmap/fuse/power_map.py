"""Audio scans, laser scans and trajectory fused into the power map. Sect. 2.4."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.config import FuseConfig
from soundmap.fuse.accumulate import PowerAccumulator
from soundmap.fuse.bearing_range import AGE_NS, surface_ranges
from soundmap.fuse.emitted_power import emitted_power
from soundmap.geometry import FloatArray, Mount, Trajectory, transformed
from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.losses import LossLedger
from soundmap.sound import AudioScans, LevelReference, interpolated_peaks
from soundmap.surroundings import Surroundings

STAGE = "fuse"
CHUNK = 1024
"""Scans whose candidates are worked out at a time; bounds the memory of long runs."""


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
    """

    time_ns: int
    pose: FloatArray
    point_m: FloatArray | None
    power: float


def power_map_frame(room: OccupancyGrid, cell_m: float) -> GridFrame:
    """Grid of the power map: covers the geometric map, from the same lower-left corner."""
    left, right, bottom, top = room.frame.extent_m
    rows = int(np.ceil((top - bottom) / cell_m - 1e-6))
    columns = int(np.ceil((right - left) / cell_m - 1e-6))
    return GridFrame(cell_m, (left, bottom), (max(rows, 1), max(columns, 1)))


def fused_scans(
    scans: AudioScans,
    surroundings: Surroundings,
    trajectory: Trajectory,
    accumulator: PowerAccumulator,
    array_mount: Mount,
    config: FuseConfig,
    *,
    losses: LossLedger,
) -> Iterator[FusedScan]:
    r"""Adds every audio scan to the accumulator, and tells what became of it.

    After each scan the accumulator holds the power map so far. The ranges :math:`\rho_n` come
    from the laser points nearest in time, taken along with the robot's motion to the audio scan's;
    the array's own pose at that time turns bearing and range into a place.

    Parameters
    ----------
    scans : AudioScans
        Ordered by time.
    surroundings : Surroundings
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
    spacing = 2.0 * np.pi / len(scans.bearing_rad)
    for start in range(0, len(scans), CHUNK):
        part = slice(start, start + CHUNK)
        time_ns = scans.time_ns[part]
        pose = trajectory.at(time_ns)
        trusted = trajectory.usable_at(time_ns)
        seen = surroundings.nearest(time_ns, within_ns=AGE_NS) >= 0
        power = scans.power[part].astype(np.float64)
        found = _candidates(power, surroundings, trajectory, time_ns, array_mount, config)
        point = transformed(pose, found.point_m)
        for k, time in enumerate(time_ns.tolist()):
            nothing = FusedScan(time, pose[k], None, np.nan)
            if not np.isfinite(pose[k]).all():
                what = "audio scan before the first or after the last laser scan used"
                losses.remark(what, STAGE, effect="not fused")
                yield nothing
            elif not trusted[k]:
                losses.add("audio scan without a trusted pose", STAGE, effect="not fused")
                yield nothing
            elif not seen[k]:
                what = "audio scan without a laser scan at its time"
                losses.add(what, STAGE, effect="not fused")
                yield nothing
            elif not np.isfinite(found.power[k]):
                losses.remark("audio scan without a surface in range", STAGE, effect="not fused")
                yield nothing
            elif accumulator.add(point[k], found.power[k], size_m=spacing * found.range_m[k]):
                yield FusedScan(time, pose[k], point[k], float(found.power[k]))
            else:
                losses.remark("surface outside the map", STAGE, effect="not fused")
                yield nothing


def level_reference(pascal_per_count: float | None) -> LevelReference:
    """What powers refer to: sound pressure only if the array is calibrated."""
    if pascal_per_count is None:
        return LevelReference.FULL_SCALE
    return LevelReference.SOUND_PRESSURE


@dataclass(frozen=True)
class _Candidates:
    """The strongest candidate of each of S scans; NaN where a scan has none.

    ``point_m`` (S, 2) lies in the base frame [m]; ``power`` and ``range_m`` are (S,).
    """

    point_m: FloatArray
    power: FloatArray
    range_m: FloatArray


def _candidates(
    received: FloatArray,
    surroundings: Surroundings,
    trajectory: Trajectory,
    time_ns: NDArray[np.int64],
    array_mount: Mount,
    config: FuseConfig,
) -> _Candidates:
    """Place, emitted power and range of the strongest candidate m of each scan, Eq. (3)."""
    spacing = 2.0 * np.pi / received.shape[1]
    bearing = np.broadcast_to(spacing * np.arange(received.shape[1]), received.shape)
    if config.candidates == "peaks":
        bearing, received = interpolated_peaks(received)
    ranges = surface_ranges(
        surroundings, trajectory, time_ns, array_mount, bearing, tolerance_rad=0.5 * spacing
    )
    emitted = emitted_power(
        received, ranges, alpha=config.alpha, d_min=config.d_min_m, d_max=config.d_max_m
    )
    best = np.argmax(np.where(np.isfinite(emitted), emitted, -np.inf), axis=1)[:, None]
    power, distance, bearing = (
        np.take_along_axis(values, best, axis=1)[:, 0]
        for values in (emitted, ranges.astype(np.float64), bearing)
    )
    toward = array_mount.base_bearing(bearing)
    direction = np.stack([np.cos(toward), np.sin(toward)], axis=-1)
    return _Candidates(
        array_mount.translation_m[:2] + distance[:, None] * direction, power, distance
    )
