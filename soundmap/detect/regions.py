"""Regions: parts of a large site that are fitted one after another.

What is heard tells of places near by only. Time and memory then grow with the way driven, not with
its square, however large the site.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.detect.evidence import Evidence
from soundmap.geometry import FloatArray

MOST_SCANS = 600
"""A run of more scans is cut into regions."""
MOST_IN_REGION = 800
"""Of more scans in one region, evenly chosen ones are fitted."""
EDGE_M = 16.0
MARGIN_M = 6.0
"""Scans this far outside of a region still tell of its sources."""


@dataclass(frozen=True)
class Region:
    """A rectangle, and what tells of the sources in it.

    Attributes
    ----------
    low_m, high_m : ndarray, shape (2,)
        Its corners in the map frame [m].
    evidence : Evidence
    """

    low_m: FloatArray
    high_m: FloatArray
    evidence: Evidence

    def owns(self, place_m: FloatArray) -> bool:
        """Whether a place lies in this region; in exactly one of all."""
        return bool(np.all(place_m >= self.low_m) and np.all(place_m < self.high_m))


def regions(evidence: Evidence) -> Iterator[Region]:
    """One region for a run of few scans, else tiles that cover the site.

    Parameters
    ----------
    evidence : Evidence
        At least one scan.
    """
    everywhere = np.full(2, np.inf)
    if len(evidence) <= MOST_SCANS:
        yield Region(-everywhere, everywhere, evidence)
        return
    low, high = evidence.place_m.min(axis=0), evidence.place_m.max(axis=0)
    count = np.maximum(np.ceil((high - low) / EDGE_M).astype(np.int64), 1)
    edges = [np.linspace(low[axis], high[axis], count[axis] + 1) for axis in (0, 1)]
    for own in edges:
        own[0], own[-1] = -np.inf, np.inf
    for column in range(count[0]):
        for row in range(count[1]):
            corner = np.array([edges[0][column], edges[1][row]])
            opposite = np.array([edges[0][column + 1], edges[1][row + 1]])
            scans = telling(evidence, corner, opposite)
            if len(scans):
                yield Region(corner, opposite, evidence.chosen(scans))


def telling(evidence: Evidence, low_m: FloatArray, high_m: FloatArray) -> NDArray[np.int64]:
    """Scans in a rectangle or near it, shape (K,)."""
    inside = (evidence.place_m > low_m - MARGIN_M) & (evidence.place_m < high_m + MARGIN_M)
    scans = np.flatnonzero(inside.all(axis=1))
    return scans[:: -(-len(scans) // MOST_IN_REGION) or 1]
