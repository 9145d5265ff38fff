"""What laser scans seem to tell about the place along walls, and do not."""

from __future__ import annotations

import numpy as np

from soundmap.geometry import FloatArray

HEARSAY = 0.003
"""Square of 3 degrees: how well directions of walls are known."""
NEIGHBOURS = 2
"""Scans on either side that have to see what tells the place."""


def without_hearsay(
    information: FloatArray, pull: FloatArray, doubt: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """The evidence of laser scans less what errors of the walls' directions make up.

    Walls that all run one way say nothing about the place along them. Yet their directions are
    known to about 3 degrees at best, and the little that each seems to say of that place would add
    up over a run to certainty. In the direction in which a scan tells least, `HEARSAY` of what it
    tells across is taken off, and what is in doubt.

    Parameters
    ----------
    information : ndarray, shape (K, 3, 3)
    pull : ndarray, shape (K, 3)
    doubt : ndarray, shape (K, 2, 2), optional
        Information about the place that comes from scatter of the directions alone, where that has
        been measured.
    """
    a, b, c = information[:, 0, 0], information[:, 0, 1], information[:, 1, 1]
    across = 0.5 * np.arctan2(2.0 * b, a - c)
    most = 0.5 * (a + c) + np.hypot(0.5 * (a - c), b)
    along = np.stack([-np.sin(across), np.cos(across), np.zeros(len(a))], axis=-1)
    # What is known along the walls whatever the heading and the place across them are.
    facing = np.stack([np.cos(across), np.sin(across), np.zeros(len(a))], axis=-1)
    along_by_heading = np.einsum("ki,ki->k", along, information[:, :, 2])
    across_by_heading = np.einsum("ki,ki->k", facing, information[:, :, 2])
    heading = information[:, 2, 2] - across_by_heading**2 / np.maximum(most, 1e-12)
    known = np.einsum("ki,kij,kj->k", along, information, along)
    known = known - along_by_heading**2 / np.maximum(heading, 1e-12)
    hearsay = HEARSAY * most
    if doubt is not None:
        hearsay += np.einsum("ki,kij,kj->k", along[:, :2], doubt, along[:, :2])
    taken = np.clip(known, 0.0, np.maximum(hearsay, 0.0))
    share = taken / np.maximum(known, 1e-12)
    pulled = np.einsum("ki,ki->k", along, pull)
    return (
        information - taken[:, None, None] * along[:, :, None] * along[:, None, :],
        pull - (share * pulled)[:, None] * along,
    )


def unsupported(information: FloatArray) -> FloatArray:
    """What scans tell of the place that those just before and after them do not tell.

    A wall that ends the way is seen by one scan after another; one or two returns of a single scan
    that happen to lie on the corner of a map are no such wall.

    Parameters
    ----------
    information : ndarray, shape (K, 3, 3)
        Of scans by time.

    Returns
    -------
    ndarray, shape (K, 2, 2)
        Information about the place beyond that of the `NEIGHBOURS` on either side together; zero
        if there is one scan only.
    """
    count = len(information)
    if count < 2:
        return np.zeros((count, 2, 2))
    turn = information[:, :2, 2]
    by_turn = turn[:, :, None] * turn[:, None, :]
    place = information[:, :2, :2] - by_turn / np.maximum(information[:, 2:, 2:], 1e-12)
    around = np.zeros_like(place)
    for away in range(1, min(NEIGHBOURS, count - 1) + 1):
        around[away:] += place[:-away]
        around[:-away] += place[away:]
    share, axes = np.linalg.eigh(place - around)
    return (axes * np.maximum(share, 0.0)[:, None, :]) @ axes.swapaxes(1, 2)
