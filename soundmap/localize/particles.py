"""The weighted set of particles of Sect. 2.2: weighting, resampling, and the pose it stands for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, wrapped_angle

ROUGHENING = np.array([0.003, 0.003, np.radians(0.1)])
"""How far apart the copies of a particle are set [m, m, rad]."""
MODE_RADIUS_M = 0.5
MODE_RADIUS_RAD = np.radians(30.0)
"""Particles farther than this from a mode belong to another hypothesis."""


@dataclass(frozen=True)
class Particles:
    r"""Candidate poses and their weights.

    Attributes
    ----------
    pose : ndarray, shape (M, 3)
        :math:`x_m, y_m, \theta_m` in the map frame [m, m, rad].
    weight : ndarray, shape (M,)
        :math:`w_m`, not negative, sum 1.
    """

    pose: FloatArray
    weight: FloatArray

    def __post_init__(self) -> None:
        if self.pose.shape != (len(self.weight), 3):
            raise ValueError("particles need one weight a pose")

    def __len__(self) -> int:
        return len(self.weight)

    @property
    def effective_size(self) -> float:
        r""":math:`1 / \sum w_m^2`, between 1 and M."""
        return float(1.0 / np.sum(self.weight**2))


@dataclass(frozen=True)
class PoseEstimate:
    """The pose that a set of particles stands for.

    Attributes
    ----------
    pose : ndarray, shape (3,)
        Weighted mean of the heaviest mode; the heading's on the circle.
    spread_m, spread_rad : float
        Weighted standard deviation within the mode, position [m] and heading [rad].
    share : float
        Weight of the mode, 1 if all particles agree.
    """

    pose: FloatArray
    spread_m: float
    spread_rad: float
    share: float


def equally_weighted(pose: FloatArray) -> Particles:
    """Particles of the same weight at the poses given, shape (M, 3)."""
    return Particles(pose, np.full(len(pose), 1.0 / len(pose)))


def reweighted(particles: Particles, log_likelihood: FloatArray) -> Particles:
    """Particles after a measurement, the correction step; ``log_likelihood`` has shape (M,)."""
    with np.errstate(divide="ignore"):
        log_weight = np.log(particles.weight) + log_likelihood
    weight = np.exp(log_weight - log_weight.max())
    return Particles(particles.pose, weight / weight.sum())


def resampled(particles: Particles, count: int, rng: np.random.Generator) -> Particles:
    """``count`` particles drawn in proportion to their weights, by systematic resampling.

    Copies of one particle are set a little apart, or a robot at rest would run out of candidates.
    """
    position = (rng.random() + np.arange(count)) / count
    edges = np.cumsum(particles.weight)
    chosen = np.searchsorted(edges, position * edges[-1], side="right")
    pose = particles.pose[np.minimum(chosen, len(particles) - 1)]
    return equally_weighted(pose + ROUGHENING * rng.standard_normal(pose.shape))


def estimated_pose(particles: Particles) -> PoseEstimate:
    """Weighted mean of the heaviest mode; never an average across modes.

    Examples
    --------
    Headings on both sides of 180 degrees average to 180 degrees, not to 0:

    >>> pose = np.array([[0.0, 0.0, np.pi - 0.1], [0.0, 0.0, -np.pi + 0.1]])
    >>> estimate = estimated_pose(equally_weighted(pose))
    >>> bool(abs(abs(estimate.pose[2]) - np.pi) < 1e-9)
    True
    """
    centre = _heaviest_bin(particles)
    for _ in range(3):
        member = _within_mode(particles.pose, centre)
        centre = _weighted_mean(particles.pose[member], particles.weight[member])
    weight = particles.weight[member]
    share = float(weight.sum())
    offset = particles.pose[member] - centre
    turn = wrapped_angle(offset[:, 2])
    variance = np.sum(weight * (offset[:, 0] ** 2 + offset[:, 1] ** 2)) / share
    turn_variance = np.sum(weight * turn**2) / share
    return PoseEstimate(centre, float(np.sqrt(variance)), float(np.sqrt(turn_variance)), share)


def _heaviest_bin(particles: Particles) -> FloatArray:
    size = np.array([MODE_RADIUS_M, MODE_RADIUS_M, MODE_RADIUS_RAD])
    bins = np.floor(particles.pose / size).astype(np.int64)
    _, index = np.unique(bins, axis=0, return_inverse=True)
    heaviest = np.argmax(np.bincount(index.ravel(), weights=particles.weight))
    member = index.ravel() == heaviest
    return _weighted_mean(particles.pose[member], particles.weight[member])


def _within_mode(pose: FloatArray, centre: FloatArray) -> NDArray[np.bool_]:
    offset = pose - centre
    near = np.hypot(offset[:, 0], offset[:, 1]) < MODE_RADIUS_M
    member = near & (np.abs(wrapped_angle(offset[:, 2])) < MODE_RADIUS_RAD)
    if not member.any():  # a mean may fall between its particles
        member = np.zeros(len(pose), dtype=bool)
        member[np.argmin(np.hypot(offset[:, 0], offset[:, 1]))] = True
    return member


def _weighted_mean(pose: FloatArray, weight: FloatArray) -> FloatArray:
    total = weight.sum()
    if not total > 0:
        weight, total = np.ones(len(pose)), len(pose)
    position = weight @ pose[:, :2] / total
    heading = np.arctan2(weight @ np.sin(pose[:, 2]), weight @ np.cos(pose[:, 2]))
    return np.array([position[0], position[1], heading])
