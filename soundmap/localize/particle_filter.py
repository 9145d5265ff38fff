"""The particle filter of Sect. 2.2: predict with odometry, correct with laser scans, resample."""

from __future__ import annotations

import numpy as np

from soundmap.config import LocalizeConfig
from soundmap.deskew import Rays
from soundmap.geometry import FloatArray, wrapped_angle
from soundmap.grid import OccupancyGrid
from soundmap.localize.likelihood import BeamModel, scan_log_likelihood
from soundmap.localize.motion import motion_noise, moved
from soundmap.localize.particles import (
    Particles,
    PoseEstimate,
    equally_weighted,
    estimated_pose,
    resampled,
    reweighted,
)

SEED_SIGMA = np.array([0.1, 0.1, np.radians(3.0)])
"""Spread of the particles around a pose that is given or found by search [m, m, rad]."""
AGREED_SHARE = 0.98
"""Particles are concentrated only if this much of their weight is in one mode."""


class ParticleFilter:
    """Particles in a map, and what they say about the robot's pose.

    Parameters
    ----------
    room : OccupancyGrid
    start : ndarray, shape (3,)
        Pose around which the particles start.
    config : LocalizeConfig
    range_max_m : float
        :math:`z_{max}` of the scanners [m].
    rng : numpy.random.Generator
    """

    def __init__(
        self,
        room: OccupancyGrid,
        start: FloatArray,
        config: LocalizeConfig,
        *,
        range_max_m: float,
        rng: np.random.Generator,
    ) -> None:
        self._room, self._config, self._rng = room, config, rng
        self._model = BeamModel(
            config.hit_sigma_m,
            config.hit_weight,
            config.short_weight,
            config.random_weight,
            config.short_decay_per_m,
            range_max_m,
        )
        self._noise = motion_noise(config)
        pose = start + SEED_SIGMA * rng.standard_normal((config.particles, 3))
        pose[:, 2] = wrapped_angle(pose[:, 2])
        self._particles: Particles = equally_weighted(pose)

    def predict(self, step: FloatArray) -> None:
        """Move every particle as the odometry says, with noise; ``step`` has shape (3,)."""
        pose = moved(self._particles.pose, step, self._noise, self._rng)
        self._particles = Particles(pose, self._particles.weight)

    def correct(self, rays: Rays) -> None:
        """Weigh every particle by how well one scan fits it; resample when few carry the weight."""
        log_likelihood = scan_log_likelihood(self._room, self._particles.pose, rays, self._model)
        exponent = self._config.likelihood_exponent
        self._particles = reweighted(self._particles, exponent * log_likelihood)
        if self._particles.effective_size < self._config.resample_share * len(self._particles):
            self._particles = resampled(self._particles, self._config.particles, self._rng)

    def estimate(self) -> PoseEstimate:
        """Weighted mean pose of the heaviest mode, with its spread."""
        return estimated_pose(self._particles)

    def concentrated(self, estimate: PoseEstimate) -> bool:
        """Whether the particles agree well enough for the sound map to be updated."""
        return (
            estimate.share >= AGREED_SHARE
            and estimate.spread_m <= self._config.max_spread_m
            and estimate.spread_rad <= self._config.max_spread_rad
        )
