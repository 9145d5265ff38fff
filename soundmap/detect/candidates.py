"""Candidates: a grid of places where a sound may come from, in the room and behind its walls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.detect.evidence import Evidence
from soundmap.detect.matched_filter import MatchedScans, explained
from soundmap.detect.sound_paths import DEEPEST_M, REACH_M, Kind
from soundmap.geometry import FloatArray

STEP_M = {Kind.SOURCE: 0.2, Kind.IMAGE: 0.3}
"""Spacing of the grids [m]."""
SCANS = 150
"""About as many scans tell which candidates are worth a closer look."""
FINER_M = (0.1, 0.05)
"""Steps by which a candidate is then placed."""
IMAGE_FACTOR = 0.7
"""Of a source and a mirror image that explain the same, the source is taken: the image must explain
so much more."""


@dataclass(frozen=True)
class Candidate:
    """A place where one more source would explain much.

    Attributes
    ----------
    place_m : ndarray, shape (2,)
        [m]
    kind : Kind
    value : float
        Misfit that it would explain, times `IMAGE_FACTOR` for images.
    """

    place_m: FloatArray
    kind: Kind
    value: float


@dataclass(frozen=True)
class Candidates:
    """The places that enough scans could tell of.

    Attributes
    ----------
    source_m, image_m : ndarray, shape (C, 2)
        Those of each kind, in the map frame [m].
    """

    source_m: FloatArray
    image_m: FloatArray

    def places_m(self, kind: Kind) -> FloatArray:
        """Those of a kind, shape (C, 2) [m]."""
        return self.image_m if kind == Kind.IMAGE else self.source_m


def candidate_places(evidence: Evidence, surface_m: FloatArray) -> Candidates:
    """A grid over all that was within reach, as far as enough scans could tell of it.

    Parameters
    ----------
    evidence : Evidence
    surface_m : ndarray, shape (H, 2)
        Points of the surfaces that lasers saw [m]; may be none.
    """
    seen_m = np.concatenate([surface_m, evidence.place_m])
    margin = DEEPEST_M if len(surface_m) else REACH_M / 2.0
    low, high = seen_m.min(axis=0) - margin, seen_m.max(axis=0) + margin
    scans, bands = len(evidence), evidence.sub_bands
    classes, waves = evidence.table.beams.shape[:2]
    same = np.ones((1, 1, 1, 1), dtype=np.float32)
    anything = MatchedScans(
        np.broadcast_to(same, (scans, bands, classes, waves)).copy(),
        np.broadcast_to(same, (scans, bands, 2, waves // 3)).copy(),
    )
    places = []
    for kind in (Kind.SOURCE, Kind.IMAGE):
        axes = (np.arange(a, b, STEP_M[kind]) for a, b in zip(low, high, strict=True))
        x, y = np.meshgrid(*axes)
        grid = np.stack([x.ravel(), y.ravel()], axis=-1)
        places.append(grid[explained(evidence, anything, grid, kind).max(axis=1) > 0.0])
    return Candidates(*places)


def best_candidates(
    evidence: Evidence,
    matched: MatchedScans,
    candidates: Candidates,
    *,
    least: float,
    least_share: float,
    apart_m: float,
    most: int,
) -> list[Candidate]:
    """The candidates that explain most and lie well apart, each placed more finely.

    Parameters
    ----------
    evidence : Evidence
    matched : MatchedScans
    candidates : Candidates
    least, least_share : float
        Least that a candidate has to explain, and least share of what the best near it explains.
    apart_m : float
        Least distance between them [m].
    most : int
        How many at most.
    """
    places, kinds, values = [], [], []
    stride = max(len(evidence) // SCANS, 1)
    few = np.arange(0, len(evidence), stride)
    some, looked_at = evidence.chosen(few), MatchedScans(matched.match[few], matched.energy[few])
    for kind, factor in ((Kind.SOURCE, 1.0), (Kind.IMAGE, IMAGE_FACTOR)):
        own = candidates.places_m(kind)
        value = explained(some, looked_at, own, kind).max(axis=1, initial=0.0)
        value *= factor * stride
        loud = value >= least
        places.append(own[loud])
        values.append(value[loud])
        kinds.append(np.full(int(loud.sum()), int(kind)))
    place, value, kind_of = np.concatenate(places), np.concatenate(values), np.concatenate(kinds)
    chosen: list[int] = []
    for index in _falling(value):
        away = np.hypot(*(place[chosen] - place[index]).T) if chosen else np.empty(0)
        best_near = value[[c for c, d in zip(chosen, away, strict=True) if d < REACH_M]]
        if np.any(away < apart_m) or np.any(value[index] < least_share * best_near):
            continue
        chosen.append(int(index))
        if len(chosen) == most:
            break
    return [
        Candidate(
            finer_place(evidence, matched, place[index], Kind(int(kind_of[index]))),
            Kind(int(kind_of[index])),
            float(value[index]),
        )
        for index in chosen
    ]


def finer_place(
    evidence: Evidence, matched: MatchedScans, place_m: FloatArray, kind: Kind
) -> FloatArray:
    """The best place near one of the grid [m]."""
    for step in FINER_M:
        offset = step * np.arange(-2, 3)
        around = place_m + np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)
        value = explained(evidence, matched, around, kind).max(axis=1)
        place_m = around[int(np.argmax(value))]
    return place_m


def _falling(values: FloatArray) -> NDArray[np.intp]:
    return np.argsort(-values, kind="stable")
