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
from soundmap.geometry import FloatArray, composed, transformed
from soundmap.grid import OccupancyGrid
from soundmap.raycast import cast_ranges, walked_range


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


@dataclass(frozen=True)
class Agreement:
    """How a scan's returns compare with the map, as seen from one pose.

    Attributes
    ----------
    is_matched : ndarray of bool, shape (B,)
        Which returns lie where the map shows a surface.
    beyond : float
        Share that lies behind a surface of the map: things may stand before a wall that the map
        lacks, but no ray passes through a wall that is there.
    """

    is_matched: NDArray[np.bool_]
    beyond: float

    @property
    def matched(self) -> float:
        """Share of the returns that lie where the map shows a surface."""
        return float(self.is_matched.mean()) if len(self.is_matched) else 0.0


def scan_agreement(
    room: OccupancyGrid, pose: FloatArray, rays: Rays, *, tolerance_m: float
) -> Agreement:
    """What the map explains of a scan, and what contradicts it, seen from ``pose``, shape (3,).

    ``tolerance_m`` is the greatest difference between measured and cast range of a match [m].
    """
    if len(rays) == 0:
        return Agreement(np.zeros(0, dtype=bool), 0.0)
    origins = transformed(pose, rays.origin_m)
    bearings = rays.bearing_rad + pose[2]
    measured = rays.range_m
    limit = float(measured.max()) + 10.0 * tolerance_m
    expected = cast_ranges(room, origins, bearings, range_max_m=limit)
    # Where the map's surface is grazed, the range says little: look around the end point as well.
    near = _near_occupied(room, composed(pose, _as_poses(rays.end_m))[:, :2])
    matched = (np.abs(measured - expected) < tolerance_m) | near
    beyond = ~matched & (measured > expected)
    return Agreement(matched, float(beyond.mean()))


def _as_poses(points: FloatArray) -> FloatArray:
    return np.concatenate([points, np.zeros((len(points), 1))], axis=1)


def _near_occupied(room: OccupancyGrid, points: FloatArray) -> NDArray[np.bool_]:
    """Whether the cell of each point, or one of its eight neighbours, is occupied."""
    offsets = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
    cells = room.frame.cells(points)[:, None, :] + offsets
    inside = room.frame.contains(cells)
    row, column = np.where(inside, cells[..., 0], 0), np.where(inside, cells[..., 1], 0)
    return np.any(inside & room.occupied[row, column], axis=1)


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
