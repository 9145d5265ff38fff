"""Drives through a room of straight walls, with odometry as bad as wanted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from soundmap.geometry import Trajectory, composed, relative, wrapped_angle
from soundmap.losses import LossLedger
from soundmap.mapping.key_scans import KeyScans, chosen_key_scans
from soundmap.sensors import LaserScan

ROUND = [(1, 1), (6, 1), (6, 2.4), (3.5, 2.6), (3.5, 4.2), (1, 4.2), (1, 1.2), (5, 1.2)]


def reported(
    truth: Trajectory, *, scale: float = 1.0, turn_per_metre: float = 0.0, turn_scale: float = 1.0
) -> Trajectory:
    """Odometry with systematic errors: what it reports is false by scale and by turn."""
    step = relative(truth.pose[:-1], truth.pose[1:])
    length = np.hypot(step[:, 0], step[:, 1])
    step = step * np.array([scale, scale, turn_scale])
    step[:, 2] += turn_per_metre * length
    heading = np.concatenate([[0.0], np.cumsum(step[:, 2])])
    cos, sin = np.cos(heading[:-1]), np.sin(heading[:-1])
    moved = np.stack([cos * step[:, 0] - sin * step[:, 1], sin * step[:, 0] + cos * step[:, 1]], -1)
    place = np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)])
    return Trajectory(truth.time_ns, np.column_stack([place, wrapped_angle(heading)]), truth.usable)


def noisy(scans: list[LaserScan], sigma_m: float, seed: int = 3) -> list[LaserScan]:
    rng = np.random.default_rng(seed)
    return [replace(s, range_m=s.range_m + rng.normal(0, sigma_m, len(s.range_m))) for s in scans]


def keys(scans: list[LaserScan], odometry: Trajectory, **options: float) -> KeyScans:
    chosen = {"distance_m": 0.2, "angle_rad": 0.17, "most_returns": 300, "spacing_m": 0.05}
    return chosen_key_scans(scans, odometry, **{**chosen, **options}, losses=LossLedger())


def from_first(truth: Trajectory, time_ns: np.ndarray) -> np.ndarray:
    """True poses at some times, seen from the first of them."""
    pose = truth.at(time_ns)
    return relative(pose[:1], pose)


def errors(pose: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [m] and turn [rad] between poses, both seen from the frame of the first."""
    off = relative(true, composed(np.zeros(3), pose))
    return np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])
