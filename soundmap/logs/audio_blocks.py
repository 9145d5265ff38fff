"""The samples of a log, block by block, of the microphones that can be used."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soundmap.logs.audio_messages import PACKET_READERS, block_samples
from soundmap.logs.audio_stream import AudioStream
from soundmap.logs.reader import McapLog
from soundmap.logs.survey import AudioRecord, Survey
from soundmap.losses import LossLedger
from soundmap.sensors import AudioBlock

GREATEST_SAMPLE = 1e6
"""Floating-point samples have their full scale at 1; what is beyond all gains is damaged."""


def audio_blocks(
    log: McapLog,
    survey: Survey,
    stream: AudioStream,
    channels: NDArray[np.intp],
    losses: LossLedger,
) -> Iterator[AudioBlock]:
    """Blocks of audio in the order of time, by a fresh pass over the log.

    Parameters
    ----------
    log, survey, stream
        Of the microphones' topic.
    channels : ndarray of int, shape (Q,)
        Which are used.
    losses : LossLedger
        Where samples that are no numbers are counted, once however many passes there are.
    """
    clock, name = stream.clock, stream.topic.name
    read = PACKET_READERS[stream.topic.form]
    used, block = stream.message.tolist(), 0
    for number, message in enumerate(log.messages(lambda channel: channel.topic == name)):
        if block == len(used):
            return
        if number != used[block]:
            continue
        if clock.kept[block]:
            packet = read(survey.decoders.decoder(message.channel)(message.data))
            samples = block_samples(packet.data, stream.encoding, stream.sample)
            if len(channels) < stream.encoding.channels:
                samples = samples[:, channels]
            yield AudioBlock(
                time_ns=int(clock.start_ns[block]),
                rate_hz=stream.rate_hz,
                samples=_without_nonsense(samples, stream, message.log_time_ns, losses),
                full_scale=stream.sample.full_scale,
                continues=bool(clock.continues[block]),
            )
        block += 1


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
