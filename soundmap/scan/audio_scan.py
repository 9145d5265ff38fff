r"""Audio scans: how loud each bearing is, ten times a second (Sect. 2.3, Eqs. 1-2).

The room's last module: it has the stream of audio cut into scans, transformed, correlated and
steered, a batch at a time, by several threads if wanted. Only a few batches are ever kept.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from threading import local
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soundmap.config import ScanConfig
from soundmap.geometry import FloatArray, Mount
from soundmap.losses import LossLedger
from soundmap.scan.cross_spectra import BaselineSpectra
from soundmap.scan.response import steered_response_power, whitening
from soundmap.scan.sample_stream import SampleStream
from soundmap.scan.spectrum import Framing, band_bins, hann_power
from soundmap.scan.steering import SteeringTable, steering_table
from soundmap.sensors import AudioBlock, MicArray
from soundmap.sound import REFERENCE_PRESSURE_PA, AudioScan, AudioScans, LevelReference

BATCH = 32
"""Scans that are steered at a time: so often is each number of the steering table used."""
BATCH_BYTES = 2**24
"""... but fewer where an array has so many baselines that their cross-spectra exceed this."""


def audio_scans(
    blocks: Iterable[AudioBlock],
    array: MicArray,
    config: ScanConfig,
    *,
    losses: LossLedger | None = None,
    threads: int = 1,
    sharp: bool = False,
) -> Iterator[AudioScan]:
    r"""Audio scans :math:`\{\theta_n(k), J_n(k)\}` of a stream of audio, in batches of about 3 s.

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
    threads : int, optional
        That many threads compute while the next blocks are read; with 1 the caller's own does. The
        scans are the same, bit for bit.
    sharp : bool, optional
        Whether to steer the whitened sound, too: `AudioScan.sharp`.

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
    with _Workers(threads) as workers:
        stream: SampleStream | None = None
        scanner: _Scanner | None = None
        for block in blocks:
            if block.samples.shape[1] != array.microphones:
                raise ValueError(
                    f"an audio block has {block.samples.shape[1]} channels, "
                    f"the array has {array.microphones} microphones"
                )
            if stream is None or scanner is None or not stream.is_continued_by(block):
                if stream is not None and scanner is not None:
                    workers.submit(scanner, *stream.rest())
                if scanner is None or not scanner.suits(block):
                    scanner = _Scanner.of(array, config, block, sharp=sharp)
                stream = SampleStream(block, scanner.framing, scanner.batch, scanner.spare)
            for batch in stream.batches(block):
                workers.submit(scanner, *batch)
                del batch
                yield from _finite(workers.results(wait=False), losses)
            del block  # a long one need not outlive its scans while the next is being read
        if stream is not None and scanner is not None:
            workers.submit(scanner, *stream.rest())
        yield from _finite(workers.results(wait=True), losses)


def kept_scans(
    scans: Iterable[AudioScan],
    reference: LevelReference,
    mount: Mount,
    sub_band_hz: tuple[float, ...] = (),
) -> AudioScans:
    """All audio scans of a run, in single precision; none without bearings if there are none.

    The sub-bands are kept where all scans tell those that are asked for, and so is sharp power.
    """
    time_ns: list[int] = []
    power, sub_bands, sharp = bytearray(), bytearray(), bytearray()  # they grow in place
    bearing_rad = np.empty(0)
    for scan in scans:
        time_ns.append(scan.time_ns)
        power += scan.power.astype(np.float32).data
        bearing_rad = scan.bearing_rad
        if scan.sub_bands is not None and len(scan.sub_bands) == len(sub_band_hz) - 1:
            sub_bands += np.ascontiguousarray(scan.sub_bands, dtype=np.float32).data
        if scan.sharp is not None:
            sharp += np.ascontiguousarray(scan.sharp, dtype=np.float32).data
    size = len(bearing_rad)
    bands = max(len(sub_band_hz) - 1, 0)
    told = len(sub_bands) == len(time_ns) * bands * size * 4 > 0
    return AudioScans(
        np.array(time_ns, dtype=np.int64),
        bearing_rad,
        np.frombuffer(power, dtype=np.float32).reshape(len(time_ns), size),
        reference,
        mount,
        np.frombuffer(sub_bands, dtype=np.float32).reshape(-1, bands, size) if told else None,
        sub_band_hz if told else (),
        np.frombuffer(sharp, dtype=np.float32).reshape(-1, size)
        if len(sharp) == len(power) > 0
        else None,
    )


def _finite(scans: Iterable[AudioScan], losses: LossLedger | None) -> Iterator[AudioScan]:
    for scan in scans:
        if np.all(np.isfinite(scan.power)):
            yield scan
        elif losses is not None:
            what = "audio scan with samples that are not finite"
            losses.add(what, "audio", effect="scan left out")


class _Workers:
    """Threads that turn batches of samples into scans, in the order in which they were given."""

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._pool = ThreadPoolExecutor(threads, "audio scan") if threads > 1 else None
        self._waiting: deque[Future[list[AudioScan]]] = deque()

    def __enter__(self) -> _Workers:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def submit(self, scanner: _Scanner, time_ns: list[int], samples: NDArray[Any]) -> None:
        if self._pool is not None:
            self._waiting.append(self._pool.submit(scanner.scans, time_ns, samples))
            return
        done: Future[list[AudioScan]] = Future()
        done.set_result(scanner.scans(time_ns, samples))
        self._waiting.append(done)

    def results(self, *, wait: bool) -> Iterator[AudioScan]:
        """Scans of the batches that are done, and of any that more than one a thread wait behind.

        Of all batches if ``wait``.
        """
        while self._waiting and (
            wait or len(self._waiting) > self._threads or self._waiting[0].done()
        ):
            yield from self._waiting.popleft().result()


def _square_of_unit(array: MicArray, full_scale: float) -> float:
    """What the square of one count is worth: in (20 uPa)^2, or (full scale)^2 if uncalibrated."""
    if array.pascal_per_count is not None:
        return (array.pascal_per_count / REFERENCE_PRESSURE_PA) ** 2
    return full_scale**-2


def _splits(frequency_hz: FloatArray, edges_hz: tuple[float, ...]) -> list[int]:
    """Index of the first bin of each sub-band but the lowest; none if one would have no bin."""
    splits = np.searchsorted(frequency_hz, edges_hz[1:-1], side="left")
    every = np.concatenate([[0], splits, [len(frequency_hz)]])
    return splits.tolist() if np.all(np.diff(every) > 0) else []


@dataclass(frozen=True)
class _Scanner:
    """What turning samples of one rate and full scale into power takes, worked out once."""

    rate_hz: float
    full_scale: float
    square_of_unit: float
    framing: Framing
    table: SteeringTable
    microphones: int
    sharp: bool
    batch: int
    """Scans in a batch."""
    spare: list[NDArray[Any]]
    """Memory of batches that are done."""
    _own: local

    @classmethod
    def of(cls, array: MicArray, config: ScanConfig, block: AudioBlock, *, sharp: bool) -> _Scanner:
        rate_hz, full_scale = block.rate_hz, block.full_scale
        framing = Framing.from_times(
            rate_hz, window_s=config.window_s, hop_s=config.hop_s, frames=config.frames
        )
        band = band_bins(rate_hz, framing.window, low_hz=config.low_hz, high_hz=config.high_hz)
        table = steering_table(
            array.positions_m,
            config.bearings,
            first_bin=band.first,
            frequency_hz=band.frequency_hz,
            weight=band.weight,
            speed_of_sound_m_s=config.speed_of_sound_m_s,
            splits=_splits(band.frequency_hz, config.sub_band_hz),
        )
        square = _square_of_unit(array, full_scale)
        batch = int(np.clip(BATCH_BYTES // (4 * np.prod(table.spectra_shape)), 4, BATCH))
        return cls(
            rate_hz,
            full_scale,
            square,
            framing,
            table,
            array.microphones,
            sharp,
            batch,
            [],
            local(),
        )

    def suits(self, block: AudioBlock) -> bool:
        """Whether the block's samples are of that rate and full scale."""
        return block.rate_hz == self.rate_hz and block.full_scale == self.full_scale

    def scans(self, time_ns: list[int], samples: NDArray[Any]) -> list[AudioScan]:
        """A batch of scans at these times from the samples (T, Q) of all, whose memory it takes.

        The powers of a scan are not finite if any of its samples is not.
        """
        spectra, finite = self._spectra(samples, len(time_ns))
        self.spare.append(samples)
        with np.errstate(invalid="ignore", over="ignore"):
            weight = whitening(spectra, self.table) if self.sharp else None
            raw, white = steered_response_power(spectra, self.table, weight)
            raw[~finite] = np.nan
            norm = self.framing.frames * hann_power(self.framing.window) * self.microphones**2
            sub_bands = raw.astype(np.float64) * (self.square_of_unit / norm)
            power = sub_bands.sum(axis=1)
            sub_bands = sub_bands.astype(np.float32)
            white = white / np.float32(self.microphones)
        return [
            AudioScan(
                time,
                self.table.bearing_rad,
                power[i],
                white[i] if self.sharp else None,
                sub_bands[i],
            )
            for i, time in enumerate(time_ns)
        ]

    def _spectra(
        self, samples: NDArray[Any], scans: int
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Cross-spectra of so many scans, and which of them are finite; the others are nought."""
        own = self._own  # each thread has memory of its own
        if not hasattr(own, "maker"):
            own.maker = BaselineSpectra(self.microphones, self.framing, self.table)
            own.spectra = np.empty((self.batch, *self.table.spectra_shape), dtype=np.float32)
        spectra = own.spectra[:scans]
        with np.errstate(invalid="ignore", over="ignore"):
            finite = own.maker.write(samples, self.framing.advance, spectra)
        return spectra, finite
