r"""How well a laser scan fits a pose: the ray-casting beam model of Sect. 2.2.

A range either hits what the map shows, or ends earlier at something that is not on the map, or is
anywhere (Thrun, Burgard, Fox: Probabilistic Robotics, 2005, Sect. 6.3, the paper's [13]):

.. math::
    p(z | z^*) = w_{hit} \mathcal{N}(z; z^*, \sigma) + w_{short} \lambda e^{-\lambda z} [z < z^*]
    + w_{rand} / z_{max}

with :math:`z^*` cast through the map. Rays without a return say nothing and are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from soundmap.deskew import Rays
from soundmap.geometry import FloatArray
from soundmap.grid import OccupancyGrid
from soundmap.raycast import walked_range


@dataclass(frozen=True)
class BeamModel:
    r"""Mixture of what a laser ray may have met.

    Attributes
    ----------
    hit_sigma_m : float
        :math:`\sigma`, of a range that hit what the map shows [m].
    hit_weight, short_weight, random_weight : float
        Shares of the mixture; they need not sum to 1.
    short_decay_per_m : float
        :math:`\lambda` [1/m].
    range_max_m : float
        :math:`z_{max}` [m].
    """

    hit_sigma_m: float
    hit_weight: float
    short_weight: float
    random_weight: float
    short_decay_per_m: float
    range_max_m: float


def scan_log_likelihood(
    room: OccupancyGrid, pose: FloatArray, rays: Rays, model: BeamModel
) -> FloatArray:
    r"""Logarithm of the likelihood of a scan's ranges at each pose.

    Parameters
    ----------
    room : OccupancyGrid
    pose : ndarray, shape (M, 3)
        Poses of the base at ``rays.time_ns`` in the map frame.
    rays : Rays
    model : BeamModel

    Returns
    -------
    ndarray, shape (M,)
        Sum over the rays of :math:`\ln p(z | z^*)`.
    """
    return _log_likelihood(
        room.clearance_cells,
        np.array(room.frame.origin_m),
        room.frame.resolution_m,
        np.ascontiguousarray(pose),
        rays.origin_m,
        rays.bearing_rad,
        rays.range_m,
        np.array(
            [
                model.hit_sigma_m,
                model.hit_weight,
                model.short_weight,
                model.random_weight,
                model.short_decay_per_m,
                model.range_max_m,
            ]
        ),
    )


def beam_log_likelihood(
    measured_m: FloatArray, expected_m: FloatArray, model: BeamModel
) -> FloatArray:
    r""":math:`\ln p(z | z^*)` of single rays, any shape: the plain form of the mixture."""
    deviation = (measured_m - expected_m) / model.hit_sigma_m
    hit = np.exp(-0.5 * deviation**2) / (np.sqrt(2.0 * np.pi) * model.hit_sigma_m)
    short = model.short_decay_per_m * np.exp(-model.short_decay_per_m * measured_m)
    density = (
        model.hit_weight * hit
        + model.short_weight * np.where(measured_m < expected_m, short, 0.0)
        + model.random_weight / model.range_max_m
    )
    return np.log(density)


@njit(cache=True, nogil=True)
def _log_likelihood(
    clearance: NDArray[np.float32],
    grid_origin: FloatArray,
    resolution: float,
    pose: FloatArray,
    origin: FloatArray,
    bearing: FloatArray,
    measured: FloatArray,
    model: FloatArray,
) -> FloatArray:
    sigma, hit_weight, short_weight, random_weight, decay, range_max = model
    hit_scale = hit_weight / (np.sqrt(2.0 * np.pi) * sigma)
    random = random_weight / range_max
    result = np.empty(len(pose))
    for particle in range(len(pose)):
        x, y, heading = pose[particle]
        cos, sin = np.cos(heading), np.sin(heading)
        total = 0.0
        for ray in range(len(measured)):
            start_x = x + cos * origin[ray, 0] - sin * origin[ray, 1]
            start_y = y + sin * origin[ray, 0] + cos * origin[ray, 1]
            angle = heading + bearing[ray]
            # Beyond the measured range plus a few sigma the exact value no longer matters.
            limit = min(measured[ray] + 6.0 * sigma, range_max)
            expected = resolution * walked_range(
                clearance,
                (start_x - grid_origin[0]) / resolution,
                (start_y - grid_origin[1]) / resolution,
                np.cos(angle),
                np.sin(angle),
                limit / resolution,
            )
            deviation = (measured[ray] - expected) / sigma
            density = random + hit_scale * np.exp(-0.5 * deviation * deviation)
            if measured[ray] < expected:
                density += short_weight * decay * np.exp(-decay * measured[ray])
            total += np.log(density)
        result[particle] = total
    return result
