"""Odometry: what the wheels of a differential drive say about the way."""

from __future__ import annotations

import numpy as np

from soundmap.geometry import FloatArray


def wheel_odometry(
    pose: FloatArray,
    interval_s: float,
    rng: np.random.Generator,
    *,
    wheelbase_m: float,
    left_scale: float = 1.0,
    right_scale: float = 1.0,
    wheelbase_scale: float = 1.0,
    noise_m_per_sqrt_m: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Poses and speeds as integrated from wheel encoders with systematic and random errors.

    Parameters
    ----------
    pose : ndarray, shape (K, 3)
        True poses, evenly spaced in time, heading continuous.
    interval_s : float
        Time between them [s].
    rng : numpy.random.Generator
    wheelbase_m : float
        True distance of the wheels [m].
    left_scale, right_scale : float
        Measured over true way of each wheel.
    wheelbase_scale : float
        Assumed over true distance of the wheels.
    noise_m_per_sqrt_m : float
        Random error of a wheel's way after 1 m [m].

    Returns
    -------
    pose : ndarray, shape (K, 3)
        In the odometry frame, which starts at the first pose.
    twist : ndarray, shape (K, 2)
        Forward speed [m/s] and turn rate [rad/s].
    """
    step = np.diff(pose, axis=0)
    middle = 0.5 * (pose[1:, 2] + pose[:-1, 2])
    forward = step[:, 0] * np.cos(middle) + step[:, 1] * np.sin(middle)
    wheels = np.stack([forward, forward], -1) + np.outer(step[:, 2], [-0.5, 0.5]) * wheelbase_m
    noise = noise_m_per_sqrt_m * np.sqrt(np.abs(wheels)) * rng.standard_normal(wheels.shape)
    measured = wheels * np.array([left_scale, right_scale]) + noise
    way = measured.mean(axis=1)
    turn = (measured[:, 1] - measured[:, 0]) / (wheelbase_m * wheelbase_scale)
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    along = 0.5 * (heading[1:] + heading[:-1])
    x = np.concatenate([[0.0], np.cumsum(way * np.cos(along))])
    y = np.concatenate([[0.0], np.cumsum(way * np.sin(along))])
    twist = np.stack([way, turn], axis=-1) / interval_s
    return np.stack([x, y, heading], -1), np.concatenate([np.zeros((1, 2)), twist])
