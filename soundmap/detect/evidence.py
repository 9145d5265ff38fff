"""Evidence: what was heard from where, ready for the fit of sources to all scans of a run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.config import ScanConfig
from soundmap.detect.harmonics import BeamTable, Single, beam_table
from soundmap.geometry import FloatArray, Trajectory, transformed, wrapped_angle
from soundmap.sensors import MicArray
from soundmap.sound import AudioScans

RELATIVE_NOISE = 0.28
"""Standard deviation of what no source explains in a scan, over the scan's mean power: chance of
averaging few frames, and sound that interferes with its own reflections."""
REST_M, REST_RAD = 0.04, 0.02
"""Consecutive scans taken nearer to each other than this are one."""
MOST_MERGED = 20
LARGEST_WEIGHT = 4.0
"""However long the robot rests, a place counts no more than this many scans."""
LONG_RUN_SCANS = 1200
"""Of longer runs, no more than some scans of nearly the same pose are used, ..."""
SAME_M, SAME_RAD = 0.12, np.radians(10.0)
MOST_LOOKS = (16, 8, 4, 2)
"""... of these numbers the greatest that leaves no more than that many, if any does. They are not
merged: the fit knows how single scans scatter, not how their means do."""
GOLDEN_SHARE = 0.6180339887498949
LOUDNESS_SCANS = 7
"""The noise of a scan goes by the mean power of so many scans around it: going by its own, scans
that chance or interference makes loud would count less, and all levels would come out low."""
SCANS_AT_ONCE = 4000
MOST_TURN_RAD = np.radians(12.0)
VELOCITY_STEP_NS = 25_000_000


@dataclass(frozen=True)
class Evidence:
    r"""Audio scans with the pose of the array and the laser ranges around it.

    Attributes
    ----------
    time_s : ndarray, shape (S,)
        When each was taken, since the first [s].
    place_m : ndarray, shape (S, 2)
        Centre of the array in the map frame [m].
    axis_rad : ndarray, shape (S,)
        Direction of the array's x axis in the map frame [rad].
    handedness : int
        -1 if the array hangs upside down: its bearings then run clockwise in the map.
    height_m : float
        Of the array over the origin of the base, which is on the floor [m].
    turn_rad : ndarray, shape (S,)
        How far the array turned during the scan [rad], >= 0.
    merged : ndarray of int, shape (S,)
        Audio scans behind each.
    range_m : ndarray of float32, shape (S, M)
        To the first surface on M bearings of the array [m]; NaN where unknown.
    heard : ndarray of float32, shape (S, D)
        Evened-out harmonics of :math:`J_n`, times `weight`: in units of the noise.
    weight : ndarray, shape (S, B)
        One over the noise of each sub-band.
    table : BeamTable
    """

    time_s: FloatArray
    place_m: FloatArray
    axis_rad: FloatArray
    handedness: int
    height_m: float
    turn_rad: FloatArray
    merged: NDArray[np.int64]
    range_m: Single
    heard: Single
    weight: FloatArray
    table: BeamTable

    def __len__(self) -> int:
        return len(self.place_m)

    @property
    def sub_bands(self) -> int:
        """B, parts of the band that are told apart."""
        return self.weight.shape[1]

    def chosen(self, scans: NDArray[np.int64]) -> Evidence:
        """Some of the scans."""
        return Evidence(
            self.time_s[scans],
            self.place_m[scans],
            self.axis_rad[scans],
            self.handedness,
            self.height_m,
            self.turn_rad[scans],
            self.merged[scans],
            self.range_m[scans],
            self.heard[scans],
            self.weight[scans],
            self.table,
        )


def gathered_evidence(
    scans: AudioScans,
    range_m: Single,
    trajectory: Trajectory,
    array: MicArray,
    config: ScanConfig,
) -> Evidence:
    """The scans with a trusted pose, those from the same pose merged.

    Diffuse sound is the same on all bearings of an even array: the mean over the bearings tells
    nothing of places and is left out.

    Parameters
    ----------
    scans : AudioScans
    range_m : ndarray of float32, shape (S, M)
        Laser ranges around the array at each scan, on its bearings 2 pi m / M [m]; only those of
        `ranged_scans` are looked at.
    trajectory : Trajectory
    array : MicArray
    config : ScanConfig
    """
    from scipy.ndimage import uniform_filter1d

    parts, edges_hz = _sub_bands(scans, config)
    stands = _stands(scans, trajectory, array, config)
    chosen, place, axis, group = stands.scan, stands.place_m, stands.axis_rad, stands.group
    first, count = _firsts(group)
    table = beam_table(
        array,
        edges_hz,
        bearings=scans.power.shape[1],
        waves=range_m.shape[1],
        speed_of_sound_m_s=config.speed_of_sound_m_s,
    )
    heard = np.zeros((len(count), table.beams.shape[2]))
    mean = np.empty((len(chosen), parts.shape[1]))
    for start in range(0, len(chosen), SCANS_AT_ONCE):
        block = slice(start, start + SCANS_AT_ONCE)
        some = parts[chosen[block]]
        mean[block] = some.mean(axis=2, dtype=np.float64)
        np.add.at(heard, group[block], table.harmonics(some))
    heard /= count[:, None]
    weight = np.sqrt(np.minimum(count, LARGEST_WEIGHT))[:, None]
    loudness = uniform_filter1d(_means(mean, group, count), LOUDNESS_SCANS, axis=0, mode="nearest")
    weight = weight / (RELATIVE_NOISE * loudness)
    time_s = np.asarray((scans.time_ns[chosen] - scans.time_ns[:1]) * 1e-9, dtype=np.float64)
    return Evidence(
        _means(time_s, group, count),
        _means(place, group, count),
        axis[first] + _means(wrapped_angle(axis - axis[first][group]), group, count),
        array.mount.handedness,
        float(array.mount.translation_m[2]),
        np.minimum(stands.turn_rad[first], MOST_TURN_RAD),
        count,
        range_m[chosen[first]],
        (heard * weight[:, table.part]).astype(np.float32),
        weight,
        table,
    )


def ranged_scans(
    scans: AudioScans, trajectory: Trajectory, array: MicArray, config: ScanConfig
) -> NDArray[np.int64]:
    """Which scans `gathered_evidence` needs laser ranges of: of a long run, by far not all."""
    stands = _stands(scans, trajectory, array, config)
    return stands.scan[_firsts(stands.group)[0]]


def velocities(
    scans: AudioScans, trajectory: Trajectory, array: MicArray, config: ScanConfig
) -> FloatArray:
    """How fast the array moved at each scan of `gathered_evidence`.

    Returns
    -------
    ndarray, shape (S, 3)
        Velocity in the map frame [m/s] and turn rate [rad/s], means over merged scans.
    """
    stands = _stands(scans, trajectory, array, config)
    time_ns = scans.time_ns[stands.scan]
    before, after = (
        _placed(trajectory.at(time_ns + side * VELOCITY_STEP_NS), array) for side in (-1, 1)
    )
    step = after - before
    step[:, 2] = wrapped_angle(step[:, 2])
    rate = np.nan_to_num(step / (2e-9 * VELOCITY_STEP_NS))
    return _means(rate, stands.group, _firsts(stands.group)[1])


def _placed(base: FloatArray, array: MicArray) -> FloatArray:
    """Place of the array and direction of its x axis, shape (T, 3), for poses of the base."""
    offset = np.broadcast_to(array.mount.translation_m[:2], (len(base), 2))
    return np.column_stack([transformed(base, offset), base[:, 2] + array.mount.yaw_rad])


@dataclass(frozen=True)
class _Stands:
    """The T scans to be used: index, pose of the array, turn during the scan, and group.

    Scans of a group were taken from one pose.
    """

    scan: NDArray[np.int64]
    place_m: FloatArray
    axis_rad: FloatArray
    turn_rad: FloatArray
    group: NDArray[np.int64]


def _sub_bands(
    scans: AudioScans, config: ScanConfig
) -> tuple[NDArray[np.float32], tuple[float, ...]]:
    """Power of each part of the band, shape (S, B, N), and the edges of the parts [Hz]."""
    if scans.sub_bands is None:
        return scans.power[:, None], (config.low_hz, config.high_hz)
    return scans.sub_bands, scans.sub_band_hz


def _stands(
    scans: AudioScans, trajectory: Trajectory, array: MicArray, config: ScanConfig
) -> _Stands:
    """Which scans to use, and where they were taken."""
    some = [  # not all at once: each has a pose for each of its frames
        _bases(scans, slice(start, start + SCANS_AT_ONCE), trajectory, config)
        for start in range(0, max(len(scans), 1), SCANS_AT_ONCE)
    ]
    chosen, base, turn = (np.concatenate(each) for each in zip(*some, strict=True))
    placed = _placed(base, array)
    place, axis = placed[:, :2], np.asarray(wrapped_angle(placed[:, 2]))
    group = _rests(place, axis)
    if len(group) and group[-1] >= LONG_RUN_SCANS:
        kept = _seldom_seen(place, axis, group)
        chosen, place, axis, turn = chosen[kept], place[kept], axis[kept], turn[kept]
        group = np.unique(group[kept], return_inverse=True)[1].astype(np.int64)
    return _Stands(chosen, place, axis, turn, group)


def _bases(
    scans: AudioScans, some: slice, trajectory: Trajectory, config: ScanConfig
) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """Which of some scans are sound and have a trusted pose; this pose (3,), and their turn."""
    time_ns, parts = scans.time_ns[some], _sub_bands(scans, config)[0][some]
    half_ns = round(0.5 * (config.frames - 1) * config.hop_s * 1e9)
    offsets = np.linspace(-half_ns, half_ns, max(config.frames, 2)).astype(np.int64)
    poses = trajectory.at(time_ns[:, None] + offsets)
    trusted = trajectory.usable_at(time_ns) & np.isfinite(poses).all(axis=(1, 2))
    trusted &= np.isfinite(parts).all(axis=(1, 2)) & (parts.mean(axis=2) > 0.0).all(axis=1)
    chosen = np.flatnonzero(trusted)
    poses = poses[chosen]
    turns = np.unwrap(poses[:, :, 2], axis=1)
    frames = len(offsets)
    turn = np.abs(turns[:, -1] - turns[:, 0]) * frames / (frames - 1)
    base = np.column_stack([poses[:, :, :2].mean(axis=1), turns.mean(axis=1)])
    return some.start + chosen, base, turn


def _rests(place_m: FloatArray, axis_rad: FloatArray) -> NDArray[np.int64]:
    """For each scan the stretch of scans taken from one pose that it belongs to."""
    group = np.zeros(len(place_m), dtype=np.int64)
    start = 0
    for index in range(1, len(place_m)):
        moved = np.hypot(*(place_m[index] - place_m[start]))
        turned = abs(wrapped_angle(axis_rad[index] - axis_rad[start]))
        same = moved < REST_M and turned < REST_RAD and index - start < MOST_MERGED
        group[index] = group[index - 1] + (not same)
        start = start if same else index
    return group


def _seldom_seen(
    place_m: FloatArray, axis_rad: FloatArray, group: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Which scans to use of a long run: those of some groups from each pose, evenly in time."""
    first, _ = _firsts(group)
    cell = np.column_stack(
        [
            np.floor(place_m[first] / SAME_M),
            np.floor(np.asarray(wrapped_angle(axis_rad[first])) / SAME_RAD),
        ]
    )
    _, pose, looks = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    pose = pose.ravel()
    order = np.argsort(pose, kind="stable")
    number = np.empty(len(pose), dtype=np.int64)  # of a look among those from its pose
    number[order] = np.arange(len(pose)) - np.repeat(np.cumsum(looks) - looks, looks)
    for most in MOST_LOOKS:
        wanted = np.minimum(looks, most)
        if wanted.sum() <= LONG_RUN_SCANS:
            break
    share = (wanted / looks)[pose]
    begin = pose * GOLDEN_SHARE % 1.0  # not the same laps everywhere
    used = np.floor((number + 1) * share + begin) > np.floor(number * share + begin)
    return np.asarray(used[group])


def _firsts(group: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First member and size of each group."""
    _, first, count = np.unique(group, return_index=True, return_counts=True)
    return first.astype(np.int64), count.astype(np.int64)


def _means(values: FloatArray, group: NDArray[np.int64], count: NDArray[np.int64]) -> FloatArray:
    """Mean of the values (K, ...) of each group."""
    total = np.zeros((len(count), *values.shape[1:]))
    np.add.at(total, group, values)
    return np.asarray(total / count.reshape(-1, *[1] * (values.ndim - 1)))
