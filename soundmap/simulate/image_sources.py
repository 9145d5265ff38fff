"""Image sources: every way from a source to a receiver by up to a few reflections.

Walls are vertical and the floor and the ceiling level, so a way in the room is a way in the
floor plan together with an independent sequence of reflections at floor and ceiling. Which of
them exist is therefore decided in the plan alone, for any outline: each reflection point must lie
on its wall and no other wall may stand between.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray
from soundmap.simulate.floor_plan import FloorPlan, crossings


@dataclass(frozen=True)
class WallSequences:
    """All sequences of ``order`` walls that a sound could be reflected by, one after another.

    Attributes
    ----------
    walls : ndarray of int, shape (I, order)
        Indices of the walls, from the source on.
    matrix : ndarray, shape (I, order + 1, 2, 2)
        Linear part of the mirroring after 0, 1, ... reflections.
    shift : ndarray, shape (I, order + 1, 2)
        Its shift [m]: the image of s is ``matrix @ s + shift``.
    coefficient : ndarray, shape (I,)
        Product of the reflection coefficients [-].
    """

    walls: NDArray[np.int64]
    matrix: FloatArray
    shift: FloatArray
    coefficient: FloatArray

    @property
    def order(self) -> int:
        """How many reflections."""
        return self.walls.shape[1]

    def images(self, source_m: FloatArray) -> FloatArray:
        """Images of source positions (..., 2) after 0, 1, ... reflections.

        Returns
        -------
        ndarray, shape (I, order + 1, ..., 2)
            [m].
        """
        turned = np.einsum("ijab,...b->ij...a", self.matrix, source_m)
        extra = (1,) * (turned.ndim - 3)
        return np.asarray(turned + self.shift.reshape(*self.shift.shape[:2], *extra, 2))


def wall_sequences(plan: FloorPlan, highest_order: int) -> list[WallSequences]:
    """Sequences of 0, 1, ... ``highest_order`` walls; no wall follows itself."""
    along = plan.end_m - plan.start_m
    unit = along / plan.lengths_m[:, None]
    mirror = 2.0 * unit[:, :, None] * unit[:, None, :] - np.eye(2)
    offset = plan.start_m - np.einsum("wab,wb->wa", mirror, plan.start_m)
    result = [
        WallSequences(
            np.zeros((1, 0), dtype=np.int64),
            np.eye(2)[None, None],
            np.zeros((1, 1, 2)),
            np.ones(1),
        )
    ]
    count = len(along)
    for _ in range(highest_order):
        last = result[-1]
        previous = np.repeat(np.arange(len(last.walls)), count)
        wall = np.tile(np.arange(count), len(last.walls))
        coefficient = last.coefficient[previous] * plan.reflection[wall]
        keep = coefficient > 0.0
        if last.order:
            keep &= last.walls[previous, -1] != wall
        previous, wall = previous[keep], wall[keep]
        matrix = np.einsum("iab,ibc->iac", mirror[wall], last.matrix[previous, -1])
        shift = np.einsum("iab,ib->ia", mirror[wall], last.shift[previous, -1]) + offset[wall]
        result.append(
            WallSequences(
                np.concatenate([last.walls[previous], wall[:, None]], axis=1),
                np.concatenate([last.matrix[previous], matrix[:, None]], axis=1),
                np.concatenate([last.shift[previous], shift[:, None]], axis=1),
                coefficient[keep],
            )
        )
    return result


def visible(
    sequences: WallSequences, plan: FloorPlan, source_m: FloatArray, receiver_m: FloatArray
) -> NDArray[np.bool_]:
    """Whether each way exists, followed from the receiver back to the source.

    Parameters
    ----------
    sequences : WallSequences
    plan : FloorPlan
    source_m, receiver_m : ndarray, shapes (T, 2)
        [m].

    Returns
    -------
    ndarray of bool, shape (I, T)
    """
    images = sequences.images(source_m)
    point = np.broadcast_to(receiver_m, (len(sequences.walls), *receiver_m.shape))
    exists = np.ones(point.shape[:-1], dtype=bool)
    for order in range(sequences.order, 0, -1):
        wall = sequences.walls[:, order - 1]
        hit, meets = _wall_hits(
            point, images[:, order], plan.start_m[wall][:, None], plan.end_m[wall][:, None]
        )
        exists &= meets
        exists[exists] &= ~_blocked(point[exists], hit[exists], plan)
        point = hit
    exists[exists] &= ~_blocked(point[exists], images[:, 0][exists], plan)
    return exists


def _wall_hits(
    point: FloatArray, image: FloatArray, start: FloatArray, end: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Where the way from each point to the image meets the line of a wall, and whether on it."""
    way, wall, gap = image - point, end - start, start - point
    cross = way[..., 0] * wall[..., 1] - way[..., 1] * wall[..., 0]
    safe = np.where(cross == 0.0, 1.0, cross)
    along = (gap[..., 0] * wall[..., 1] - gap[..., 1] * wall[..., 0]) / safe
    across = (gap[..., 0] * way[..., 1] - gap[..., 1] * way[..., 0]) / safe
    meets = (cross != 0.0) & (along > 1e-9) & (along < 1.0 - 1e-9)
    meets &= (across >= 0.0) & (across <= 1.0)
    return point + along[..., None] * way, meets


def _blocked(start: FloatArray, end: FloatArray, plan: FloorPlan) -> NDArray[np.bool_]:
    return np.any(crossings(start, end, plan.start_m, plan.end_m), axis=-1)


@dataclass(frozen=True)
class LevelSequences:
    """Sequences of reflections at floor and ceiling.

    Attributes
    ----------
    order : ndarray of int, shape (V,)
        How many reflections.
    sign : ndarray, shape (V,)
        +1 or -1; the image of height z is at ``sign * z + shift``.
    shift_m : ndarray, shape (V,)
    coefficient : ndarray, shape (V,)
        Product of the reflection coefficients [-].
    """

    order: NDArray[np.int64]
    sign: FloatArray
    shift_m: FloatArray
    coefficient: FloatArray


def level_sequences(
    height_m: float, floor: float, ceiling: float, highest_order: int
) -> LevelSequences:
    """All ways by up to ``highest_order`` reflections at floor (z = 0) and ceiling."""
    rows = [(0, 1.0, 0.0, 1.0)]
    for first_is_floor in (True, False):
        sign, shift, coefficient, at_floor = 1.0, 0.0, 1.0, first_is_floor
        for order in range(1, highest_order + 1):
            sign, shift = -sign, -shift if at_floor else 2.0 * height_m - shift
            coefficient *= floor if at_floor else ceiling
            at_floor = not at_floor
            if coefficient > 0.0:
                rows.append((order, sign, shift, coefficient))
    columns = np.array(rows).T
    return LevelSequences(columns[0].astype(np.int64), columns[1], columns[2], columns[3])
