r"""Sound paths: how a source reaches the array, directly and by the surfaces around it.

Along each path the array hears a wave from some bearing, of some aperture, and

.. math:: g = 1 / (\max(d, 0.3\,\mathrm{m})^2 + h^2)

of the mean square that the source has at 1 m, d being the way over the floor plan and h the height
between the array and the source or its image. Mirror images by walls exist where the lasers see the
wall at the point of reflection. Floor and ceiling mirror the source and each of those images, too:
on the same bearing, so that one wave stands for all of such a family.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from soundmap.detect.evidence import Evidence
from soundmap.detect.harmonics import Single, add, look_up
from soundmap.geometry import FloatArray

REACH_M = 9.0
"""Sound from farther away tells nothing of where its source is."""
NEAREST_M = 0.3
BEYOND_M, BEYOND_PER_M = 0.35, 0.02
"""What lies farther behind the first surface than this is hidden by it [m] [m/m]."""
DEEPEST_M = 2.8
"""Unexplained mirror images are taken to lie no farther behind a surface than this [m]."""
ON_MIRROR_M, ON_MIRROR_PER_M = 0.2, 0.03
"""A wall reflects where the lasers see a surface within this of it [m] [m/m]."""
LEAST_FLOOR_M = 0.5
"""Height between the array and images below the floor, if its own height is not known."""
CEILING_M = 4.2
"""Height between the array and images above the ceiling."""
FLOOR_SHARE, CEILING_SHARE = 0.5, 0.35
"""Parts of a wave's power that its images by floor and ceiling have."""


class Kind(IntEnum):
    """Where a component of the fit lies as the lasers see it."""

    SOURCE = 0
    """On a surface or in the open."""
    IMAGE = 1
    """Behind a surface: a reflection that no wall explains, or one of something unknown."""


class Path(IntEnum):
    """Which way a path goes; those by the walls follow."""

    DIRECT = 0
    FLOOR = 1
    HIDDEN = 2
    """The direct way, where a surface hides it: some sound may pass all the same."""
    WALLS = 3


@dataclass(frozen=True)
class Paths:
    """All paths of a source to the scans.

    Attributes
    ----------
    wave, aperture, gain : ndarray, shape (P, S)
        Direction in steps of the beams' directions, cosine of the elevation, and gain; 0 where
        the path does not exist. The paths are in the order of `Path`.
    beyond_m : ndarray, shape (S,)
        How far behind the first surface on its bearing the source lies [m]; NaN where unknown.
    """

    wave: FloatArray
    aperture: FloatArray
    gain: FloatArray
    beyond_m: FloatArray


def sound_paths(
    evidence: Evidence, walls: FloatArray, place_m: FloatArray, height_m: float, kind: Kind
) -> Paths:
    """Paths of one source.

    Parameters
    ----------
    evidence : Evidence
    walls : ndarray, shape (W, 3)
        Unit normal and offset of each.
    place_m : ndarray, shape (2,)
        In the map frame [m].
    height_m : float
        Above or below the array [m], >= 0.
    kind : Kind
    """
    return Paths(
        *_paths(
            np.ascontiguousarray(place_m, dtype=np.float64),
            height_m,
            kind == Kind.IMAGE,
            walls,
            max(2.0 * evidence.height_m, LEAST_FLOOR_M),
            evidence.place_m,
            evidence.axis_rad,
            float(evidence.handedness),
            evidence.range_m,
        )
    )


def heard_places(walls: FloatArray, place_m: FloatArray) -> FloatArray:
    """Where a source seems to be along each path: itself, or its mirror image, shape (P, 2) [m].

    Parameters
    ----------
    walls : ndarray, shape (W, 3)
    place_m : ndarray, shape (2,)
    """
    off = walls[:, :2] @ place_m - walls[:, 2]
    return np.concatenate(
        [np.tile(place_m, (Path.WALLS, 1)), place_m - 2.0 * off[:, None] * walls[:, :2]]
    )


def departures(walls: FloatArray, place_m: FloatArray, stand_m: FloatArray) -> FloatArray:
    """Directions in which sound leaves a source along each path, unit vectors (P, S, 2) in the map.

    Parameters
    ----------
    walls : ndarray, shape (W, 3)
    place_m : ndarray, shape (2,)
        Of the source [m].
    stand_m : ndarray, shape (S, 2)
        Of the array [m].
    """
    way = stand_m - heard_places(walls, place_m)[:, None]
    normal = walls[:, None, :2]
    way[Path.WALLS :] -= 2.0 * np.sum(way[Path.WALLS :] * normal, axis=2, keepdims=True) * normal
    return np.asarray(way / np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-9))


@njit(cache=True, nogil=True)
def seen(distance: float, beyond: float, behind: bool) -> bool:
    """Whether what lies so far away, and so far behind the first surface, is heard directly."""
    if distance > REACH_M:
        return False
    if behind:
        return -0.1 < beyond < DEEPEST_M
    return not beyond > BEYOND_M + BEYOND_PER_M * distance  # also where no surface is known


@njit(cache=True, nogil=True)
def _wave(dx: float, dy: float, axis: float, hand: float, waves: int) -> float:
    turn = hand * (np.arctan2(dy, dx) - axis) / (2.0 * np.pi)
    return (turn - np.floor(turn)) * waves


@njit(cache=True, nogil=True)
def _arriving(way: float, up: float) -> tuple[float, float]:
    """Gain of a wave, and cosine of its elevation."""
    square = way * way + up * up
    return 1.0 / square, way / np.sqrt(square)


@njit(cache=True, nogil=True)
def _joined(
    gain: float, aperture: float, share: float, other: float, its_aperture: float
) -> tuple[float, float]:
    """Two waves of the same bearing as one, a share of the second's gain beside the first's."""
    total = gain + share * other
    return total, (gain * aperture + share * other * its_aperture) / total


@njit(cache=True, nogil=True)
def _paths(
    place: FloatArray,
    height: float,
    behind: bool,
    walls: FloatArray,
    floor: float,
    stand: FloatArray,
    axis: FloatArray,
    hand: float,
    ranges: Single,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    scans, waves = ranges.shape
    paths = 3 + len(walls)
    wave = np.zeros((paths, scans))
    aperture = np.ones((paths, scans))
    gain = np.zeros((paths, scans))
    beyond = np.empty(scans)
    for s in range(scans):
        dx, dy = place[0] - stand[s, 0], place[1] - stand[s, 1]
        distance = np.sqrt(dx * dx + dy * dy)
        wave[:3, s] = _wave(dx, dy, axis[s], hand, waves)
        beyond[s] = distance - ranges[s, int(wave[0, s] + 0.5) % waves]
        if distance > REACH_M:
            continue
        near = max(distance, NEAREST_M)
        heard = seen(distance, beyond[s], behind)
        for path, up in ((0 if heard else 2, height), (1, floor)):
            if (path != 0 and behind) or (path == 1 and not heard):
                continue
            gain[path, s], aperture[path, s] = _arriving(near, up)
        if behind:
            continue
        if heard:  # the share of the floor, and beside it the ceiling's
            gain[1, s], aperture[1, s] = _joined(
                gain[1, s], aperture[1, s], CEILING_SHARE / FLOOR_SHARE, *_arriving(near, CEILING_M)
            )
        for w in range(len(walls)):
            own = place[0] * walls[w, 0] + place[1] * walls[w, 1] - walls[w, 2]
            side = stand[s, 0] * walls[w, 0] + stand[s, 1] * walls[w, 1] - walls[w, 2]
            if own * side <= 0.0:
                continue
            dx = place[0] - 2.0 * own * walls[w, 0] - stand[s, 0]
            dy = place[1] - 2.0 * own * walls[w, 1] - stand[s, 1]
            far = np.sqrt(dx * dx + dy * dy)
            if far > REACH_M:
                continue
            at = _wave(dx, dy, axis[s], hand, waves)
            mirror = side / (side + own) * far
            surface = ranges[s, int(at + 0.5) % waves]
            if abs(surface - mirror) < ON_MIRROR_M + ON_MIRROR_PER_M * mirror:
                total, tilt = _arriving(far, height)
                total, tilt = _joined(total, tilt, FLOOR_SHARE, *_arriving(far, floor))
                total, tilt = _joined(total, tilt, CEILING_SHARE, *_arriving(far, CEILING_M))
                wave[3 + w, s], gain[3 + w, s], aperture[3 + w, s] = at, total, tilt
    return wave, aperture, gain, beyond


class Waves(NamedTuple):
    """Waves from C sources along P paths to S scans, as kernels take them.

    Attributes
    ----------
    wave, aperture, gain : ndarray, shape (C, P, S)
        As in `Paths`.
    strength : ndarray, shape (C, B)
        Of the sources, mean square at 1 m.
    beams, turned : ndarray of float32, shape (E, M, D)
        As in `BeamTable`; ``starts`` (B + 1,) is, too.
    turn : ndarray, shape (S,)
        How far the array turned, in steps of the beams' directions.
    weight : ndarray, shape (S, B)
        One over the noise.
    """

    wave: FloatArray
    aperture: FloatArray
    gain: FloatArray
    strength: FloatArray
    beams: Single
    turned: Single
    starts: NDArray[np.int64]
    turn: FloatArray
    weight: FloatArray


def waves_to(
    evidence: Evidence, paths: Sequence[Paths], strength: FloatArray, scans: slice
) -> Waves:
    """Those along all paths of some sources, of strengths (C, B), to some scans."""
    table = evidence.table
    return Waves(
        np.stack([each.wave[:, scans] for each in paths]),
        np.stack([each.aperture[:, scans] for each in paths]),
        np.stack([each.gain[:, scans] for each in paths]),
        strength,
        table.beams,
        table.turned,
        table.starts,
        evidence.turn_rad[scans] * (table.waves / (2.0 * np.pi)),
        evidence.weight[scans],
    )


@njit(cache=True, nogil=True)
def weigh(noise: Single, waves: Waves, source: int, scan: int) -> None:
    """Put what a source's strength is in units of the noise into an array (D,)."""
    for b in range(len(waves.starts) - 1):
        own = waves.weight[scan, b] * waves.strength[source, b]
        noise[waves.starts[b] : waves.starts[b + 1]] = own


def waves_heard(
    evidence: Evidence,
    wave: FloatArray,
    aperture: FloatArray,
    gain: FloatArray,
    *,
    turned: bool = False,
) -> Single:
    """What waves of power 1 at 1 m add to each scan, in units of the noise, shape (S, D).

    Parameters
    ----------
    evidence : Evidence
    wave, aperture, gain : ndarray, shape (P, S), or (S,) for one wave
        As in `Paths`.
    turned : bool
        How that changes with the waves' bearings instead [1/rad].
    """
    paths = Paths(np.atleast_2d(wave), np.atleast_2d(aperture), np.atleast_2d(gain), np.empty(0))
    waves = waves_to(evidence, [paths], np.ones((1, evidence.sub_bands)), slice(None))
    out = np.zeros_like(evidence.heard)
    _add_waves(out, waves, waves.turned if turned else waves.beams)
    return out


@njit(cache=True, nogil=True)
def _add_waves(out: Single, waves: Waves, beams: Single) -> None:
    """Sum (S, D) of the waves of one source."""
    beam, noise = np.empty(out.shape[1], np.float32), np.empty(out.shape[1], np.float32)
    for s in range(len(out)):
        weigh(noise, waves, 0, s)
        for p in range(waves.gain.shape[1]):
            loud = waves.gain[0, p, s]
            if loud != 0.0:
                at, cos = waves.wave[0, p, s], waves.aperture[0, p, s]
                look_up(beam, beams, noise, at, cos, waves.turn[s])
                add(out[s], loud, beam)
