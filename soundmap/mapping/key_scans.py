"""Key scans: the few laser scans that a map is made of, kept small.

One is taken when its scanner has moved or turned since the last. Scanners are not merged: each
scan stands at its own time, with the rays taken to it. Returns that come from the robot itself
stay in one place of its frame wherever it drives, and are removed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from soundmap.deskew import Rays, deskewed_rays, interpolated_pose
from soundmap.errors import NothingUsableError
from soundmap.geometry import FloatArray, Trajectory, wrapped_angle
from soundmap.losses import LossLedger
from soundmap.mapping.surface_lines import surface_lines
from soundmap.sensors import LaserScan
from soundmap.standstill import StandstillWitness, compared_ranges, has_moved

STAGE = "map"
LEAST_RAYS = 20
"""A scan with fewer returns says too little."""
BODY_REACH_M = 1.0
"""The robot's own parts lie within this distance of the scanner."""
BODY_CELL_M = 0.05
BODY_SHARE = 0.7
"""A place in the robot's frame that is hit in this share of the scans belongs to the robot ..."""
BODY_LEAST_SCANS = 20
"""... if so many scans ..."""
BODY_LEAST_WAY_M = 2.0
"""... were taken over at least this way."""
STRIP_M = 0.25
STICKS = 0.2
"""Odometry may stick that has moved less than this share of the way to the next key scan ..."""
LOOK_NS = 100_000_000
"""... for this long: then what the scanner sees decides."""

Float32Array = NDArray[np.float32]


def strip_order(points: Float32Array) -> NDArray[np.int64]:
    """Order in which points near a place are found fast: by strips along x, by x within a strip.

    Parameters
    ----------
    points : ndarray of float32, shape (P, 2)
        [m]
    """
    return np.lexsort((points[:, 0], np.floor(points[:, 1] / STRIP_M)))


@dataclass(frozen=True)
class KeyScan:
    """One laser scan of which the map is made. Returns are in `strip_order`.

    Attributes
    ----------
    time_ns : int
        Time of the pose, the middle of the sweep [ns since epoch].
    scanner : int
    odometry : ndarray, shape (3,)
        Base in the odometry frame.
    driven_m : float
        Distance driven up to then by odometry [m].
    turned_rad : float
        Angle turned up to then, left and right added up [rad].
    origin_m, end_m : ndarray of float32, shapes (P, 2)
        Where rays started and met a surface, in the base frame [m]; the noise across the surface
        taken out by the returns around.
    normal : ndarray of float32, shape (P, 2)
        Unit normal of the surface in the base frame, towards the scanner; zero if unknown.
    """

    time_ns: int
    scanner: int
    odometry: FloatArray
    driven_m: float
    turned_rad: float
    origin_m: Float32Array
    end_m: Float32Array
    normal: Float32Array

    def __len__(self) -> int:
        return len(self.end_m)


@dataclass(frozen=True)
class KeyScans:
    """The key scans of a run by time, and the times of all laser scans seen.

    Attributes
    ----------
    scans : tuple of KeyScan
    time_ns : ndarray of int64, shape (S,)
        Middle of every laser scan within the time of the odometry, increasing [ns since epoch].
    body_returns : int
        Returns removed because they came from the robot itself.
    """

    scans: tuple[KeyScan, ...]
    time_ns: NDArray[np.int64]
    body_returns: int


def chosen_key_scans(
    lasers: Iterable[LaserScan],
    odometry: Trajectory,
    *,
    distance_m: float,
    angle_rad: float,
    most_returns: int,
    spacing_m: float,
    losses: LossLedger,
) -> KeyScans:
    """The scans to make a map of, each taken to its own middle and thinned.

    Parameters
    ----------
    lasers : iterable of LaserScan
        Of any number of scanners, ordered by time.
    odometry : Trajectory
    distance_m, angle_rad : float
        A scan is taken once its scanner has moved [m] or turned [rad] this far.
    most_returns : int
        Returns kept of a scan.
    spacing_m : float
        Returns nearer to each other than this are thinned [m].
    losses : LossLedger

    Raises
    ------
    NothingUsableError
        No scan has enough returns within the time of the odometry, or the odometry stands still
        while the scans change.
    """
    driven = odometry.driven_m()
    steps = np.abs(wrapped_angle(np.diff(odometry.pose[:, 2])))
    turned = np.concatenate([np.zeros(min(len(odometry), 1)), np.cumsum(steps)])
    witness = StandstillWitness(odometry)
    last: dict[int, _Place] = {}
    chosen: list[KeyScan] = []
    times: list[int] = []
    for scan in lasers:
        time_ns = scan.middle_ns
        position = interpolated_pose(odometry.time_ns, odometry.pose, time_ns)
        if math.isnan(position[0]):
            losses.add("laser scan without odometry", STAGE, effect="scan not used")
            continue
        times.append(time_ns)
        witness.see(scan)
        place = last.get(scan.scanner)
        if place is not None and not place.has_left(scan, position, distance_m, angle_rad):
            continue
        rays = deskewed_rays(scan, odometry, time_ns)
        if len(rays) < LEAST_RAYS:
            losses.add("laser scan with too few returns", STAGE, effect="scan not used")
            continue
        last[scan.scanner] = _Place(position, time_ns, compared_ranges(scan))
        key = KeyScan(
            time_ns=time_ns,
            scanner=scan.scanner,
            odometry=np.array(position),
            driven_m=float(np.interp(time_ns, odometry.time_ns, driven)),
            turned_rad=float(np.interp(time_ns, odometry.time_ns, turned)),
            **_thinned(rays, most_returns, spacing_m),
        )
        chosen.append(key)
    if not chosen:
        raise NothingUsableError(
            "no laser scan has enough returns at a time that the odometry spans; no map can be "
            "built. `soundmap info` shows what the log holds."
        )
    chosen.sort(key=lambda key: key.time_ns)
    masked, body_returns = without_body(chosen)
    losses.remark(
        "laser return from the robot itself", STAGE, effect="not used", count=body_returns
    )
    return KeyScans(tuple(masked), np.unique(np.array(times, dtype=np.int64)), body_returns)


def without_body(scans: list[KeyScan]) -> tuple[list[KeyScan], int]:
    """The scans less the returns from the robot's own body, and how many those were."""
    masked, removed = list(scans), 0
    for scanner in sorted({scan.scanner for scan in scans}):
        own = [index for index, scan in enumerate(scans) if scan.scanner == scanner]
        way_m = scans[own[-1]].driven_m - scans[own[0]].driven_m
        if len(own) < BODY_LEAST_SCANS or way_m < BODY_LEAST_WAY_M:
            continue
        body = _body_cells([scans[index] for index in own])
        for index in own:
            scan = scans[index]
            keep = ~np.isin(_near_cells(scan), body)
            removed += int(np.count_nonzero(~keep))
            masked[index] = replace(
                scan,
                origin_m=scan.origin_m[keep],
                end_m=scan.end_m[keep],
                normal=scan.normal[keep],
            )
    return [scan for scan in masked if len(scan) >= LEAST_RAYS // 2], removed


def _near_cells(scan: KeyScan) -> NDArray[np.int64]:
    """Cell of the robot's frame that each return lies in; -1 if it is far from the scanner."""
    cell = np.floor(scan.end_m / BODY_CELL_M).astype(np.int64)
    near = np.hypot(*(scan.end_m - scan.origin_m).T) < BODY_REACH_M
    return np.where(near, (cell[:, 0] + 512) * 4096 + cell[:, 1] + 512, -1)


def _body_cells(scans: list[KeyScan]) -> NDArray[np.int64]:
    """Cells that are hit in most scans, with their neighbours."""
    hit = np.concatenate([np.unique(_near_cells(scan)) for scan in scans])
    cells, count = np.unique(hit[hit >= 0], return_counts=True)
    core = cells[count >= BODY_SHARE * len(scans)]
    offsets = np.array([row * 4096 + column for row in (-1, 0, 1) for column in (-1, 0, 1)])
    return np.unique(core[:, None] + offsets)


@dataclass(frozen=True)
class _Place:
    """Where a scanner took its last key scan, when, and what it saw there."""

    position: tuple[float, float, float]
    time_ns: int
    ranges: FloatArray

    def has_left(
        self,
        scan: LaserScan,
        position: tuple[float, float, float],
        distance_m: float,
        angle_rad: float,
    ) -> bool:
        """Whether a scan was taken from elsewhere; odometry that sticks does not hide it."""
        x, y, heading = (now - then for now, then in zip(position, self.position, strict=True))
        way_m, turn_rad = math.hypot(x, y), abs(math.remainder(heading, 2.0 * math.pi))
        if way_m >= distance_m or turn_rad >= angle_rad:
            return True
        at_rest = way_m < STICKS * distance_m and turn_rad < STICKS * angle_rad
        if not at_rest or scan.middle_ns - self.time_ns < LOOK_NS:
            return False
        return has_moved(self.ranges, compared_ranges(scan))


def _thinned(rays: Rays, most: int, spacing_m: float) -> dict[str, Float32Array]:
    """Returns laid on their surfaces, spread over them and ordered by x."""
    normal, point = surface_lines(rays.origin_m, rays.end_m)
    cell = np.floor(point / spacing_m).astype(np.int64)
    _, first = np.unique(cell[:, 0] * 1_000_003 + cell[:, 1], return_index=True)
    kept = np.sort(first)
    if len(kept) > most:
        kept = kept[(np.arange(most) * len(kept) + len(kept) // 2) // most]
    end = point.astype(np.float32)
    kept = kept[strip_order(end[kept])]
    return {
        "origin_m": rays.origin_m[kept].astype(np.float32),
        "end_m": end[kept],
        "normal": normal[kept].astype(np.float32),
    }
