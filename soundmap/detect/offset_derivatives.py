"""Offset derivatives: how scans change with the array's clock and yaw, and with directivities."""

from __future__ import annotations

import numpy as np

from soundmap.detect.component import Component
from soundmap.detect.harmonics import Single
from soundmap.detect.model_errors import bearing_derivative
from soundmap.detect.sound_paths import NEAREST_M, Path, departures, heard_places, waves_heard
from soundmap.detect.sparse_fit import SparseFit
from soundmap.geometry import FloatArray


def by_offsets(fit: SparseFit, velocity: FloatArray) -> Single:
    """Change with clock [1/s] and yaw [1/rad], shape (2, S, D).

    A wrong yaw bends all bearings alike, and what walls reflect is left out of it: its bearings are
    predicted from places and walls, and off by as much. A wrong clock bends them while the array
    moves or turns, each time by another amount.

    Parameters
    ----------
    fit : SparseFit
    velocity : ndarray, shape (S, 3)
        Of the array in the map frame [m/s] [m/s] [rad/s].
    """
    evidence, part = fit.evidence, fit.evidence.table.part
    turn_rate = velocity[:, 2].astype(np.float32)[:, None]
    yaw = fit.far_field.turned(fit.far_harmonics)
    clock = yaw * turn_rate
    for component in fit.components:
        if not component.paths.gain[Path.DIRECT].any():
            continue
        strength = (component.strength[part] * evidence.handedness).astype(np.float32)
        places = heard_places(fit.walls, component.place_m)
        for path, share in component.taken():
            turned = bearing_derivative(evidence, component.paths, path=path)
            turned *= np.float32(share) * strength
            if path == Path.DIRECT:
                yaw -= turned
            passing = _passing(places[path] - evidence.place_m, velocity)
            clock += turned * (passing.astype(np.float32)[:, None] - turn_rate)
    return np.stack([clock, yaw])


def by_directivity(fit: SparseFit, component: Component, axis: int, scans: slice) -> Single:
    """Change of what some scans hear with a component's directivity along x or y, shape (s, D)."""
    evidence, paths = fit.evidence, component.paths
    toward = departures(fit.walls, component.place_m, evidence.place_m[scans])[..., axis]
    change = np.zeros_like(evidence.heard[scans])
    for path, share in component.taken():
        gain = share * paths.gain[path, scans] * toward[path]
        wave, aperture = paths.wave[path, scans], paths.aperture[path, scans]
        change += waves_heard(evidence, wave, aperture, gain, scans)
    change *= component.strength[evidence.table.part].astype(np.float32)
    return change


def _passing(step_m: FloatArray, velocity: FloatArray) -> FloatArray:
    """Rate at which the bearings of places (S, 2) away change as the array passes by [rad/s]."""
    square = np.maximum(np.sum(step_m**2, axis=1), NEAREST_M**2)
    return np.asarray((step_m[:, 1] * velocity[:, 0] - step_m[:, 0] * velocity[:, 1]) / square)
