"""Path: where the robot truly is at every moment, from a handful of way points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from soundmap.geometry import FloatArray, wrapped_angle

STEP_S = 0.001
"""Poses are kept this densely and interpolated between: at 1 m/s2 an error of 0.1 um."""
ARC_STEP_M = 0.001
EASE_M = 0.12
"""Way over which the curvature of a turn builds up, so that the turn rate has no jumps."""
SHARPEST_TURN_RAD = np.radians(150.0)
"""Beyond this a way point is not rounded: the robot stops and turns on the spot."""


@dataclass(frozen=True)
class Motion:
    """True motion of the base, evenly sampled.

    Attributes
    ----------
    step_s : float
        Time between samples [s]; the first is at time 0.
    pose : ndarray, shape (K, 3)
        x [m], y [m], heading [rad] in the map frame; the heading is continuous, not wrapped.
    """

    step_s: float
    pose: FloatArray

    @property
    def duration_s(self) -> float:
        """Time of the last sample [s]."""
        return self.step_s * (len(self.pose) - 1)

    def at(self, time_s: ArrayLike) -> FloatArray:
        """Poses at any times, shape (..., 3); at rest before the start and after the end."""
        time = np.asarray(time_s, dtype=np.float64) / self.step_s
        place = np.clip(time, 0.0, len(self.pose) - 1)
        left = np.minimum(place.astype(np.int64), max(len(self.pose) - 2, 0))
        right = np.minimum(left + 1, len(self.pose) - 1)
        share = (place - left)[..., None]
        return np.asarray(self.pose[left] * (1.0 - share) + self.pose[right] * share)

    def speed_at(self, time_s: ArrayLike) -> FloatArray:
        """Speed along the path at any times [m/s], shape (...)."""
        time = np.asarray(time_s, dtype=np.float64)
        ahead, behind = self.at(time + 0.005), self.at(time - 0.005)
        return np.asarray(np.hypot(*np.moveaxis(ahead - behind, -1, 0)[:2]) / 0.01)


def driven(
    way_points_m: Sequence[tuple[float, float]],
    *,
    speed_m_s: float,
    acceleration_m_s2: float,
    turn_radius_m: float,
    turn_rate_rad_s: float,
    rest_s: float,
    heading_rad: float | None = None,
) -> Motion:
    """Motion of a differential drive along way points, at rest at the start and at the end.

    Turns are rounded with ``turn_radius_m`` (less where the legs are short) and driven no faster
    than ``turn_rate_rad_s`` allows. Where the way nearly doubles back, and where the robot does
    not face its first leg, it turns on the spot.

    Raises
    ------
    ValueError
        There is no way point.
    """
    if not len(way_points_m):
        raise ValueError("a path needs a way point")
    corners = _distinct(np.array(way_points_m, dtype=np.float64))
    legs = np.diff(corners, axis=0)
    first = float(np.arctan2(legs[0, 1], legs[0, 0])) if len(legs) else 0.0
    heading = first if heading_rad is None else heading_rad
    pose = np.array([*corners[0], heading])
    parts = [np.repeat(pose[None], round(rest_s / STEP_S) + 1, axis=0)]
    for stretch in _stretches(corners):
        leg = stretch[1] - stretch[0]
        turn = float(wrapped_angle(np.arctan2(leg[1], leg[0]) - pose[2]))
        parts.append(_turned(pose, turn, turn_rate_rad_s, 2.0 * turn_rate_rad_s))
        pose = parts[-1][-1] if len(parts[-1]) else pose
        parts.append(
            _followed(pose, stretch, speed_m_s, acceleration_m_s2, turn_radius_m, turn_rate_rad_s)
        )
        pose = parts[-1][-1]
    parts.append(np.repeat(pose[None], round(rest_s / STEP_S), axis=0))
    return Motion(STEP_S, np.concatenate(parts))


def walked(
    way_points_m: Sequence[tuple[float, float]], *, speed_m_s: float, time_s: ArrayLike
) -> FloatArray:
    """Pose, shape (..., 3), of someone who goes to and fro along way points at constant speed."""
    corners = np.array(way_points_m, dtype=np.float64)
    lengths = np.hypot(*np.diff(corners, axis=0).T) if len(corners) > 1 else np.zeros(0)
    total = float(np.sum(lengths))
    time = np.asarray(time_s, dtype=np.float64)
    if total == 0.0:
        return np.broadcast_to(np.array([*corners[0], 0.0]), (*time.shape, 3)).copy()
    phase = (time * speed_m_s) % (2.0 * total)
    back = phase > total
    way = np.where(back, 2.0 * total - phase, phase)
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    leg = np.clip(np.searchsorted(at, way, side="right") - 1, 0, len(lengths) - 1)
    direction = np.diff(corners, axis=0)
    heading = np.arctan2(direction[:, 1], direction[:, 0])[leg] + np.where(back, np.pi, 0.0)
    x, y = np.interp(way, at, corners[:, 0]), np.interp(way, at, corners[:, 1])
    return np.stack([x, y, heading], axis=-1)


def _distinct(corners: FloatArray) -> FloatArray:
    keep = np.ones(len(corners), dtype=bool)
    keep[1:] = np.hypot(*np.diff(corners, axis=0).T) > 1e-6
    return corners[keep]


def _stretches(corners: FloatArray) -> list[FloatArray]:
    """The way cut where the robot must stop and turn on the spot."""
    if len(corners) < 2:
        return []
    legs = np.diff(corners, axis=0)
    heading = np.arctan2(legs[:, 1], legs[:, 0])
    turns = np.abs(wrapped_angle(np.diff(heading)))
    cuts = [0, *(np.flatnonzero(turns > SHARPEST_TURN_RAD) + 1).tolist(), len(corners) - 1]
    return [corners[a : b + 1] for a, b in pairwise(cuts)]


def _turned(pose: FloatArray, turn: float, rate: float, acceleration: float) -> FloatArray:
    """Poses while turning on the spot, without the first; none if there is nothing to turn."""
    if abs(turn) < 1e-6:
        return np.zeros((0, 3))
    angle = _eased_way(abs(turn), np.full(2, rate), np.array([0.0, abs(turn)]), acceleration)
    poses = np.repeat(pose[None], len(angle), axis=0)
    poses[:, 2] += np.sign(turn) * angle
    return poses


def _followed(
    pose: FloatArray,
    corners: FloatArray,
    speed: float,
    acceleration: float,
    radius: float,
    rate: float,
) -> FloatArray:
    """Poses while driving a rounded stretch, without the first."""
    curvature = _curvature(corners, radius)
    way = np.linspace(0.0, ARC_STEP_M * len(curvature), len(curvature) + 1)
    middle = pose[2] + ARC_STEP_M * (np.cumsum(curvature) - 0.5 * curvature)
    heading = pose[2] + ARC_STEP_M * np.concatenate([[0.0], np.cumsum(curvature)])
    x = pose[0] + ARC_STEP_M * np.concatenate([[0.0], np.cumsum(np.cos(middle))])
    y = pose[1] + ARC_STEP_M * np.concatenate([[0.0], np.cumsum(np.sin(middle))])
    bend = np.abs(np.append(curvature, 0.0))
    limit = np.asarray(np.minimum(speed, rate / np.maximum(bend, 1e-9)), dtype=np.float64)
    done = _eased_way(way[-1], limit, way, acceleration)
    return np.stack([np.interp(done, way, column) for column in (x, y, heading)], axis=-1)


def _curvature(corners: FloatArray, radius: float) -> FloatArray:
    """Curvature [1/m] at every `ARC_STEP_M` of a polyline with rounded, eased corners."""
    legs = np.diff(corners, axis=0)
    lengths = np.hypot(*legs.T)
    turns = wrapped_angle(np.diff(np.arctan2(legs[:, 1], legs[:, 0])))
    cut = np.zeros(len(turns))
    for i, turn in enumerate(turns):
        room = 0.5 * min(lengths[i], lengths[i + 1]) * 0.98
        cut[i] = min(radius * np.tan(0.5 * abs(turn)), room)
    arcs = [
        (float(turn), float(c / np.tan(0.5 * abs(turn))) if abs(turn) > 1e-9 else 0.0)
        for turn, c in zip(turns, cut, strict=True)
    ]
    pieces = []
    for i, length in enumerate(lengths):
        before = cut[i - 1] if i > 0 else 0.0
        after = cut[i] if i < len(cut) else 0.0
        pieces.append((length - before - after, 0.0))
        if i < len(arcs) and arcs[i][1] > 0.0:
            turn, bend_radius = arcs[i]
            pieces.append((abs(turn) * bend_radius, np.sign(turn) / bend_radius))
    # The turning angle is kept exactly: it is interpolated, not the curvature.
    ends = np.concatenate([[0.0], np.cumsum([length for length, _ in pieces])])
    angle = np.concatenate([[0.0], np.cumsum([length * bend for length, bend in pieces])])
    steps = max(int(np.ceil(ends[-1] / ARC_STEP_M)), 1)
    at = np.minimum(ARC_STEP_M * np.arange(steps + 1), ends[-1])
    curvature = np.diff(np.interp(at, ends, angle)) / ARC_STEP_M
    window = max(round(EASE_M / ARC_STEP_M), 1)
    return np.convolve(curvature, np.full(window, 1.0 / window), mode="same")


def _eased_way(
    total: float, limit: FloatArray, limit_at: FloatArray, acceleration: float
) -> FloatArray:
    """Way done [m or rad] at every `STEP_S` after the start, from rest to rest.

    The speed keeps to ``limit`` (given at the ways ``limit_at``) and changes no faster than
    ``acceleration``.
    """
    count = max(int(np.ceil(total / ARC_STEP_M)), 2)
    way = np.linspace(0.0, total, count + 1)
    square = np.interp(way, limit_at, limit) ** 2
    gain = 2.0 * acceleration * way[1]
    square[0] = square[-1] = 0.0
    for i in range(1, count + 1):
        square[i] = min(square[i], square[i - 1] + gain)
    for i in range(count - 1, -1, -1):
        square[i] = min(square[i], square[i + 1] + gain)
    speed = np.sqrt(square)
    time = np.concatenate([[0.0], np.cumsum(2.0 * np.diff(way) / (speed[1:] + speed[:-1]))])
    steps = int(np.ceil(time[-1] / STEP_S))
    wanted = np.minimum(STEP_S * np.arange(1, steps + 1), time[-1])
    left = np.clip(np.searchsorted(time, wanted, side="right") - 1, 0, count - 1)
    since = wanted - time[left]
    change = (square[left + 1] - square[left]) / (2.0 * way[1])
    return np.asarray(way[left] + (speed[left] + 0.5 * change * since) * since)
