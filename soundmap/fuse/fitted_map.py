r"""Power map that goes with fitted sources: where it is loud, without the ghosts.

Eq. (3) takes all that arrives on a bearing for what the surface there sends out, and so paints
ghosts on surfaces that merely lie behind a source, beside it or opposite to it. Knowing the
sources, more can be said of a surface d metres away. What it sends out, at 1 m, is at most

.. math:: U = \max(J_n - E_n, \epsilon J_n) \, d^2

where :math:`E_n` is what the sources and their mirror images make on that bearing, and
:math:`\epsilon` the share of it that no model explains better. Every scan that saw the surface
sets such a limit. A true source fulfils them all; a ghost is refuted from elsewhere. The harmonic
mean of the limits, which the low ones rule, is the level of a cell, unless a source stands there:
then it is that source's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soundmap.beam import beam_patterns
from soundmap.config import FuseConfig, ScanConfig
from soundmap.geometry import FloatArray, Trajectory, transformed
from soundmap.grid import GridFrame
from soundmap.sensors import MicArray
from soundmap.sound import AudioScans, PowerMap, Source, SourceList

MOST_SCANS = 1200
"""More, evenly spread, would show the same."""
UNEXPLAINED_SHARE = 0.03
SPOT_M = 0.1
"""Least standard deviation of the spot that a source gets: a machine, not a point [m]."""
SPOT_REACH = 3.0
"""Where a spot ends, in standard deviations."""
HEIGHT_M, NEAREST_M = 0.3, 0.4
"""Height between source and array, and least distance, that are assumed [m]."""
IN_FRONT_M = 0.35
"""A source is heard up to this far behind the surface on its bearing [m]."""
UNKNOWN_SPREAD = 0.25
"""Standard error of a source's power where the run does not tell it, as a share of it."""
WAVES, FREQUENCIES = 360, 16


def fitted_power_map(
    sources: SourceList,
    scans: AudioScans,
    around: NDArray[np.float32],
    trajectory: Trajectory,
    array: MicArray,
    frame: GridFrame,
    scan: ScanConfig,
    fuse: FuseConfig,
) -> PowerMap:
    """Levels at 1 m of all that a run saw: those of its sources, and limits for the rest.

    Parameters
    ----------
    sources : SourceList
        Of a fit.
    scans : AudioScans
    around : ndarray, shape (S, M)
        Ranges to the first surface at each scan, on the array's bearings 2 pi m / M [m]; only those
        of `mapped_scans` are looked at.
    trajectory : Trajectory
    array : MicArray
    frame : GridFrame
        Of the map.
    scan : ScanConfig
    fuse : FuseConfig
        Its ranges say how near and how far a surface counts.

    Returns
    -------
    PowerMap
        Powers are mean squares at 1 m [linear]; a visit is a scan that tells of the cell.
    """
    use = mapped_scans(scans, trajectory)
    power, pose = scans.power[use].astype(np.float64), trajectory.at(scans.time_ns[use])
    bearing = 2.0 * np.pi * np.arange(power.shape[1]) / power.shape[1]
    ranges = _on_bearings(around[use], bearing)
    explained = _explained(sources, pose, around[use], array, power.shape[1], scan)
    rest = power - explained
    rest -= np.median(rest, axis=1, keepdims=True)  # what comes from everywhere
    rest = np.maximum(rest, UNEXPLAINED_SHARE * power)
    seen = (ranges >= fuse.d_min_m) & (ranges <= fuse.d_max_m)
    point = transformed(pose[:, None], array.mount.base_points(bearing, ranges))[seen]
    size = 2.0 * np.pi / len(bearing) * ranges[seen]
    limits = _Limits(frame, point, rest[seen] * ranges[seen] ** 2, size)
    return _with_sources(limits, frame, sources)


def mapped_scans(scans: AudioScans, trajectory: Trajectory) -> NDArray[np.int64]:
    """Which scans make the map."""
    use = np.flatnonzero(trajectory.usable_at(scans.time_ns) & np.isfinite(scans.power).all(axis=1))
    return use[np.linspace(0, len(use) - 1, min(MOST_SCANS, len(use))).astype(np.int64)]


def _on_bearings(around: NDArray[np.float32], bearing_rad: FloatArray) -> FloatArray:
    """Ranges on other bearings than they are kept on: those of the nearest, shape (S, N)."""
    index = np.rint(bearing_rad / (2.0 * np.pi) * around.shape[1]).astype(np.int64)
    return around[:, index % around.shape[1]].astype(np.float64)


def _explained(
    sources: SourceList,
    pose: FloatArray,
    around: NDArray[np.float32],
    array: MicArray,
    bearings: int,
    scan: ScanConfig,
) -> FloatArray:
    """What sources and mirror images make on every bearing, shape (S, N) [linear]."""
    total = np.zeros((len(pose), bearings))
    if not len(sources):
        return total
    beams = beam_patterns(
        array.positions_m,
        bearings=bearings,
        waves=WAVES,
        frequency_hz=np.linspace(scan.low_hz, scan.high_hz, FREQUENCIES),
        speed_of_sound_m_s=scan.speed_of_sound_m_s,
    )
    mount = array.mount
    stand = transformed(pose, np.broadcast_to(mount.translation_m[:2], (len(pose), 2)))
    axis = pose[:, 2] + mount.yaw_rad
    direct = [(source.x_m, source.y_m, source.power, False) for source in sources]
    images = [(image.x_m, image.y_m, image.power, True) for image in sources.reflections]
    for x, y, strength, is_image in direct + images:
        dx, dy = x - stand[:, 0], y - stand[:, 1]
        distance = np.hypot(dx, dy)
        wave = mount.handedness * (np.arctan2(dy, dx) - axis) / (2.0 * np.pi) % 1.0
        column = np.rint(wave * around.shape[1]).astype(np.int64) % around.shape[1]
        hidden = distance > around[np.arange(len(pose)), column] + IN_FRONT_M
        gain = strength / (np.maximum(distance, NEAREST_M) ** 2 + HEIGHT_M**2)
        gain = np.where(hidden & (not is_image), 0.0, gain)
        total += gain[:, None] * beams[np.rint(wave * WAVES).astype(np.int64) % WAVES]
    return total


class _Limits:
    """Harmonic mean of the limits of each cell, how they scatter, and how many there are.

    Each limit holds for the disc that its beam is wide, as in Eqs. (4)-(5).
    """

    def __init__(
        self, frame: GridFrame, point_m: FloatArray, limit: FloatArray, size_m: FloatArray
    ) -> None:
        cells = frame.cells(point_m)
        radius = np.maximum(0.5 * size_m / frame.resolution_m, 0.0)
        reach = int(radius.max(initial=0.0))
        sums = np.zeros((4, frame.shape[0] * frame.shape[1]))
        with np.errstate(divide="ignore"):
            weights = (np.ones_like(limit), 1.0 / limit, limit, limit**2)
        for down in range(-reach, reach + 1):
            for right in range(-reach, reach + 1):
                there = cells + np.array([down, right])
                reached = down**2 + right**2 <= radius**2 + 1e-9
                reached &= frame.contains(there)
                index = there[reached, 0] * frame.shape[1] + there[reached, 1]
                for total, weight in zip(sums, weights, strict=True):
                    total += np.bincount(index, weight[reached], minlength=len(total))
        visits, inverse, linear, squares = sums.reshape(4, *frame.shape)
        many = np.maximum(visits, 1.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            self.power = np.where(visits > 0, many / inverse, 0.0)
            spread = np.sqrt(np.maximum(squares / many - (linear / many) ** 2, 0.0))
            self.spread = np.where(linear > 0, spread / (linear / many), 0.0)
        self.visits = visits.astype(np.int64)


def _with_sources(limits: _Limits, frame: GridFrame, sources: SourceList) -> PowerMap:
    """The map of limits with a spot at each source, as large as its place is uncertain."""
    power, visits, spread = limits.power.copy(), limits.visits.copy(), limits.spread.copy()
    is_limit = np.ones(frame.shape, dtype=bool)
    most = max(int(visits.max(initial=0)), 1)
    for source in reversed(sources.sources):
        rows, columns, share = _spot(frame, source)
        here = (rows, columns)
        level = source.power * share
        error_db = None if source.fit is None else source.fit.level_sigma_db
        relative = UNKNOWN_SPREAD if error_db is None else error_db * np.log(10.0) / 10.0
        rules = level >= power[here]
        spread[here] = np.where(rules, relative * np.sqrt(visits[here]), spread[here])
        is_limit[here] &= ~rules
        power[here] = np.where(rules, level, power[here])
        visits[here] = np.maximum(visits[here], np.where(rules, min(source.visits, most), 0))
    squares = power**2 * visits * (1.0 + spread**2)
    return PowerMap(frame, power * visits, visits, sources.reference, squares, is_limit)


def _spot(
    frame: GridFrame, source: Source
) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]:
    """Cells round a source, rows and columns, and how near to it each is: 1 where it stands."""
    covariance = SPOT_M**2 * np.eye(2)
    if source.fit is not None:
        covariance = covariance + source.fit.covariance_m2
    reach = SPOT_REACH * np.sqrt(np.diag(covariance))
    place = np.array([source.x_m, source.y_m])
    low, high = frame.cells(place - reach), frame.cells(place + reach)
    low, high = np.maximum(low, 0), np.minimum(high, np.array(frame.shape) - 1)
    rows, columns = (np.arange(first, last + 1) for first, last in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2)
    step = frame.centres(grid) - place
    squared = np.einsum("ci,ij,cj->c", step, np.linalg.inv(covariance), step)
    grid, squared = grid[squared <= SPOT_REACH**2], squared[squared <= SPOT_REACH**2]
    return grid[:, 0], grid[:, 1], np.exp(-0.5 * squared)
