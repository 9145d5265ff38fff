"""Offset derivatives: how scans change with the array's clock and yaw."""

from __future__ import annotations

import numpy as np

from soundmap.detect.harmonics import Single
from soundmap.detect.sound_paths import NEAREST_M, Path, heard_places, waves_heard
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
        places, paths = heard_places(fit.walls, component.place_m), component.paths
        for path, share in zip(*component.taken(), strict=True):
            own = paths.wave[path], paths.aperture[path], paths.gain[path]
            turned = waves_heard(evidence, *own, turned=True)
            turned *= np.float32(share) * strength
            if path == Path.DIRECT:
                yaw -= turned
            passing = _passing(places[path] - evidence.place_m, velocity)
            clock += turned * (passing.astype(np.float32)[:, None] - turn_rate)
    return np.stack([clock, yaw])


def _passing(step_m: FloatArray, velocity: FloatArray) -> FloatArray:
    """Rate at which the bearings of places (S, 2) away change as the array passes by [rad/s]."""
    square = np.maximum(np.sum(step_m**2, axis=1), NEAREST_M**2)
    return np.asarray((step_m[:, 1] * velocity[:, 0] - step_m[:, 0] * velocity[:, 1]) / square)
