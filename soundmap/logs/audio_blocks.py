"""The samples of a log, block by block, of the microphones that can be used."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soundmap.logs.audio_messages import block_samples
from soundmap.logs.audio_stream import AudioStream
from soundmap.logs.reader import McapLog
from soundmap.logs.records import Message
from soundmap.logs.survey import AudioRecord, Survey
from soundmap.losses import LossLedger
from soundmap.sensors import AudioBlock

GREATEST_SAMPLE = 1e6
"""Floating-point samples have their full scale at 1; what is beyond all gains is damaged."""


class BlockReader:
    """Turns the messages of the microphones' topic into blocks of audio, in one pass over them.

    Parameters
    ----------
    survey, stream
        Of that topic.
    channels : ndarray of int, shape (Q,)
        Which are used.
    losses : LossLedger
        Where samples that are no numbers are counted, once however many passes there are.
    """

    def __init__(
        self, survey: Survey, stream: AudioStream, channels: NDArray[np.intp], losses: LossLedger
    ) -> None:
        self._decoders, self._stream = survey.decoders, stream
        self._channels, self._losses = channels, losses
        self._used = iter(stream.message.tolist())
        self._next_used = next(self._used, -1)
        self._message, self._block = -1, -1

    def block(self, message: Message) -> AudioBlock | None:
        """The block of the next message of the topic; None if it is not used."""
        self._message += 1
        if self._message != self._next_used:
            return None
        self._next_used = next(self._used, -1)
        self._block += 1
        stream, clock = self._stream, self._stream.clock
        if not clock.kept[self._block]:
            return None
        packet = self._decoders.reader(message.channel)(message.data)
        samples = block_samples(packet.data, stream.encoding, stream.sample)
        if len(self._channels) < stream.encoding.channels:
            samples = samples[:, self._channels]
        return AudioBlock(
            time_ns=int(clock.start_ns[self._block]),
            rate_hz=stream.rate_hz,
            samples=_without_nonsense(samples, stream, message.log_time_ns, self._losses),
            full_scale=stream.sample.full_scale,
            continues=bool(clock.continues[self._block]),
        )


def audio_blocks(
    log: McapLog,
    survey: Survey,
    stream: AudioStream,
    channels: NDArray[np.intp],
    losses: LossLedger,
) -> Iterator[AudioBlock]:
    """Blocks of audio in the order of time, by a fresh pass over the log; see `BlockReader`."""
    reader, name = BlockReader(survey, stream, channels, losses), stream.topic.name
    for message in log.messages(lambda channel: channel.topic == name):
        block = reader.block(message)
        if block is not None:
            yield block


def _without_nonsense(
    samples: NDArray[Any], stream: AudioStream, logged_ns: int, losses: LossLedger
) -> NDArray[Any]:
    """Samples with those that are no numbers, or no pressures, replaced by silence."""
    if samples.dtype.kind != "f":
        return samples
    sound = np.abs(samples) < GREATEST_SAMPLE
    if np.all(sound):
        return samples
    record = stream.topic.record
    if isinstance(record, AudioRecord) and logged_ns > record.judged_ns:
        record.judged_ns = logged_ns
        losses.add(
            "audio sample is not a number",
            stream.name,
            count=samples.size - int(np.count_nonzero(sound)),
            effect="taken for silence",
            time_ns=logged_ns,
        )
    return np.where(sound, samples, samples.dtype.type(0.0))
