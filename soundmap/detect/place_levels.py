r"""Levels of given places in a run, each with the error that its scatter along the way shows.

All places, :math:`K` of them, sound at once. With the model of the fit, scan s hears on bearing n

.. math:: J_s(\theta_n) = b_s + \sum_k q_k B(\theta_n, \phi_{k,s}) / (r_{k,s}^2 + h^2) + e_{n,s}

and least squares give the strengths q. What is left over, e, is not white: directivity, floor and
poses change slowly along the way. So the way is cut into stretches, and how far each stretch alone
pulls at the strengths gives their covariance (the cluster-robust estimate of Liang and Zeger,
"Longitudinal data analysis using generalized linear models", Biometrika 1986). Strengths may come
out negative: a place that is silent scatters round 0.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.beam import beam_patterns
from soundmap.config import ScanConfig
from soundmap.geometry import FloatArray, Mount, Trajectory, transformed
from soundmap.grid import OccupancyGrid
from soundmap.raycast import cast_ranges
from soundmap.sensors import MicArray
from soundmap.sound import AudioScans, SourceList

HEIGHT_M, NEAREST_M = 0.3, 0.4
"""Height between source and array, and least distance, that are assumed [m]."""
REACH_M = 8.0
IN_FRONT_M = 0.35
"""A place is heard up to this far behind the wall on its bearing: maps are not exact [m]."""
STRETCH_M = 0.25
"""Way over which the model's errors are taken to be alike [m]."""
LEAST_FREEDOM = 1.0
"""Degrees of freedom below which a run does not tell of a place."""
SLOPE_DB_PER_OCTAVE = -6.0
"""Of the sound's spectrum over the band: only the width of the beams depends on it, a little."""
APART_M = 0.25
"""Mirror images nearer than this to a source or to each other are not told from it."""
DECIBELS_PER_SHARE = 10.0 / np.log(10.0)
WAVES, FREQUENCIES = 360, 32
CHUNK = 2000


@dataclass(frozen=True)
class PlaceLevels:
    """Strengths of places in one run.

    Attributes
    ----------
    power_1m : ndarray, shape (K,)
        Mean square in the band at 1 m [linear]; NaN where the run does not tell of the place.
    sigma : ndarray, shape (K,)
        Standard error of it [linear].
    freedom : ndarray, shape (K,)
        Degrees of freedom that the standard error rests on.
    """

    power_1m: FloatArray
    sigma: FloatArray
    freedom: FloatArray


def place_levels(
    places_m: FloatArray,
    scans: AudioScans,
    trajectory: Trajectory,
    array: MicArray,
    room: OccupancyGrid,
    config: ScanConfig,
    *,
    images_m: FloatArray,
) -> PlaceLevels:
    """How loud a run heard each of some places.

    Parameters
    ----------
    places_m : ndarray, shape (K, 2)
        In the map frame [m].
    scans : AudioScans
    trajectory : Trajectory
    array : MicArray
    room : OccupancyGrid
        Its walls hide places.
    config : ScanConfig
    images_m : ndarray, shape (I, 2)
        Mirror images, which lie behind walls: they sound, too, but are not asked for [m].
    """
    count = len(places_m)
    unknown = np.full(count, np.nan)
    chosen = trajectory.usable_at(scans.time_ns) & np.isfinite(scans.power).all(axis=1)
    chosen &= scans.power.mean(axis=1) > 0.0
    if not count or not chosen.any():
        return PlaceLevels(unknown, unknown, np.zeros(count))
    time_ns, power = scans.time_ns[chosen], scans.power[chosen]
    pose = trajectory.at(time_ns)
    stretch = _stretches(trajectory, time_ns)
    every = np.concatenate([places_m, images_m.reshape(-1, 2)])
    behind = np.arange(len(every)) >= count
    beams = _beams(array.positions_m, power.shape[1], config)
    parts = [slice(start, start + CHUNK) for start in range(0, len(time_ns), CHUNK)]
    products = [
        _products(*_heard(every, behind, pose[part], array.mount, room), power[part], beams)
        for part in parts
    ]
    gram = _sums(np.concatenate([gram for gram, _ in products]), stretch)
    data = _sums(np.concatenate([data for _, data in products]), stretch)
    strength, sigma, freedom = _fitted(gram, data)
    known = freedom[:count] >= LEAST_FREEDOM
    return PlaceLevels(
        np.where(known, strength[:count], np.nan),
        np.where(known, sigma[:count], np.nan),
        np.where(known, freedom[:count], 0.0),
    )


def with_level_errors(
    sources: SourceList,
    scans: AudioScans,
    trajectory: Trajectory,
    array: MicArray,
    room: OccupancyGrid,
    config: ScanConfig,
) -> SourceList:
    """The same sources, each with the standard error of its level where the run tells of it.

    Parameters
    ----------
    sources : SourceList
        Of a fit.
    scans, trajectory, array, room, config
        As for `place_levels`.
    """
    places = np.array([(source.x_m, source.y_m) for source in sources]).reshape(-1, 2)
    images = images_apart([sources], places)
    levels = place_levels(places, scans, trajectory, array, room, config, images_m=images)
    told = []
    for source, power, sigma in zip(sources, levels.power_1m, levels.sigma, strict=True):
        fit = source.fit
        if fit is not None and power > sigma:
            error = DECIBELS_PER_SHARE * float(sigma / power)
            fit = dataclasses.replace(fit, level_sigma_db=error)
        told.append(dataclasses.replace(source, fit=fit))
    return dataclasses.replace(sources, sources=tuple(told))


def images_apart(lists: Iterable[SourceList], places_m: FloatArray) -> FloatArray:
    """Mirror images that are near neither a place nor an image before them, shape (I, 2)."""
    kept = np.zeros((0, 2))
    for image in (image for sources in lists for image in sources.reflections):
        here = np.array([image.x_m, image.y_m])
        others = np.concatenate([places_m, kept])
        if not len(others) or np.hypot(*(others - here).T).min() > APART_M:
            kept = np.concatenate([kept, here[None]])
    return kept


def _stretches(trajectory: Trajectory, time_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """First scan of each stretch of the way, shape (B,)."""
    way = np.interp(time_ns, trajectory.time_ns, trajectory.driven_m())
    number = np.floor(way / STRETCH_M).astype(np.int64)
    return np.flatnonzero(np.diff(number, prepend=-1))


def _beams(positions_m: FloatArray, bearings: int, config: ScanConfig) -> FloatArray:
    """Response to a wave from each direction, less its mean over the bearings, shape (M, N)."""
    frequency = np.linspace(config.low_hz, config.high_hz, FREQUENCIES)
    octaves = np.log2(frequency / config.low_hz)
    beams = beam_patterns(
        positions_m,
        bearings=bearings,
        waves=WAVES,
        frequency_hz=frequency,
        share=10.0 ** (SLOPE_DB_PER_OCTAVE * octaves / 10.0),
        speed_of_sound_m_s=config.speed_of_sound_m_s,
    )
    return beams - beams.mean(axis=1, keepdims=True)


def _heard(
    places_m: FloatArray,
    behind: NDArray[np.bool_],
    pose: FloatArray,
    mount: Mount,
    room: OccupancyGrid,
) -> tuple[FloatArray, FloatArray]:
    """What arrives of power 1 at 1 m, 0 where a wall is between, and from where; both (S, K)."""
    stand = transformed(pose, np.broadcast_to(mount.translation_m[:2], (len(pose), 2)))
    step = places_m - stand[:, None]
    distance = np.hypot(step[..., 0], step[..., 1])
    direction = np.arctan2(step[..., 1], step[..., 0])
    wall = cast_ranges(room, stand[:, None], direction, range_max_m=REACH_M)
    is_heard = (distance < REACH_M) & (behind | (distance < wall + IN_FRONT_M))
    gain = is_heard / (np.maximum(distance, NEAREST_M) ** 2 + HEIGHT_M**2)
    axis = pose[:, 2, None] + mount.yaw_rad
    return gain, mount.handedness * (direction - axis)


def _products(
    gain: FloatArray, bearing_rad: FloatArray, power: NDArray[np.float32], beams: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Of each scan, products of what the places add with each other and with what was heard.

    Scans count by their own loudness, so that a near pass does not outvote the rest.
    """
    wave = (bearing_rad / (2.0 * np.pi)) % 1.0 * len(beams)
    left = wave.astype(np.int64) % len(beams)
    share = (wave % 1.0)[..., None]
    beam = (1.0 - share) * beams[left] + share * beams[(left + 1) % len(beams)]
    mean = power.mean(axis=1, dtype=np.float64)[:, None]
    heard = power / mean - 1.0
    column = (gain / mean)[..., None] * beam
    return np.einsum("skn,sln->skl", column, column), np.einsum("skn,sn->sk", column, heard)


def _sums(values: FloatArray, starts: NDArray[np.int64]) -> FloatArray:
    return np.asarray(np.add.reduceat(values, starts, axis=0))


def _fitted(gram: FloatArray, data: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Strengths, standard errors and degrees of freedom, (K,) each, from sums a stretch.

    Places that nothing tells of get 0 degrees of freedom.
    """
    told = np.einsum("bkk->bk", gram)
    whole = told.sum(axis=0)
    freedom = whole**2 / np.maximum((told**2).sum(axis=0), 1e-300) - 1.0
    seen = freedom > 0.0
    strength, sigma = np.zeros(len(whole)), np.zeros(len(whole))
    inverse = np.linalg.pinv(gram[:, seen][:, :, seen].sum(axis=0), hermitian=True)
    strength[seen] = inverse @ data[:, seen].sum(axis=0)
    pull = (data - np.einsum("bkl,l->bk", gram, strength))[:, seen] @ inverse
    many = len(pull) / max(len(pull) - 1, 1)
    sigma[seen] = np.sqrt(many * np.sum(pull**2, axis=0))
    return strength, sigma, freedom
