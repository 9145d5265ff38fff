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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import Protocol

import numpy as np

from soundmap.detect.evidence import Evidence
from soundmap.detect.harmonics import Single
from soundmap.detect.inversion import invert
from soundmap.detect.sound_paths import Path, Paths, paths_heard, waves_heard
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
LEAST_MODE = 0.05
"""A mode whose energy stays below this in all scans changes nothing."""
SCANS_AT_ONCE = 128


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
            loud: list[list[Single]] = [[] for _ in self.inverse]  # what is quiet goes at once
            modes = [_modes(evidence, each, scans, errors) for each in components]
            if far_field is not None:
                modes.append(iter([np.float32(FAR_FIELD_ERROR) * far_field[scans]]))
            for mode in chain.from_iterable(modes):
                for kept, own in zip(loud, bands, strict=True):
                    if _is_loud(mode[:, own]):
                        kept.append(mode[:, own].copy())
            alone = _alone(evidence, components, scans, errors.harmonic)
            for kept, inverse, own in zip(loud, self.inverse, bands, strict=True):
                inverse[scans] = _inverse(kept, inverse.shape[1], alone[:, own])

        side_by_side(invert, parts(len(evidence)))

    def times(self, columns: Single, scans: slice = slice(None)) -> Single:
        r""":math:`\Sigma^{-1}` of some scans times columns (..., S, D)."""
        out = np.empty_like(columns)
        flat, result = columns.reshape(-1, *columns.shape[-2:]), out.reshape(-1, *out.shape[-2:])
        inverses = [inverse[scans] for inverse in self.inverse]

        def multiply(few: slice) -> None:
            for band, inverse in enumerate(inverses):
                own = slice(self.starts[band], self.starts[band + 1])
                part, into = (each[:, few, own].swapaxes(0, 1) for each in (flat, result))
                np.matmul(part, inverse[few], out=into)  # it is symmetric

        side_by_side(multiply, parts(columns.shape[-2]))
        return out


def parts(scans: int) -> list[slice]:
    """Scans that are worked on at once."""
    return [slice(i, min(i + SCANS_AT_ONCE, scans)) for i in range(0, scans, SCANS_AT_ONCE)]


def _is_loud(mode: Single) -> bool:
    return bool(np.einsum("sd,sd->s", mode, mode).max() > LEAST_MODE)


def _alone(
    evidence: Evidence, components: Sequence[Sounding], scans: slice, share: float
) -> Single:
    """Variance of errors of single harmonics, shape (s, D), or (1, D) where there are none.

    Real and imaginary part of a harmonic have the same.
    """
    part = evidence.table.part
    variance = np.zeros((len(evidence.place_m[scans]) if share else 1, len(part)), dtype=np.float32)
    if not share:
        return variance
    for component in components:
        paths, strength = component.paths, share * component.strength[part].astype(np.float32)
        for path in (Path.DIRECT, *range(Path.WALLS, len(paths.gain))):
            gain = paths.gain[path, scans]
            if gain.any():
                wave, aperture = paths.wave[path, scans], paths.aperture[path, scans]
                heard = waves_heard(evidence, wave, aperture, gain, scans) * strength
                reflected = 1.0 if path == Path.DIRECT else REFLECTED
                variance += (np.float32(reflected) * heard) ** 2
    for start, stop in pairwise(evidence.table.starts):
        real, imaginary = np.split(variance[:, start:stop], 2, axis=1)
        mean = 0.5 * (real + imaginary)
        variance[:, start:stop] = np.hstack([mean, mean])
    return variance


def _inverse(modes: list[Single], size: int, alone: Single) -> Single:
    """Inverse of the identity plus the squares of all modes, each (S, d); it takes them away.

    Harmonics that err alone add their variance (S, d), or (1, d) if it is nought everywhere.
    """
    if not modes and len(alone) == 1:
        return np.eye(size, dtype=np.float32)[None]
    if modes:
        stacked = np.stack(modes, axis=1)
        modes.clear()
        covariance = np.matmul(stacked.transpose(0, 2, 1), stacked)
        del stacked
    else:
        covariance = np.zeros((len(alone), size, size), dtype=np.float32)
    covariance[:, np.arange(size), np.arange(size)] += 1.0 + alone
    invert(covariance)
    return covariance


def _modes(
    evidence: Evidence, component: Sounding, scans: slice, errors: ComponentErrors
) -> Iterator[Single]:
    """Modes of one component in some scans, each (S, D)."""
    if not component.strength.any():
        return
    part = evidence.table.part
    strength = component.strength[part].astype(np.float32)
    bearing = (errors.bearing * evidence.table.width_rad)[part].astype(np.float32)
    paths = component.paths
    wave, gain = paths.wave[:, scans], paths.gain[:, scans]
    aperture = paths.aperture[:, scans]

    def heard(path: int, turned: float = 0.0, lowered: float = 0.0) -> Single:
        return waves_heard(
            evidence, wave[path] + turned, aperture[path] - lowered, gain[path], scans
        )

    if gain[Path.DIRECT].any():
        here = heard(Path.DIRECT)
        yield here * (np.float32(errors.strength) * strength)
        yield bearing_derivative(evidence, paths, scans) * (bearing * strength)
        lowered = heard(Path.DIRECT, lowered=APERTURE_ERROR)
        yield (here - lowered) * strength
    for path in (Path.FLOOR, *range(Path.WALLS, len(gain))):
        if gain[path].any():
            yield heard(path) * (np.float32(errors.reflection) * strength)
    if gain[Path.HIDDEN].any():
        yield heard(Path.HIDDEN) * (np.float32(HIDDEN_ERROR) * strength)


def bearing_derivative(
    evidence: Evidence, paths: Paths, scans: slice = slice(None), *, path: int = Path.DIRECT
) -> Single:
    """Change of what is heard along a path with the bearing, shape (S, D) [1/rad]."""
    return paths_heard(evidence, paths, [path], np.ones((1, 1, 1)), scans, turned=True)[0]
