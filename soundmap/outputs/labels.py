"""Where labels go so that none covers another, a marker, or the edge of the picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from soundmap.geometry import FloatArray

LETTER_WIDTH, LETTER_HEIGHT = 7.0, 9.0
"""Room that a letter takes [points]."""
FAR = (24.0, 36.0, 48.0, 64.0, 80.0)
"""How far from its marker a label may go in a crowd [points]."""
FAR_DIRECTIONS = 12
CLEARLY = 1.3
MOST_FAR = 12
"""Of more markers than this none has a label far off: their lines would be a tangle."""


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

    Returns
    -------
    list of tuple of float
        [points]; beside the marker, or in a crowd so far off that a line has to join the two.

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
        neighbours = points[np.hypot(*(points - point).T) > marker / 2.0] - point
        ways = [way for way in _directions(half, reach) if _is_its_own(way, neighbours)]
        if len(points) <= MOST_FAR:
            far = _far_directions(reach)
            ways += [way for way in far if not _crosses(way, neighbours, marker)]
        chosen = None
        for direction in ways:
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


def is_far(offset: tuple[float, float]) -> bool:
    """Whether a label is so far off that a line has to say whose it is."""
    return bool(np.hypot(*offset) > FAR[0] + 3.0)


def _far_directions(reach: FloatArray) -> list[FloatArray]:
    """Rings of places round a crowd, the near ones first."""
    turn = np.pi / 4 + np.arange(FAR_DIRECTIONS) * 2.0 * np.pi / FAR_DIRECTIONS
    ways = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    return [way * (distance + reach) for distance in FAR for way in ways]


def _is_its_own(way: FloatArray, neighbours: FloatArray) -> bool:
    """Whether a label at the end of ``way`` is clearly nearer to its marker than to any other."""
    distance = np.hypot(*(neighbours - way).T)
    return bool((distance > CLEARLY * np.hypot(*way)).all())


def _crosses(way: FloatArray, neighbours: FloatArray, marker: float) -> bool:
    """Whether a line from a marker to its label runs over another."""
    along = np.clip(neighbours @ way / (way @ way), 0.0, 1.0)
    distance = np.hypot(*(neighbours - along[:, None] * way).T)
    return bool((distance < marker / 2.0).any())


def _overlaps(box: FloatArray, others: FloatArray) -> bool:
    apart = (box[2:] <= others[:, :2]).any(axis=1) | (box[:2] >= others[:, 2:]).any(axis=1)
    return bool((~apart).any())
