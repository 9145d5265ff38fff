"""Reflections: mirror images that the fit had to give a place, and whose they are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from soundmap.detect.component import Component
from soundmap.detect.evidence import Evidence
from soundmap.detect.sound_paths import Path
from soundmap.geometry import FloatArray
from soundmap.sound import Reflection, Source

TOLERANCE_M = 0.35


def told_reflections(
    images: Sequence[tuple[Evidence, Component]], sources: Sequence[Source]
) -> tuple[Reflection, ...]:
    """Mirror images with the source that each belongs to, loudest first.

    Parameters
    ----------
    images : sequence of (Evidence, Component)
        Each with the scans that it was fitted to.
    sources : sequence of Source
    """
    loudest_first = sorted(images, key=lambda pair: -float(pair[1].strength.sum()))
    return tuple(
        Reflection(
            float(image.place_m[0]),
            float(image.place_m[1]),
            float(image.strength.sum()),
            _mirrored_source(evidence, image, sources),
        )
        for evidence, image in loudest_first
    )


def is_at_mirror(place_m: FloatArray, louder_m: FloatArray, walls: FloatArray) -> bool:
    """Whether a place is where some wall would mirror something louder.

    Parameters
    ----------
    place_m : ndarray, shape (2,)
    louder_m : ndarray, shape (K, 2)
    walls : ndarray, shape (W, 3)
        Unit normal and offset of each.

    Examples
    --------
    >>> wall = np.array([[1.0, 0.0, 3.0]])
    >>> is_at_mirror(np.array([4.1, 1.0]), np.array([[2.0, 1.1]]), wall)
    True
    """
    normal, offset = walls[:, :2], walls[:, 2]
    off = louder_m @ normal.T - offset
    images = louder_m[:, None] - 2.0 * off[..., None] * normal
    away = np.hypot(*(images - place_m).reshape(-1, 2).T)
    return bool(away.min(initial=np.inf) < TOLERANCE_M)


def _mirrored_source(evidence: Evidence, image: Component, sources: Sequence[Source]) -> int | None:
    """The source whose mirror the surfaces in front of an image are, if there is one.

    The mirror lies half way between source and image, at right angles to the line between them:
    that is where the lasers should see a surface on the bearings of the image.
    """
    heard = image.paths.gain[Path.DIRECT] > 0.0
    beyond = image.paths.beyond_m[heard]
    stand = evidence.place_m[heard]
    ray = image.place_m - stand
    length = np.hypot(*ray.T)
    best, least = None, TOLERANCE_M
    for number, source in enumerate(sources):
        across = image.place_m - (source.x_m, source.y_m)
        middle = image.place_m - 0.5 * across
        with np.errstate(divide="ignore", invalid="ignore"):
            share = ((middle - stand) @ across) / (ray @ across)
        off = np.abs((1.0 - share) * length - beyond)
        off = float(np.median(off[np.isfinite(off)])) if np.isfinite(off).any() else np.inf
        if off < least:
            best, least = number, off
    return best
