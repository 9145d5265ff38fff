r"""Model errors: in what ways scans may differ from what the components of a fit predict.

The prediction of a loud source is off by some share: its strength changes with the direction it is
heard from and with its reflections' interference, its bearing is bent by them and by pose errors,
its height is not known, walls reflect more or less than assumed. Each is a *mode*: a pattern of its
own in each scan, random in size. With all modes u of a scan and noise of unit variance the scan has
the covariance

.. math:: \Sigma = I + \sum u u^T,

and what a weak source adds counts only as far as no error of a loud one could have added it.

A component's harmonics may also err one by one, each by a share of its own size: sound that
interferes with its own reflections is off in each of them by chance, not in all of them as if its
bearing were bent. This adds :math:`\kappa^2 |a|^2` to the diagonal, a being what the component
adds to the scan.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numba import njit

from soundmap.detect.evidence import Evidence
from soundmap.detect.harmonics import Single, add, look_up
from soundmap.detect.inversion import inverse_covariances
from soundmap.detect.sound_paths import Path, Paths, Waves, waves_to, weigh
from soundmap.geometry import FloatArray
from soundmap.side_by_side import side_by_side

APERTURE_ERROR = 0.03
"""Standard deviation of the cosine of a component's elevation."""
REFLECTED = 0.5
"""What a wall reflects of a component's sound, as far as errors of its harmonics go."""
HIDDEN_ERROR = 0.35
"""Of the share that passes a surface in the way."""
FAR_FIELD_ERROR = 0.35
"""Of what the far field adds to one scan, over what it adds on average."""
LEAST_MODE = 0.01
"""A mode whose energy stays below this in all scans changes nothing."""
SCANS_AT_ONCE = 64


@dataclass(frozen=True)
class ComponentErrors:
    """How a component's sound errs in one scan.

    Attributes
    ----------
    bearing : float
        Standard deviation of its bearing, over half the width of the beam: most of it is
        interference.
    harmonic : float
        Of each harmonic of it and of its reflections by walls, over its size.
    strength : float
        Of its strength, over its mean strength.
    reflection : float
        Of the share of its power that walls and the floor reflect.
    """

    bearing: float = 0.2
    harmonic: float = 0.0
    strength: float = 0.35
    reflection: float = 0.35


USUAL_ERRORS = ComponentErrors()
FREE_ERRORS = ComponentErrors(bearing=0.02, harmonic=1.0, strength=1.0, reflection=1.0)
"""Strengths and reflections err by their own size, scan by scan, since direct sound interferes with
what floor and walls reflect: what tells is the shape over the bearings. Each harmonic errs by about
its own size besides, so that a loud source beside the robot does not outvote all others."""


class Sounding(Protocol):
    """What modes are made of."""

    paths: Paths
    strength: FloatArray


class Precision:
    r"""Inverse covariance :math:`\Sigma^{-1}` of every scan, sub-band by sub-band.

    Parameters
    ----------
    evidence : Evidence
    components : sequence of Sounding
    far_field : ndarray of float32, shape (S, D), optional
        What the far field adds to the scans.
    errors : ComponentErrors, optional

    Attributes
    ----------
    inverse : list of ndarray of float32
        One (S, d, d) for each sub-band.
    """

    def __init__(
        self,
        evidence: Evidence,
        components: Sequence[Sounding],
        far_field: Single | None = None,
        errors: ComponentErrors = USUAL_ERRORS,
    ) -> None:
        starts = evidence.table.starts
        self.starts = starts
        sizes = [stop - start for start, stop in pairwise(starts)]
        if not components:
            self.inverse = [
                np.broadcast_to(np.eye(size, dtype=np.float32), (len(evidence), size, size))
                for size in sizes
            ]
            return
        self.inverse = [np.empty((len(evidence), size, size), dtype=np.float32) for size in sizes]
        bands = [slice(start, stop) for start, stop in pairwise(starts)]

        def invert(scans: slice) -> None:
            modes, energy, variance = _modes(evidence, components, scans, errors)
            far = None if far_field is None else np.float32(FAR_FIELD_ERROR) * far_field[scans]
            for band, (inverse, own) in enumerate(zip(self.inverse, bands, strict=True)):
                loud = modes[energy[:, band] > LEAST_MODE, :, own]
                if far is not None:
                    loud = np.concatenate([loud, far[None, :, own]])
                real, imaginary = np.split(variance[:, own], 2, axis=1)  # both err as much
                even = np.tile(np.float32(0.5) * (real + imaginary), 2)
                inverse_covariances(loud, even, inverse[scans])

        side_by_side(invert, parts(len(evidence)))

    def times(self, columns: Single) -> Single:
        r""":math:`\Sigma^{-1}` times columns (..., S, D)."""
        out = np.empty_like(columns)
        flat, result = columns.reshape(-1, *columns.shape[-2:]), out.reshape(-1, *out.shape[-2:])

        def multiply(scans: slice) -> None:
            for band, inverse in enumerate(self.inverse):
                own = slice(self.starts[band], self.starts[band + 1])
                part, into = (each[:, scans, own].swapaxes(0, 1) for each in (flat, result))
                np.matmul(part, inverse[scans], out=into)  # it is symmetric

        side_by_side(multiply, parts(columns.shape[-2]))
        return out


def parts(scans: int) -> list[slice]:
    """Scans that are worked on at once: even parts of them, an even number of these."""
    count = min(2 * -(-scans // (2 * SCANS_AT_ONCE)), scans)
    edges = [scans * i // max(count, 1) for i in range(count + 1)]
    return [slice(*edge) for edge in pairwise(edges)]


def _modes(
    evidence: Evidence, components: Sequence[Sounding], scans: slice, errors: ComponentErrors
) -> tuple[Single, Single, Single]:
    """Modes (M, s, D) of components in some scans, and the greatest energy of each, (M, B).

    Last the variance (s, D) of noise and of harmonics that err one by one.
    """
    paths = [component.paths for component in components]
    strength = np.array([component.strength for component in components])
    waves = waves_to(evidence, paths, strength, scans)
    stand = evidence.heard[scans].shape
    modes = np.zeros((len(paths) * (len(paths[0].gain) + 2), *stand), dtype=np.float32)
    energy = np.zeros((len(modes), evidence.sub_bands), dtype=np.float32)
    variance = np.ones(stand, dtype=np.float32)
    size = np.full(len(paths[0].gain), errors.reflection)
    size[Path.DIRECT], size[Path.HIDDEN] = errors.strength, HIDDEN_ERROR
    alone = np.full(len(size), errors.harmonic * REFLECTED)
    alone[[Path.DIRECT, Path.FLOOR, Path.HIDDEN]] = errors.harmonic, 0.0, 0.0
    bearing = errors.bearing * evidence.table.width_rad
    _add_modes(modes, energy, variance, waves, size, alone, bearing)
    return modes, energy, variance


@njit(cache=True, nogil=True)
def _add_modes(
    modes: Single,
    energy: Single,
    variance: Single,
    waves: Waves,
    size: FloatArray,
    alone: FloatArray,
    bearing: FloatArray,
) -> None:
    """Modes of each component: one for each path, then those of bearing and elevation.

    ``size`` and ``alone`` are errors of what each path brings, as a whole and harmonic by harmonic,
    ``bearing`` those of the bearing [rad].
    """
    beam, noise = np.empty(modes.shape[2], np.float32), np.empty(modes.shape[2], np.float32)
    components, paths, scans = waves.gain.shape
    starts = waves.starts
    for c in range(components):
        first = c * (paths + 2)
        for s in range(scans):
            weigh(noise, waves, c, s)
            for p in range(paths):
                loud = waves.gain[c, p, s]
                if loud == 0.0:
                    continue
                at, cos, turn = waves.wave[c, p, s], waves.aperture[c, p, s], waves.turn[s]
                look_up(beam, waves.beams, noise, at, cos, turn)
                add(modes[first + p, s], loud * size[p], beam)
                if alone[p] > 0.0:
                    share = np.float32((loud * alone[p]) ** 2)
                    for d in range(len(beam)):
                        variance[s, d] += share * beam[d] ** 2
                if p == Path.DIRECT:
                    lowered = modes[first + paths + 1, s]
                    add(lowered, loud, beam)
                    look_up(beam, waves.beams, noise, at, cos - APERTURE_ERROR, turn)
                    add(lowered, -loud, beam)
                    look_up(beam, waves.turned, noise, at, cos, turn)
                    for b in range(len(starts) - 1):
                        start, stop = starts[b], starts[b + 1]
                        bent = modes[first + paths, s, start:stop]
                        add(bent, loud * bearing[b], beam[start:stop])
            for m in range(first, first + paths + 2):
                for b in range(len(starts) - 1):
                    own = modes[m, s, starts[b] : starts[b + 1]]
                    energy[m, b] = max(energy[m, b], np.dot(own, own))
