"""Placement: where a source stands, from its bearings and the surfaces that lasers saw near it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soundmap.detect.walls import HIT_CELL_M, PIECES
from soundmap.geometry import FloatArray
from soundmap.grid import OccupancyGrid

LEAST_SIGMA_M = 0.008
"""Standard deviation of a place from poses and cells, however well it is heard."""
NEAR_M = 0.5
WALL_M = 0.10
"""A surface nearer than this to an occupied cell of the map is a wall."""
MACHINE_ODDS, WALL_ODDS, UNKNOWN_ODDS = 30.0, 0.5, 6.0
"""How much likelier a source is on some metre of surface than in some square metre of the open: of
what the map does not show, of walls, and if there is no telling the two apart."""
LEAST_OFF_MAP, LEAST_OFF_MAP_SHARE = 5, 0.005
"""A map of walls alone leaves some of what lasers see off it; one that was built on the way does
not."""
SURFACE_SIGMA_M = 0.01
"""Of the distance between a source and the surface that it is on."""


@dataclass(frozen=True)
class Placement:
    """A source's place.

    Attributes
    ----------
    place_m : ndarray, shape (2,)
        [m]
    covariance_m2 : ndarray, shape (2, 2)
        [m^2]
    surface_odds : float
        How much likelier it is on a surface that lasers saw than in the open.
    """

    place_m: FloatArray
    covariance_m2: FloatArray
    surface_odds: float

    @property
    def on_surface(self) -> bool:
        """Whether it is more likely on a surface than not."""
        return self.surface_odds > 1.0


def placement(
    place_m: FloatArray,
    covariance_m2: FloatArray,
    surface_m: FloatArray,
    odds: FloatArray,
) -> Placement:
    """The mean of where bearings point and of the surfaces near, each as likely as it is.

    Most sources are machines with a surface. Bearings fix a source far better across than along
    their mean direction, where a surface, if there is one, does.

    Parameters
    ----------
    place_m : ndarray, shape (2,)
        From the bearings [m].
    covariance_m2 : ndarray, shape (2, 2)
        Of that place [m^2].
    surface_m : ndarray, shape (H, 2)
        Points of surfaces, `PIECES` for each `HIT_CELL_M` of them [m].
    odds : ndarray, shape (H,)
        How much likelier a source is on a metre of each than on a square metre of the open.

    Examples
    --------
    >>> wall = np.column_stack([np.full(400, 2.0), 0.005 * np.arange(400)])
    >>> along_x = np.diag([0.1, 0.01]) ** 2
    >>> placement(np.array([1.9, 1.0]), along_x, wall, np.full(400, 9.0)).place_m.round(2).tolist()
    [2.0, 1.0]
    """
    open_covariance = covariance_m2 + LEAST_SIGMA_M**2 * np.eye(2)
    step = surface_m - place_m
    near = np.hypot(*step.T) < NEAR_M
    step = step[near]
    precision = np.linalg.inv(open_covariance)
    away = np.einsum("hi,ij,hj->h", step, precision, step)
    weight = HIT_CELL_M / PIECES * odds[near] * np.exp(-0.5 * away)
    in_open = 2.0 * np.pi * np.sqrt(np.linalg.det(open_covariance))
    total = float(weight.sum())
    if total <= 0.0:
        return Placement(place_m, open_covariance, 0.0)
    probability = total / (total + in_open)
    mean = weight @ step / total
    spread = (step - mean).T @ ((step - mean) * (weight / total)[:, None])
    on_surface = spread + SURFACE_SIGMA_M**2 * np.eye(2)
    covariance = probability * on_surface + (1.0 - probability) * open_covariance
    covariance += probability * (1.0 - probability) * np.outer(mean, mean)
    return Placement(place_m + probability * mean, covariance, total / in_open)


def surface_odds(surface_m: FloatArray, room: OccupancyGrid | None) -> FloatArray:
    """Odds of a source on each surface point, shape (H,).

    Parameters
    ----------
    surface_m : ndarray, shape (H, 2)
        [m]
    room : OccupancyGrid or None
        The geometric map: what it does not show is a machine, not a wall.
    """
    unknown = np.full(len(surface_m), UNKNOWN_ODDS)
    if room is None:
        return unknown
    cells = room.frame.cells(surface_m)
    inside = room.frame.contains(cells)
    row, column = cells[inside].T
    clearance = np.full(len(surface_m), np.inf)
    clearance[inside] = room.clearance_cells[row, column] * room.frame.resolution_m
    off_map = clearance >= WALL_M
    if off_map.sum() < max(LEAST_OFF_MAP, LEAST_OFF_MAP_SHARE * len(surface_m)):
        return unknown
    return np.where(off_map, MACHINE_ODDS, WALL_ODDS)
