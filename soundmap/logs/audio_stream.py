"""How the microphones are to be read: encoding, sample times, place on the robot."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.config import Config
from soundmap.errors import ConfigError, NothingUsableError
from soundmap.geometry import Mount
from soundmap.logs.audio_messages import (
    STAMP_IS_START,
    AudioEncoding,
    AudioFormatError,
    SampleFormat,
)
from soundmap.logs.messages import Kind
from soundmap.logs.mounts import Mounts, nearest_names
from soundmap.logs.sample_clock import SampleClock, sample_clock
from soundmap.logs.stamps import DAMAGED, Times, on_common_clock, stream_times
from soundmap.logs.survey import AudioRecord, Survey, Topic
from soundmap.logs.topics import audio_topic
from soundmap.losses import LossLedger
from soundmap.sensors import MicArray

WRONG_RATE_PPM = 2000.0
"""No quartz is that far off its rate: the recorder tells a wrong one."""


@dataclass(frozen=True)
class AudioStream:
    """How to read the microphones.

    Attributes
    ----------
    topic : Topic
    encoding : AudioEncoding
    sample : SampleFormat
    message : ndarray of int, shape (B,)
        Which messages of the topic are used.
    clock : SampleClock
        Of these messages.
    stamp_is_start : bool
    """

    topic: Topic
    encoding: AudioEncoding
    sample: SampleFormat
    message: NDArray[np.intp]
    clock: SampleClock
    stamp_is_start: bool
    counts_gaps = True

    @property
    def name(self) -> str:
        """The topic."""
        return self.topic.name

    @property
    def logged_ns(self) -> Times:
        """When the blocks used were logged, rising."""
        record = self.topic.record
        logged = record.log_time_ns if isinstance(record, AudioRecord) else ()
        return np.sort(np.array(logged, dtype=np.int64)[self.message[self.clock.kept]])

    @property
    def rate_hz(self) -> float:
        """Sample rate [Hz]: as the recorder tells it, or by the stamps if that must be wrong."""
        told = abs(self.clock.drift_ppm) <= WRONG_RATE_PPM
        return self.encoding.rate_hz if told else self.clock.rate_hz


def audio_stream(
    survey: Survey, config: Config, ahead_ns: int | None, log_name: str, losses: LossLedger
) -> AudioStream:
    """How to read the microphones.

    ``ahead_ns`` is how far the odometry's stamps are ahead of the log's time, if there are any.

    Raises
    ------
    ConfigError
        The topic is not settled, or does not fit the array.
    NothingUsableError
        There is no audio, or none that can be read.
    """
    topic = audio_topic(survey, config, log_name)
    record = topic.record
    if not isinstance(record, AudioRecord):
        raise NothingUsableError(f"{log_name}: {topic.name} cannot be read ({topic.problem}).")
    encoding, sample = _audio_encoding(survey, topic, record, log_name)
    kept, frames = _whole_blocks(record, encoding, sample, topic.name, losses)
    if not len(kept):
        raise NothingUsableError(
            f"{log_name}: no usable audio on {topic.name}: none of {topic.messages} messages is "
            "sound."
        )
    times, own_ahead_ns = stream_times(
        record.stamp_ns,
        record.log_time_ns,
        topic.name,
        losses,
        reference_ahead_ns=ahead_ns,
    )
    if ahead_ns is not None:
        times = on_common_clock(times, own_ahead_ns, ahead_ns, topic.name, losses)
    stamped = times[kept] != DAMAGED
    kept, frames = kept[stamped], frames[stamped]
    stamps = times[kept]
    setting = config.audio.stamp
    is_start = STAMP_IS_START[record.form] if setting == "auto" else setting == "start"
    counter = np.array(record.first_frame, dtype=np.int64)[kept]
    clock = sample_clock(
        stamps,
        frames,
        encoding.rate_hz,
        stamp_is_start=is_start,
        first_frame=None if np.any(counter < 0) else counter,
    )
    logged_ns = np.array(record.log_time_ns, dtype=np.int64)
    _count_clock_losses(clock, topic.name, logged_ns[kept], losses)
    return AudioStream(topic, encoding, sample, kept, clock, is_start)


def _count_clock_losses(
    clock: SampleClock, topic: str, logged_ns: Times, losses: LossLedger
) -> None:
    losses.add(
        "audio block repeats or overlaps the one before",
        topic,
        count=int(np.count_nonzero(~clock.kept)),
        effect="left out",
        time_ns=logged_ns[~clock.kept],
    )
    overlaps = int(np.count_nonzero(clock.overlaps))
    losses.add(
        "audio block begins before the end of the one before",
        topic,
        count=overlaps,
        effect="the two are not joined",
        time_ns=logged_ns[clock.overlaps],
    )
    losses.add(
        "gap in the audio",
        topic,
        count=clock.gaps - overlaps,
        effect=f"{clock.lost_s:.2f} s missing; nothing is joined over it",
        time_ns=logged_ns[clock.kept & ~clock.continues & ~clock.overlaps][1:],
    )
    if abs(clock.drift_ppm) > WRONG_RATE_PPM:
        losses.add(
            f"the sample rate by the stamps is {clock.rate_hz:.0f} Hz, not the recorder's",
            topic,
            effect="times and frequencies follow the stamps",
        )


def _audio_encoding(
    survey: Survey, topic: Topic, record: AudioRecord, log_name: str
) -> tuple[AudioEncoding, SampleFormat]:
    """The encoding of most messages; that of an audio info where messages do not tell."""
    votes = Counter(index for index in record.encoding if index >= 0)
    if not votes:
        raise NothingUsableError(
            f"{log_name}: no usable audio on {topic.name}: all {topic.messages} messages are "
            "damaged."
        )
    encoding = record.encodings[votes.most_common(1)[0][0]]
    if encoding is None:
        infos = [t for t in survey.of_kind(Kind.AUDIO_INFO) if t.info is not None or t.problem]
        if not infos:
            raise NothingUsableError(
                f"{log_name}: {topic.name} does not tell rate and channels, and the log has no "
                "audio info message (it is sent once, when the driver starts). Start the recording "
                "before the driver."
            )
        name = topic.name
        info = max(infos, key=lambda t: (_common_prefix(t.name, name), t.name))
        if info.info is None:
            raise NothingUsableError(f"{log_name}: {info.name}: {info.problem}.")
        encoding = info.info
    try:
        return encoding, encoding.sample_format()
    except AudioFormatError as error:
        raise NothingUsableError(f"{log_name}: topic {topic.name}: {error}.") from None


def _common_prefix(first: str, second: str) -> int:
    length = 0
    for a, b in zip(first, second, strict=False):
        if a != b:
            break
        length += 1
    return length


def _whole_blocks(
    record: AudioRecord,
    encoding: AudioEncoding,
    sample: SampleFormat,
    topic: str,
    losses: LossLedger,
) -> tuple[NDArray[np.intp], Times]:
    """Messages of the chosen encoding whose length is as declared, and their lengths."""
    index = np.array(record.encoding, dtype=np.int64)
    logged_ns = np.array(record.log_time_ns, dtype=np.int64)
    chosen = [i for i, e in enumerate(record.encodings) if e is None or e == encoding]
    usable = np.isin(index, chosen)
    losses.add(
        "audio block in another format than most",
        topic,
        count=int(np.count_nonzero(~usable & (index >= 0))),
        effect="left out",
        time_ns=logged_ns[~usable & (index >= 0)],
    )
    size = np.array(record.size, dtype=np.int64)
    frames, rest = np.divmod(size, encoding.channels * sample.width)
    declared = np.array(record.declared_frames, dtype=np.int64)
    whole = (rest == 0) & (frames > 0) & ((declared <= 0) | (declared == frames))
    losses.add(
        "audio block is not as long as its header says",
        topic,
        count=int(np.count_nonzero(usable & ~whole)),
        effect="left out",
        time_ns=logged_ns[usable & ~whole],
    )
    kept = np.flatnonzero(usable & whole)
    return kept, frames[kept]


def microphone_array(
    config: Config, stream: AudioStream, mounts: Mounts, log_name: str
) -> MicArray:
    """The microphones where the configuration and the log put them.

    Raises
    ------
    ConfigError
        Channels and microphones differ in number, or the mount is unknown.
    """
    positions = config.array.microphone_positions()
    if len(positions) != stream.encoding.channels:
        raise ConfigError(
            f"{log_name}: topic {stream.topic.name} has {stream.encoding.channels} channels, the "
            f"array in the configuration has {len(positions)} microphones. Choose the topic with "
            '[topics] audio = "...", or give the matching robot file with --config.'
        )
    return MicArray(
        positions,
        _array_mount(config, stream, mounts, log_name),
        config.array.pascal_per_count,
    )


def _array_mount(config: Config, stream: AudioStream, mounts: Mounts, log_name: str) -> Mount:
    if config.array.mount is not None:
        return Mount.planar(*config.array.mount)
    advice = "Set [array] frame, or [array] mount = [x, y, z, yaw_rad]."
    if config.array.frame is not None:
        frame = config.array.frame.removeprefix("/")
        found = mounts.get(frame)
        if found is None:
            near = nearest_names(frame, mounts.tree.frames)
            hint = f" Did you mean {near}?" if near else ""
            raise ConfigError(
                f"{log_name}: [array] frame = {frame!r} is not in the log. Frames known: "
                f"{', '.join(mounts.tree.frames) or 'none'}.{hint} {advice}"
            )
        return mounts.credible(found, frame)
    record = stream.topic.record
    own = record.frame_ids.most_common(1)[0][0] if isinstance(record, AudioRecord) else ""
    for frame in (own, "mic_array"):
        found = mounts.get(frame) if frame else None
        if found is not None:
            return mounts.credible(found, frame)
    known = ", ".join(mounts.tree.frames) or "none"
    told = f"its audio names {own!r}" if own else "its audio names no frame"
    raise ConfigError(
        f"{log_name}: where the microphone array is mounted is unknown: {told}, and there is no "
        f"'mic_array'. Frames known: {known}. {advice}"
    )
