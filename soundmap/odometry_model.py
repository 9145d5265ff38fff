"""How far odometry may be trusted, and what the finished map says about that."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, wrapped_angle

FLOOR_M = 0.003
FLOOR_RAD = np.radians(0.15)
"""Least standard deviation of any step: sampling of the odometry, timing."""
LEAST_STEPS = 20
"""Fewer steps say nothing about the odometry."""


@dataclass(frozen=True)
class OdometryModel:
    """Systematic and random errors of odometry.

    Attributes
    ----------
    distance_scale, turn_scale : float
        True distance (turn) by reported one.
    turn_per_metre : float
        True turn that goes unreported [rad/m].
    noise_distance_per_metre, noise_turn_per_metre, noise_turn_per_turn : float
        Standard deviation of a step by its length [m/m], [rad/m] and its turn [rad/rad].
    """

    distance_scale: float = 1.0
    turn_scale: float = 1.0
    turn_per_metre: float = 0.0
    noise_distance_per_metre: float = 0.10
    noise_turn_per_metre: float = 0.05
    noise_turn_per_turn: float = 0.10

    def __str__(self) -> str:
        return (
            f"distance x {self.distance_scale:.3f}, turn x {self.turn_scale:.3f}, "
            f"{np.degrees(self.turn_per_metre):+.2f} degrees a metre"
        )

    def corrected(self, step: FloatArray) -> FloatArray:
        """Steps as driven, from steps as reported, shapes (..., 3)."""
        length = np.hypot(step[..., 0], step[..., 1])
        turn = self.turn_scale * step[..., 2] + self.turn_per_metre * length
        # The step bends by half of what the heading changes more than reported.
        bend = 0.5 * (turn - step[..., 2])
        x, y = self.distance_scale * step[..., 0], self.distance_scale * step[..., 1]
        cos, sin = np.cos(bend), np.sin(bend)
        return np.stack([cos * x - sin * y, sin * x + cos * y, wrapped_angle(turn)], axis=-1)

    def sigma(self, driven_m: FloatArray, turned_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Standard deviations of steps, of place [m] and heading [rad].

        Parameters
        ----------
        driven_m, turned_rad : ndarray, shape (...)
            Way and angle of the steps, back and forth added up.
        """
        along = np.hypot(FLOOR_M, self.noise_distance_per_metre * np.asarray(driven_m))
        turn = np.hypot(
            self.noise_turn_per_metre * np.asarray(driven_m),
            self.noise_turn_per_turn * np.asarray(turned_rad),
        )
        return along, np.hypot(FLOOR_RAD, turn)

    def information(self, driven_m: FloatArray, turned_rad: FloatArray) -> FloatArray:
        """Information matrices of steps, shape (..., 3, 3)."""
        along, turn = self.sigma(driven_m, turned_rad)
        information = np.zeros((*np.shape(along), 3, 3))
        information[..., 0, 0] = information[..., 1, 1] = along**-2.0
        information[..., 2, 2] = turn**-2.0
        return information


def fitted_odometry(
    reported: FloatArray, driven: FloatArray, start: OdometryModel
) -> OdometryModel:
    """Errors of odometry from its steps and those of a better trajectory.

    Parameters
    ----------
    reported, driven : ndarray, shapes (S, 3)
        The same steps by odometry and by the better trajectory.
    start : OdometryModel
        Returned where the steps are too few, or of one kind only.
    """
    length = np.hypot(reported[:, 0], reported[:, 1])
    moving = length > 0.02
    if np.count_nonzero(moving) < LEAST_STEPS:
        return start
    along = np.sum(reported[:, :2] * driven[:, :2], axis=1)[moving] / length[moving]
    scale = _weighted_median(along / length[moving], length[moving])
    unreported = wrapped_angle(driven[:, 2] - reported[:, 2])
    extra, per_metre = _robust_line(np.stack([reported[:, 2], length], axis=-1), unreported)
    fitted = OdometryModel(scale, 1.0 + extra, per_metre)
    corrected = fitted.corrected(reported)
    rest = driven - corrected
    per_length = np.hypot(rest[:, 0], rest[:, 1])[moving] / np.sqrt(length[moving] * 0.2)
    heading = np.abs(wrapped_angle(rest[:, 2]))
    angle = np.abs(reported[:, 2])
    return OdometryModel(
        scale,
        1.0 + extra,
        per_metre,
        noise_distance_per_metre=_bounded(1.2 * float(np.median(per_length)) / 0.2, 0.01, 0.2),
        noise_turn_per_metre=_bounded(_noise(heading, length, angle < 0.05), 0.005, 0.1),
        noise_turn_per_turn=_bounded(_noise(heading, angle, angle >= 0.05), 0.01, 0.2),
    )


def _noise(rest: FloatArray, size: FloatArray, chosen: NDArray[np.bool_]) -> float:
    """Standard deviation by size, from the median."""
    chosen = chosen & (size > 0.02)
    return 1.48 * float(np.median(rest[chosen] / size[chosen])) if chosen.sum() > 5 else 0.03


def _bounded(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


def _weighted_median(value: FloatArray, weight: FloatArray) -> float:
    order = np.argsort(value)
    total = np.cumsum(weight[order])
    return float(value[order][np.searchsorted(total, 0.5 * total[-1])])


def _robust_line(columns: FloatArray, target: FloatArray) -> tuple[float, float]:
    """Least squares with little weight on outliers; zero for what the data does not tell."""
    weight = np.ones(len(target))
    solution: FloatArray = np.zeros(2)
    ridge = np.diag([1e-3, 1e-3]) * len(target) * 0.01
    for _ in range(10):
        matrix = columns.T @ (columns * weight[:, None]) + ridge
        solution = np.asarray(np.linalg.solve(matrix, columns.T @ (weight * target)), np.float64)
        rest = np.abs(target - columns @ solution)
        scale = max(1.48 * float(np.median(rest)), 1e-4)
        weight = 1.0 / (1.0 + (rest / (2.0 * scale)) ** 2)
    return float(solution[0]), float(solution[1])
