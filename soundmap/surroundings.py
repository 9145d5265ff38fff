"""What the lasers saw around the robot during a run, thinned to what later stages look at.

What is seen in one direction changes little from one time to the next. So points are kept as
differences of their bits, packed a block of times at a time; they come back to the bit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import zstandard
from numpy.typing import ArrayLike, NDArray

BLOCK = 256
"""Times that are packed together."""


@dataclass(frozen=True)
class Surroundings:
    """Laser points of all scanners around the robot, about ten times a second.

    Half a degree between points, half precision (4 mm at 8 m) and packing keep an hour in 60 MB.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (G,)
        Increasing [ns since epoch].
    directions : int
        :math:`M`, directions from the base in which there may be a point.
    packed : ndarray of uint8, shape (L,)
        The points, `BLOCK` times after `BLOCK` times.
    end : ndarray of int64, shape (ceil(G / BLOCK),)
        Where each block ends in ``packed``.
    """

    time_ns: NDArray[np.int64]
    directions: int
    packed: NDArray[np.uint8]
    end: NDArray[np.int64]

    def __post_init__(self) -> None:
        if len(self.end) != -(-len(self.time_ns) // BLOCK):
            raise ValueError("surroundings need points at every time")

    def __len__(self) -> int:
        return len(self.time_ns)

    def points(self, index: NDArray[np.integer[Any]]) -> NDArray[np.float16]:
        """Points at some of the times, shape (K, M, 2).

        x, y in the base frame at that time [m]: of all points the one nearest to each direction;
        NaN where none is near.
        """
        points = np.empty((len(index), self.directions, 2), dtype=np.float16)
        blocks = index // BLOCK
        for block in np.unique(blocks).tolist():
            own = blocks == block
            points[own] = self._block(block)[index[own] - block * BLOCK]
        return points

    def _block(self, block: int) -> NDArray[np.float16]:
        start = self.end[block - 1] if block else 0
        data = zstandard.ZstdDecompressor().decompress(self.packed[start : self.end[block]].data)
        low, high = np.frombuffer(data, dtype=np.uint8).reshape(2, -1, self.directions, 2)
        change = low | high.astype(np.uint16) << 8
        return np.cumsum(change, axis=0, dtype=np.uint16).view(np.float16)

    def nearest(self, time_ns: ArrayLike, *, within_ns: int) -> NDArray[np.intp]:
        """Index of the surroundings nearest to each time, shape (...); -1 where none is near."""
        wanted = np.asarray(time_ns, dtype=np.int64)
        if len(self) == 0:
            return np.full(wanted.shape, -1, dtype=np.intp)
        right = np.clip(np.searchsorted(self.time_ns, wanted), 0, len(self) - 1)
        left = np.maximum(right - 1, 0)
        off_left, off_right = (np.abs(self.time_ns[i] - wanted) for i in (left, right))
        best = np.where(off_left <= off_right, left, right)
        return np.where(np.minimum(off_left, off_right) <= within_ns, best, -1)


class SurroundingsPacker:
    """Takes points time by time, and packs them as soon as there is a block.

    Parameters
    ----------
    directions : int
    """

    def __init__(self, directions: int) -> None:
        self._directions = directions
        self._packer = zstandard.ZstdCompressor(level=1)
        self._time_ns: list[int] = []
        self._open: list[NDArray[np.float16]] = []
        self._packed = bytearray()  # grows in place
        self._end: list[int] = []

    @property
    def last_ns(self) -> int | None:
        """The latest time so far."""
        return self._time_ns[-1] if self._time_ns else None

    def add(self, time_ns: int, points: NDArray[np.floating[Any]]) -> None:
        """Take the points (M, 2) at a time later than all before."""
        self._time_ns.append(time_ns)
        self._open.append(points.astype(np.float16))
        if len(self._open) == BLOCK:
            self._pack()

    def surroundings(self) -> Surroundings:
        """All that was taken; to be called once, at the end."""
        if self._open:
            self._pack()
        return Surroundings(
            np.array(self._time_ns, dtype=np.int64),
            self._directions,
            np.frombuffer(self._packed, dtype=np.uint8),
            np.array(self._end, dtype=np.int64),
        )

    def _pack(self) -> None:
        bits = np.stack(self._open).view(np.uint16)
        self._open.clear()
        bits[1:] -= bits[:-1].copy()
        low, high = (bits & 0xFF).astype(np.uint8), (bits >> 8).astype(np.uint8)
        self._packed += self._packer.compress(low.tobytes() + high.tobytes())
        self._end.append(len(self._packed))


NO_SURROUNDINGS = SurroundingsPacker(0).surroundings()
"""What is left of surroundings when nobody needs them any more."""
