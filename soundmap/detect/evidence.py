"""Evidence: what was heard from where, ready for the fit of sources to all scans of a run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.beam import beam_patterns, turned_beam_patterns
from soundmap.config import ScanConfig
from soundmap.geometry import FloatArray, Trajectory, transformed, wrapped_angle
from soundmap.sensors import MicArray
from soundmap.sound import AudioScans

SLOPES_DB_PER_OCTAVE = (-14.0, -7.0, 0.0, 8.0)
"""Spectral slopes whose beams stand for those of all sounds."""
TURN_STEP_RAD = np.radians(0.5)
GREATEST_TURN_RAD = np.radians(10.0)
REST_M, REST_RAD = 0.04, 0.02
"""Scans taken nearer to each other than this are one."""
MOST_MERGED = 20
LARGEST_WEIGHT = 4.0
"""However long the robot rests, a place counts no more than this many scans."""

Single = NDArray[np.float32]


@dataclass(frozen=True)
class Evidence:
    r"""Audio scans with the pose of the array and the laser ranges around it.

    Attributes
    ----------
    place_m : ndarray, shape (S, 2)
        Centre of the array in the map frame [m].
    axis_rad : ndarray, shape (S,)
        Direction of the array's x axis in the map frame [rad].
    handedness : int
        -1 if the array hangs upside down: its bearings then run clockwise in the map.
    heard : ndarray of float32, shape (S, N)
        :math:`J_n` less its mean over the bearings, times `weight`.
    weight : ndarray, shape (S,)
        One over the scan's mean power, so that a near pass does not outvote the rest.
    merged : ndarray of int, shape (S,)
        Audio scans behind each.
    range_m : ndarray of float32, shape (S, M)
        To the first surface on M bearings of the array [m]; NaN where unknown.
    turn_class : ndarray of int, shape (S,)
        Index of the beams that fit the array's turn during the scan.
    beams : ndarray of float32, shape (slopes, turns, M, N)
        Response less its mean over the bearings.
    """

    place_m: FloatArray
    axis_rad: FloatArray
    handedness: int
    heard: Single
    weight: FloatArray
    merged: NDArray[np.int64]
    range_m: Single
    turn_class: NDArray[np.int64]
    beams: Single

    def __len__(self) -> int:
        return len(self.place_m)


def gathered_evidence(
    scans: AudioScans,
    range_m: Single,
    trajectory: Trajectory,
    array: MicArray,
    config: ScanConfig,
) -> Evidence:
    """The scans with a trusted pose, those at rest merged.

    Diffuse sound is the same on all bearings of an even array: the mean over the bearings is
    taken from data and model alike.

    Parameters
    ----------
    scans : AudioScans
    range_m : ndarray of float32, shape (S, M)
        Laser ranges around the array at each scan, on its bearings 2 pi m / M [m].
    trajectory : Trajectory
    array : MicArray
    config : ScanConfig
    """
    half_ns = round(0.5 * (config.frames - 1) * config.hop_s * 1e9)
    offsets = np.linspace(-half_ns, half_ns, max(config.frames, 2)).astype(np.int64)
    poses = trajectory.at(scans.time_ns[:, None] + offsets)
    trusted = trajectory.usable_at(scans.time_ns) & np.isfinite(poses).all(axis=(1, 2))
    trusted &= np.isfinite(scans.power).all(axis=1) & (scans.power.mean(axis=1) > 0.0)
    chosen = np.flatnonzero(trusted)
    poses = poses[chosen]
    turns = np.unwrap(poses[:, :, 2], axis=1)
    pose = np.column_stack([poses[:, :, :2].mean(axis=1), turns.mean(axis=1)])
    frames = len(offsets)
    turn = np.abs(turns[:, -1] - turns[:, 0]) * frames / (frames - 1)
    turn_class = np.rint(np.minimum(turn, GREATEST_TURN_RAD) / TURN_STEP_RAD).astype(np.int64)
    starts = _rests(pose)
    count = np.diff(np.append(starts, len(pose)))
    power = _means(scans.power[chosen].astype(np.float64), starts, count)
    weight = np.sqrt(np.minimum(count, LARGEST_WEIGHT)) / power.mean(axis=1)
    heard = (power - power.mean(axis=1, keepdims=True)) * weight[:, None]
    pose = np.column_stack([_means(pose[:, :2], starts, count), pose[starts, 2]])
    mount = array.mount
    return Evidence(
        transformed(pose, np.broadcast_to(mount.translation_m[:2], (len(pose), 2))),
        np.asarray(wrapped_angle(pose[:, 2] + mount.yaw_rad)),
        mount.handedness,
        heard.astype(np.float32),
        weight,
        count.astype(np.int64),
        range_m[chosen][starts],
        turn_class[starts],
        _beams(array.positions_m, scans.power.shape[1], range_m.shape[1], config),
    )


def _rests(pose: FloatArray) -> NDArray[np.int64]:
    """First scan of each stretch that was taken from one place."""
    starts: list[int] = []
    for index, (x, y, heading) in enumerate(pose):
        if starts and index - starts[-1] < MOST_MERGED:
            there = pose[starts[-1]]
            moved = np.hypot(x - there[0], y - there[1])
            if moved < REST_M and abs(wrapped_angle(heading - there[2])) < REST_RAD:
                continue
        starts.append(index)
    return np.array(starts, dtype=np.int64)


def _means(values: FloatArray, starts: NDArray[np.int64], count: NDArray[np.int64]) -> FloatArray:
    if not len(starts):
        return values[:0]
    return np.asarray(np.add.reduceat(values, starts, axis=0) / count[:, None])


def _beams(positions_m: FloatArray, bearings: int, waves: int, config: ScanConfig) -> Single:
    turns = np.arange(0.0, GREATEST_TURN_RAD + 0.5 * TURN_STEP_RAD, TURN_STEP_RAD)
    beams = np.empty((len(SLOPES_DB_PER_OCTAVE), len(turns), waves, bearings), dtype=np.float32)
    for index, slope in enumerate(SLOPES_DB_PER_OCTAVE):
        at_rest = beam_patterns(
            positions_m,
            bearings=bearings,
            waves=waves,
            low_hz=config.low_hz,
            high_hz=config.high_hz,
            slope_db_per_octave=slope,
            speed_of_sound_m_s=config.speed_of_sound_m_s,
        )
        at_rest -= at_rest.mean(axis=1, keepdims=True)
        for turn_class, turn in enumerate(turns):
            beams[index, turn_class] = turned_beam_patterns(at_rest, float(turn))
    return beams
