"""Where labels go so that none covers another, a marker, or the edge of the picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from soundmap.geometry import FloatArray

LETTER_WIDTH, LETTER_HEIGHT = 7.0, 9.0
"""Room that a letter takes [points]."""


def label_offsets(
    points: FloatArray,
    names: Sequence[str],
    size: tuple[float, float],
    *,
    marker: float,
) -> list[tuple[float, float] | None]:
    """Offset of the middle of each label from its point, None where there is no room for it.

    Parameters
    ----------
    points : ndarray, shape (P, 2)
        Markers, from the lower-left corner of the picture [points of 1/72 inch].
    names : sequence of str
        Their labels; the first ones choose first.
    size : tuple of float
        Width and height of the picture [points].
    marker : float
        Diameter of a marker [points].

    Examples
    --------
    >>> label_offsets(np.array([[50.0, 50.0]]), ["S1"], (100.0, 100.0), marker=10.0)
    [(11.0, 8.5)]
    """
    half = np.array([marker, marker]) / 2.0
    taken = [np.concatenate([point - half, point + half]) for point in points]
    offsets: list[tuple[float, float] | None] = []
    for index, (point, name) in enumerate(zip(points, names, strict=True)):
        reach = np.array([LETTER_WIDTH * len(name), LETTER_HEIGHT]) / 2.0
        others = np.array(taken[:index] + taken[index + 1 :]).reshape(-1, 4)
        chosen = None
        for direction in _directions(half, reach):
            box = np.concatenate([point + direction - reach, point + direction + reach])
            inside = (box[:2] >= 0).all() and (box[2:] <= size).all()
            if inside and not _overlaps(box, others):
                chosen = (float(direction[0]), float(direction[1]))
                taken.append(box)
                break
        offsets.append(chosen)
    return offsets


def _directions(half: FloatArray, reach: FloatArray) -> list[FloatArray]:
    """Upper right first, then round; corners before sides."""
    x, y = 0.8 * half + reach  # a circle leaves the corners of its box free
    corners = [(1, 1), (1, -1), (-1, 1), (-1, -1)]
    sides = [(1, 0), (-1, 0), (0, 1), (0, -1)]
    near = [np.array([a * x, b * y]) for a, b in corners]
    return near + [np.array([a * (x + 3.0), b * (y + 3.0)]) for a, b in sides]


def _overlaps(box: FloatArray, others: FloatArray) -> bool:
    apart = (box[2:] <= others[:, :2]).any(axis=1) | (box[:2] >= others[:, 2:]).any(axis=1)
    return bool((~apart).any())
