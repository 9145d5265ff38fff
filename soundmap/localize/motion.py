"""Odometry motion model: where a particle may be after the odometry says that it moved.

The step is split into a turn, a straight line and a second turn, each with its own noise
(Thrun, Burgard, Fox: Probabilistic Robotics, 2005, Sect. 5.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soundmap.config import LocalizeConfig
from soundmap.geometry import FloatArray, wrapped_angle

SMALLEST_STEP_M = 0.005
"""Below this the direction of a step is noise, and the step counts as a turn on the spot."""


@dataclass(frozen=True)
class MotionNoise:
    r"""Standard deviations of the odometry motion model, each proportional to the motion.

    Attributes
    ----------
    turn_per_turn : float
        :math:`\alpha_1` [rad/rad].
    turn_per_metre : float
        :math:`\alpha_2` [rad/m].
    distance_per_metre : float
        :math:`\alpha_3` [m/m].
    distance_per_turn : float
        :math:`\alpha_4` [m/rad].
    """

    turn_per_turn: float
    turn_per_metre: float
    distance_per_metre: float
    distance_per_turn: float


def motion_noise(config: LocalizeConfig) -> MotionNoise:
    """The noise that the configuration states."""
    return MotionNoise(
        config.noise_turn_per_turn,
        config.noise_turn_per_metre,
        config.noise_distance_per_metre,
        config.noise_distance_per_turn,
    )


def moved(
    pose: FloatArray, step: FloatArray, noise: MotionNoise, rng: np.random.Generator
) -> FloatArray:
    """Poses drawn from the motion model, the prediction step of Sect. 2.2.

    Parameters
    ----------
    pose : ndarray, shape (M, 3)
        Particles [m, m, rad].
    step : ndarray, shape (3,)
        Motion of the base according to the odometry, in the base frame before it [m, m, rad].
    noise : MotionNoise
    rng : numpy.random.Generator

    Returns
    -------
    ndarray, shape (M, 3)
    """
    distance = float(np.hypot(step[0], step[1]))
    first = float(np.arctan2(step[1], step[0])) if distance > SMALLEST_STEP_M else 0.0
    second = float(wrapped_angle(step[2] - first))
    # Driving backwards is a half turn to the model, but no turn of the wheels.
    turns = [min(abs(turn), np.pi - abs(turn)) for turn in (first, second)]
    first_sigma, second_sigma = (
        np.hypot(noise.turn_per_turn * turn, noise.turn_per_metre * distance) for turn in turns
    )
    distance_sigma = np.hypot(
        noise.distance_per_metre * distance, noise.distance_per_turn * sum(turns)
    )
    deviation = rng.standard_normal((3, len(pose)))
    heading = pose[:, 2] + first + first_sigma * deviation[0]
    length = distance + distance_sigma * deviation[1]
    return np.stack(
        [
            pose[:, 0] + length * np.cos(heading),
            pose[:, 1] + length * np.sin(heading),
            wrapped_angle(heading + second + second_sigma * deviation[2]),
        ],
        axis=-1,
    )
