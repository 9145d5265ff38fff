"""The samples of a stream of audio, cut into batches of scans, and when each scan was taken.

Samples are copied once, from the block in which they were read to the batch in which they are
looked at; a batch's memory serves again when its scans are done.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soundmap.scan.spectrum import Framing
from soundmap.sensors import AudioBlock

Samples = NDArray[Any]


class SampleStream:
    """The samples since the last gap that no batch has held yet; never more than a batch.

    Parameters
    ----------
    block : AudioBlock
        The first; its rate and full scale are the stream's.
    framing : Framing
        Of the scans.
    scans : int
        Scans in a batch.
    spare : list of ndarray
        Memory of batches that are done, to be used again. Whoever is done with one appends it.
    """

    def __init__(
        self, block: AudioBlock, framing: Framing, scans: int, spare: list[Samples]
    ) -> None:
        self._rate_hz = block.rate_hz
        self._full_scale = block.full_scale
        self._framing = framing
        self._scans = scans
        self._spare = spare
        length = (scans - 1) * framing.advance + framing.span
        self._shape = (length, block.samples.shape[1])
        self._samples = self._memory(block.samples.dtype)
        self._filled = 0
        self._first = 0
        self._block_first: list[int] = []
        self._block_time_ns: list[int] = []

    def is_continued_by(self, block: AudioBlock) -> bool:
        """Whether scans may run on into a block."""
        same = block.rate_hz == self._rate_hz and block.full_scale == self._full_scale
        return block.continues and same

    def batches(self, block: AudioBlock) -> Iterator[tuple[list[int], Samples]]:
        """Take in the samples that follow; the batches that they complete.

        Yields
        ------
        time_ns : list of int
            Middle of each scan, by the clock of the block that holds it.
        samples : ndarray, shape (T, Q)
            Of all scans, in memory of their own.
        """
        samples = block.samples
        if len(samples) == 0:
            return
        self._block_first.append(self._first + self._filled)
        self._block_time_ns.append(block.time_ns)
        if samples.dtype != self._samples.dtype:
            before = self._samples
            self._samples = self._memory(np.result_type(before, samples))
            self._samples[: self._filled] = before[: self._filled]
        while len(samples):
            part = samples[: self._shape[0] - self._filled]
            self._samples[self._filled : self._filled + len(part)] = part
            self._filled += len(part)
            samples = samples[len(part) :]
            if self._filled == self._shape[0]:
                times = self._times_ns(self._scans)
                done = self._samples
                self._begin_the_next()
                yield times, done

    def rest(self) -> tuple[list[int], Samples]:
        """The scans that do not fill a batch, maybe none, as above. The stream has ended."""
        scans = (self._filled - self._framing.span) // self._framing.advance + 1
        return self._times_ns(max(scans, 0)), self._samples[: self._filled]

    def _begin_the_next(self) -> None:
        """Begin a batch with the samples that its first scan shares with the last of this one."""
        advance = self._scans * self._framing.advance
        shared = self._samples[advance : self._filled]
        self._samples = self._memory(self._samples.dtype)
        self._samples[: len(shared)] = shared
        self._filled = len(shared)
        self._first += advance
        known = bisect_right(self._block_first, self._first) - 1
        del self._block_first[:known], self._block_time_ns[:known]

    def _memory(self, kind: np.dtype[Any]) -> Samples:
        while self._spare:
            samples = self._spare.pop()
            if samples.shape == self._shape and samples.dtype == kind:
                return samples
        return np.empty(self._shape, dtype=kind)

    def _times_ns(self, scans: int) -> list[int]:
        """Middles of so many scans."""
        half = (self._framing.span - 1) / 2.0
        times = []
        for scan in range(scans):
            middle = self._first + scan * self._framing.advance + half
            block = bisect_right(self._block_first, middle) - 1
            since = (middle - self._block_first[block]) * 1e9 / self._rate_hz
            times.append(self._block_time_ns[block] + round(since))
        return times
