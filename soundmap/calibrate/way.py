"""Where the array stood during each audio scan, if its clock is off by so much."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, Mount, Trajectory, transformed, wrapped_angle

NODES = np.sqrt(0.6) * np.array([-1.0, 0.0, 1.0])
WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0
"""Gauss-Legendre: three poses stand for all of a scan."""
STEP_S = 0.005
APART_M, APART_RAD, APART_NS = 0.04, 0.02, 400_000_000


@dataclass(frozen=True)
class Way:
    """The array in the map frame, mean over each scan.

    Attributes
    ----------
    place_m : ndarray, shape (S, 2)
    axis_rad : ndarray, shape (S,)
        Direction of its x axis, not wrapped within a scan [rad].
    velocity_m_s : ndarray, shape (S, 2)
    turn_rad_s : ndarray, shape (S,)
    """

    place_m: FloatArray
    axis_rad: FloatArray
    velocity_m_s: FloatArray
    turn_rad_s: FloatArray

    def __len__(self) -> int:
        return len(self.place_m)

    def part(self, scans: slice) -> Way:
        """The way over some of the scans."""
        return Way(
            self.place_m[scans],
            self.axis_rad[scans],
            self.velocity_m_s[scans],
            self.turn_rad_s[scans],
        )

    def driven_m(self) -> FloatArray:
        """Way driven up to each scan [m], shape (S,)."""
        step = np.hypot(*np.diff(self.place_m, axis=0).T)
        return np.concatenate([np.zeros(min(len(self), 1)), np.cumsum(step)])


WayAt = Callable[[float], Way]
"""The way of the array over all scans, if its clock is so far behind [s]."""


def array_way(
    trajectory: Trajectory,
    time_ns: NDArray[np.int64],
    mount: Mount,
    *,
    clock_s: float,
    span_s: float,
) -> Way:
    """The way of the array over the scans.

    Parameters
    ----------
    trajectory : Trajectory
        Of the base.
    time_ns : ndarray of int64, shape (S,)
        Middle of each scan by the audio's clock [ns].
    mount : Mount
        Array in the base frame.
    clock_s : float
        What is to be added to the audio's clock [s].
    span_s : float
        Length of a scan [s].
    """
    (before, turn_before), (place, axis), (after, turn_after) = (
        _mean_pose(trajectory, time_ns, mount, shift, span_s)
        for shift in (clock_s - STEP_S, clock_s, clock_s + STEP_S)
    )
    velocity = (after - before) / (2.0 * STEP_S)
    turn = np.asarray(wrapped_angle(turn_after - turn_before)) / (2.0 * STEP_S)
    return Way(place, axis, velocity, turn)


def _mean_pose(
    trajectory: Trajectory,
    time_ns: NDArray[np.int64],
    mount: Mount,
    shift_s: float,
    span_s: float,
) -> tuple[FloatArray, FloatArray]:
    nodes_ns = np.rint((shift_s + 0.5 * span_s * NODES) * 1e9).astype(np.int64)
    pose = trajectory.at(time_ns[:, None] + nodes_ns)
    heading = np.unwrap(pose[..., 2], axis=1) @ WEIGHTS
    centre = np.einsum("snc,n->sc", pose[..., :2], WEIGHTS)
    offset = np.broadcast_to(mount.translation_m[:2], centre.shape)
    place = transformed(np.column_stack([centre, heading]), offset)
    return place, heading + mount.yaw_rad


def moved_apart(way: Way, time_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Scans of which each was taken a little after, beside or turned from the one before."""
    kept: list[int] = []
    for index in range(len(way)):
        if kept:
            last = kept[-1]
            moved = np.hypot(*(way.place_m[index] - way.place_m[last]))
            turned = abs(way.axis_rad[index] - way.axis_rad[last])
            waited = time_ns[index] - time_ns[last]
            if moved < APART_M and turned < APART_RAD and waited < APART_NS:
                continue
        kept.append(index)
    return np.array(kept, dtype=np.int64)
