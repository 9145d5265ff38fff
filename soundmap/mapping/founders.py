"""Which key scans found a place: the first that shows it, by one scanner and in one direction.

Later scans are laid on founders, not on each other. However often a robot drives through a room,
the room has only so many founders, so that the work per scan does not grow with the run.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray

PLACE_M = 0.5
SECTORS = 4
"""Directions that a place can be seen in, a quarter turn each."""


def place_key(pose: FloatArray, scanner: int) -> tuple[int, int, int, int]:
    """Which place and direction a pose of the base belongs to."""
    column, row = (int(part) for part in np.floor(pose[:2] / PLACE_M))
    return column, row, int(np.floor(pose[2] / (2.0 * np.pi / SECTORS))), scanner


def founders(pose: FloatArray, scanner: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices of the first scan of every place, increasing.

    Parameters
    ----------
    pose : ndarray, shape (K, 3)
        By time.
    scanner : ndarray of int64, shape (K,)
    """
    seen = set()
    found = []
    for index, (place, which) in enumerate(zip(pose, scanner.tolist(), strict=True)):
        key = place_key(place, which)
        if key not in seen:
            seen.add(key)
            found.append(index)
    return np.array(found, dtype=np.int64)
