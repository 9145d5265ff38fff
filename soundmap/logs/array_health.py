"""Faulty microphones of a log: found, reported, and left out of the array."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from soundmap.errors import NothingUsableError
from soundmap.geometry import FloatArray
from soundmap.logs.audio_messages import block_samples
from soundmap.logs.audio_stream import AudioStream
from soundmap.logs.microphones import MicrophoneHealth, microphone_health
from soundmap.logs.survey import AudioRecord
from soundmap.losses import LossLedger
from soundmap.sensors import MicArray


def array_health(
    stream: AudioStream, positions_m: FloatArray | None, losses: LossLedger
) -> MicrophoneHealth | None:
    """Health of the microphones by the probes of the survey; None if there are no probes.

    Parameters
    ----------
    stream : AudioStream
    positions_m : ndarray, shape (Q, 3), or None
        Where the microphones are in the array, if that is known.
    losses : LossLedger
        Where faults are counted.
    """
    numbers, probes = _probes(stream)
    if not probes:
        return None
    health = microphone_health(probes, stream.rate_hz, positions_m)
    record = stream.topic.record
    logged = record.log_time_ns if isinstance(record, AudioRecord) else ()
    _count_faults(health, stream.name, np.array(logged, dtype=np.int64)[numbers], losses)
    return health


def without_faulty(
    array: MicArray, health: MicrophoneHealth | None, log_name: str
) -> tuple[MicArray, NDArray[np.intp]]:
    """The array of the sound microphones, and their channels.

    Raises
    ------
    NothingUsableError
        Fewer than two are sound.
    """
    sound = np.ones(array.microphones, dtype=bool) if health is None else health.sound
    channels = np.flatnonzero(sound)
    if health is not None and np.all(health.level_db == -np.inf):
        raise NothingUsableError(
            f"{log_name}: nothing but silence: all samples of a microphone are the same, and so it "
            "is with all of them. Check that they were switched on."
        )
    if len(channels) < 2 <= array.microphones:
        raise NothingUsableError(
            f"{log_name}: {len(channels)} of {array.microphones} microphones deliver sound that "
            "can be used, expected at least 2. Check the microphones, their cables and their gains."
        )
    return replace(array, positions_m=array.positions_m[channels]), channels


def _probes(stream: AudioStream) -> tuple[list[int], list[NDArray[np.floating]]]:
    """Numbers of the messages that were probed, and their samples; 1 is full scale."""
    record = stream.topic.record
    if not isinstance(record, AudioRecord):
        return [], []
    encoding, sample = stream.encoding, stream.sample
    frame_bytes = encoding.channels * sample.width
    numbers: list[int] = []
    probes: list[NDArray[np.floating]] = []
    for number in stream.message.tolist():
        data = record.probes.get(number, b"")
        if encoding.planar and len(data) < record.size[number]:
            continue
        frames = len(data) // frame_bytes
        if frames > 1:
            samples = block_samples(data[: frames * frame_bytes], encoding, sample)
            numbers.append(number)
            probes.append(samples / sample.full_scale)
    return numbers, probes


def _count_faults(
    health: MicrophoneHealth, topic: str, logged_ns: NDArray[np.int64], losses: LossLedger
) -> None:
    dead = health.dead
    faults = (
        ("microphone is dead", dead, health.silent.any(axis=1)),
        ("microphone far weaker or louder than the others", health.odd_level & ~dead, None),
        ("microphone is connected the wrong way round", health.inverted, None),
        ("microphone hears something else than its neighbours", health.unrelated, None),
    )
    for what, which, when in faults:
        losses.add(
            what,
            topic,
            count=int(np.count_nonzero(which)),
            effect=f"{_channels(which)} left out of the array",
            time_ns=() if when is None else logged_ns[when],
        )
    clips = health.clipped_share > 0.0
    losses.add(
        "microphone clips",
        topic,
        count=int(np.count_nonzero(clips)),
        effect=f"{_channels(clips)}: {100 * health.clipped_share.max():.2g} % of the samples; used",
        time_ns=logged_ns[health.clipped.any(axis=1)],
    )


def _channels(which: NDArray[np.bool_]) -> str:
    numbers = ", ".join(str(i) for i in np.flatnonzero(which))
    return f"channel{'s' if np.count_nonzero(which) > 1 else ''} {numbers} (from 0)"
