r"""Audio scans: how loud each bearing is, ten times a second (Sect. 2.3, Eqs. 1-2).

The room's last module: it cuts the stream of audio into scans, says when each was taken, and has
it transformed, correlated and steered. Only one scan's worth of samples is ever kept.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soundmap.config import ScanConfig
from soundmap.geometry import FloatArray
from soundmap.losses import LossLedger
from soundmap.scan.response import steered_response_power
from soundmap.scan.spectrum import (
    Band,
    Framing,
    band_bins,
    band_spectrum,
    cross_spectral_matrix,
    hann_power,
)
from soundmap.scan.steering import SteeringTable, steering_table
from soundmap.sensors import AudioBlock, MicArray
from soundmap.sound import REFERENCE_PRESSURE_PA, AudioScan


def audio_scans(
    blocks: Iterable[AudioBlock],
    array: MicArray,
    config: ScanConfig,
    *,
    losses: LossLedger | None = None,
) -> Iterator[AudioScan]:
    r"""Audio scans :math:`\{\theta_n(k), J_n(k)\}` of a stream of audio, each once it is complete.

    A scan averages ``config.frames`` frames, and the next one starts that many shifts later:
    every 100 ms by default. Lengths are whole samples (see :meth:`Framing.from_times`). No scan
    reaches across a gap: where a block does not continue the one before, or its sample rate or
    full scale differ, scans start anew and the samples left over are dropped. A plane wave of
    in-band rms p from bearing n gives :math:`J_n = p^2`, whatever the recorder's offset.

    Parameters
    ----------
    blocks : iterable of AudioBlock
        Of any length, in order of time.
    array : MicArray
        Its ``pascal_per_count``, if given, makes power refer to (20 uPa)^2, else to (full
        scale)^2.
    config : ScanConfig
    losses : LossLedger, optional
        Counts scans left out because samples in them were not finite.

    Yields
    ------
    AudioScan
        Its time is that of the middle between its first and its last sample, in the time of the
        block that holds this middle.

    Raises
    ------
    ValueError
        If a block has not one channel a microphone, or the band does not fit its sample rate.
    """
    stream: _Stream | None = None
    scanner: _Scanner | None = None
    for block in blocks:
        if block.samples.shape[1] != array.microphones:
            raise ValueError(
                f"an audio block has {block.samples.shape[1]} channels, "
                f"the array has {array.microphones} microphones"
            )
        if scanner is None or scanner.rate_hz != block.rate_hz:
            scanner = _Scanner.of(array, config, block.rate_hz)
        if stream is None or not stream.is_continued_by(block):
            stream = _Stream(block.rate_hz, block.full_scale, scanner.framing)
        stream.append(block)
        square = _square_of_unit(array, block.full_scale)
        del block  # a long one need not outlive its scans while the next is being read
        yield from _complete_scans(stream, scanner, square, losses)
        stream.keep_only_what_is_needed()


def _complete_scans(
    stream: _Stream, scanner: _Scanner, square_of_unit: float, losses: LossLedger | None
) -> Iterator[AudioScan]:
    """The scans whose samples are all there."""
    while (excerpt := stream.next_excerpt()) is not None:
        time_ns, samples = excerpt
        power = scanner.power(samples) * square_of_unit
        if np.all(np.isfinite(power)):
            yield AudioScan(time_ns, scanner.table.bearing_rad, power)
        elif losses is not None:
            what = "audio scan with samples that are not finite"
            losses.add(what, "audio", effect="scan left out")


def _square_of_unit(array: MicArray, full_scale: float) -> float:
    """What the square of one count is worth: in (20 uPa)^2, or (full scale)^2 if uncalibrated."""
    if array.pascal_per_count is not None:
        return (array.pascal_per_count / REFERENCE_PRESSURE_PA) ** 2
    return full_scale**-2


@dataclass(frozen=True)
class _Scanner:
    """What turning samples of one rate into power takes, worked out once."""

    rate_hz: float
    framing: Framing
    band: Band
    table: SteeringTable

    @classmethod
    def of(cls, array: MicArray, config: ScanConfig, rate_hz: float) -> _Scanner:
        framing = Framing.from_times(
            rate_hz, window_s=config.window_s, hop_s=config.hop_s, frames=config.frames
        )
        band = band_bins(rate_hz, framing.window, low_hz=config.low_hz, high_hz=config.high_hz)
        table = steering_table(
            array.positions_m,
            config.bearings,
            frequency_hz=band.frequency_hz,
            weight=band.weight,
            speed_of_sound_m_s=config.speed_of_sound_m_s,
        )
        return cls(rate_hz, framing, band, table)

    def power(self, samples: NDArray[Any]) -> FloatArray:
        """:math:`J_n` of the samples of one scan, (span, Q) -> (N,) [count^2].

        Not finite if any sample is not.
        """
        with np.errstate(invalid="ignore", over="ignore"):
            channels = np.ascontiguousarray(samples.T).astype(np.float32)
            span = channels.shape[1]
            offset = channels @ np.full(span, 1.0 / span, dtype=np.float32)
            if not np.all(np.isfinite(offset)):
                return np.full(self.table.bearing_rad.shape, np.nan)
            channels -= offset[:, None]
            spectrum = band_spectrum(channels, self.framing, self.band)
            power = steered_response_power(cross_spectral_matrix(spectrum), self.table)
            squared_microphones = samples.shape[1] ** 2
            norm = self.framing.frames * hann_power(self.framing.window) * squared_microphones
            return power / norm


@dataclass(frozen=True)
class _Piece:
    """Consecutive samples of one block; ``first`` and ``origin`` count since the last gap."""

    first: int
    samples: NDArray[Any]
    origin: int
    """First sample of the block, which was taken at ``time_ns``."""
    time_ns: int

    @property
    def end(self) -> int:
        return self.first + len(self.samples)

    def copy(self, start: int) -> _Piece:
        """What is left from ``start`` on, in memory of its own."""
        done = max(start - self.first, 0)
        return _Piece(self.first + done, self.samples[done:].copy(), self.origin, self.time_ns)


class _Stream:
    """The samples since the last gap that are still needed, and when they were taken."""

    def __init__(self, rate_hz: float, full_scale: float, framing: Framing) -> None:
        self._rate_hz = rate_hz
        self._full_scale = full_scale
        self._framing = framing
        self._pieces: deque[_Piece] = deque()
        self._end = 0
        self._next = 0

    def is_continued_by(self, block: AudioBlock) -> bool:
        """Whether scans may run on into a block."""
        same = block.rate_hz == self._rate_hz and block.full_scale == self._full_scale
        return block.continues and same

    def append(self, block: AudioBlock) -> None:
        """Take in the samples that follow."""
        if len(block.samples):
            self._pieces.append(_Piece(self._end, block.samples, self._end, block.time_ns))
            self._end += len(block.samples)

    def next_excerpt(self) -> tuple[int, NDArray[Any]] | None:
        """Middle [ns] and samples (span, Q) of the next scan; None until they are complete."""
        start, stop = self._next, self._next + self._framing.span
        if stop > self._end:
            return None
        samples = [
            piece.samples[max(start - piece.first, 0) : stop - piece.first]
            for piece in self._pieces
            if piece.first < stop and piece.end > start
        ]
        time_ns = self._time_ns(start + (self._framing.span - 1) / 2.0)
        self._next += self._framing.advance
        return time_ns, samples[0] if len(samples) == 1 else np.concatenate(samples)

    def _time_ns(self, sample: float) -> int:
        """Time of a sample, or of a point between two, by the clock of the block that holds it."""
        piece = next(piece for piece in reversed(self._pieces) if piece.first <= sample)
        return piece.time_ns + round((sample - piece.origin) * 1e9 / self._rate_hz)

    def keep_only_what_is_needed(self) -> None:
        """Let go of what scans are done with: never more than the samples of one scan are kept.

        To be called after every block, the newest piece being the caller's memory until then.
        """
        if self._pieces:
            self._pieces.append(self._pieces.pop().copy(self._next))
        while self._pieces and self._pieces[0].end <= self._next:
            self._pieces.popleft()
