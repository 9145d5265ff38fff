"""Component: one sound of the sparse fit, and the ways it takes to the array."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from soundmap.detect.harmonics import Single
from soundmap.detect.sound_paths import Kind, Path, Paths
from soundmap.geometry import FloatArray


class Share(IntEnum):
    """Ways besides the direct one whose part of a component's power is fitted."""

    CLOSE_WALLS = 2
    ROOM = 3
    """All other walls and the floor."""
    HIDDEN = 4
    """Through surfaces in the way."""


ASSUMED = {Share.CLOSE_WALLS: 0.5, Share.ROOM: 0.5, Share.HIDDEN: 0.2}
"""Shares as long as the scans do not tell them. Walls reflect half; none passes a wall, but much a
table whose edge or legs the lasers see."""
EVEN = np.zeros(2)
"""The directivity of what sounds the same in all directions."""
SHARE_SIGMA = {Share.CLOSE_WALLS: 0.08, Share.ROOM: 0.03, Share.HIDDEN: 0.04}
"""How firmly shares are held to what is assumed of them."""


@dataclass(eq=False)
class Component:
    """One sound of the fit.

    Attributes
    ----------
    place_m : ndarray, shape (2,)
    height_m : float
        Above or below the array [m].
    kind : Kind
    shares : dict
        For each `Share` the part of its power that takes such a way.
    strength : ndarray, shape (B,)
        Mean square at 1 m in each sub-band.
    paths : Paths
    column : ndarray of float32, shape (S, D)
        What it adds at strength 1.
    directivity : ndarray, shape (2,)
        Toward a unit vector u of the map it sends exp(directivity . u) of its power; the gains of
        its paths have that in them.
    sounding : ndarray of bool, shape (S,), optional
        In which scans it does: it may pause. The gains of its paths have that in them.
    ways : dict
        For each `Share` those paths that have it and that any scan hears.
    """

    place_m: FloatArray
    height_m: float
    kind: Kind
    shares: dict[Share, float]
    strength: FloatArray
    paths: Paths
    column: Single
    directivity: FloatArray = field(default_factory=EVEN.copy)
    sounding: NDArray[np.bool_] | None = None
    ways: dict[Share, list[int]] = field(default_factory=dict)

    def taken(self) -> tuple[list[int], FloatArray]:
        """All paths that it takes, and the part of its power that each has, shape (P,)."""
        paths, parts = [int(Path.DIRECT)], [1.0]
        for share, ways in self.ways.items():
            paths += ways
            parts += [self.shares[share]] * len(ways)
        return paths, np.array(parts)
