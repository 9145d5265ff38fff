"""How each stream of a log is to be read: what the survey and the configuration settle together."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.config import Config
from soundmap.errors import ConfigError, NothingUsableError
from soundmap.geometry import Mount, Trajectory
from soundmap.logs.audio_messages import (
    STAMP_IS_START,
    AudioEncoding,
    AudioFormatError,
    SampleFormat,
)
from soundmap.logs.messages import Kind
from soundmap.logs.mounts import FrameTree, Mounts, nearest_names
from soundmap.logs.odometry import OdometryRecord, increasing, odometry_trajectory
from soundmap.logs.sample_clock import SampleClock, sample_clock
from soundmap.logs.survey import DAMAGED, AudioRecord, LaserRecord, Survey, Topic
from soundmap.logs.topics import audio_topic, laser_topics, nothing_of, odometry_topic
from soundmap.losses import LossLedger
from soundmap.sensors import TILT_WARNING_RAD, MicArray

Times = NDArray[np.int64]


@dataclass(frozen=True)
class OdometryStream:
    """The base in the odometry frame, and where that comes from.

    ``source`` is "pose", "twist" or "transform".
    """

    topic: str
    trajectory: Trajectory
    source: str
    parent: str
    child: str


@dataclass(frozen=True)
class LaserStream:
    """How to read one scanner.

    Attributes
    ----------
    topic : Topic
    time_ns : ndarray of int64, shape (M,)
        Time of the first ray of every message of the topic; ``DAMAGED`` where it is left out.
    ray_interval_is_sound : bool
    range_max_m : float
        For messages that do not tell.
    mounts : dict
        By frame.
    """

    topic: Topic
    record: LaserRecord
    time_ns: Times
    ray_interval_is_sound: bool
    range_max_m: float
    mounts: dict[str, Mount]


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


def odometry_stream(
    survey: Survey, config: Config, log_name: str, losses: LossLedger
) -> OdometryStream:
    """The base by its own account, from an odometry topic, else from the transform that moves.

    Raises
    ------
    ConfigError, NothingUsableError
        The topic is not settled; there is none; or nothing in it is sound.
    """
    topic = odometry_topic(survey, config, log_name)
    if topic is None:
        name, record = _moving_transform(survey, config, log_name)
    else:
        if not isinstance(topic.record, OdometryRecord):
            raise NothingUsableError(f"{log_name}: {topic.name} cannot be read ({topic.problem}).")
        name, record = topic.name, topic.record
    times = stamps_or_log_times(record.stamp_ns, record.log_time_ns, name, losses)
    trajectory, source = odometry_trajectory(times, record.table(), name, losses)
    if len(trajectory) < 2:
        raise NothingUsableError(
            f"{log_name}: no usable odometry on {name}: {len(record)} messages, "
            f"{len(trajectory)} of them sound. Check the robot's odometry."
        )
    return OdometryStream(
        name, trajectory, "transform" if topic is None else source, record.parent, record.child
    )


def _moving_transform(survey: Survey, config: Config, log_name: str) -> tuple[str, OdometryRecord]:
    """The transform that carries the sensors: the first that moves on the way up from them."""
    moving = survey.transforms.moving()
    still = {
        names: edge
        for names, edge in survey.transforms.edges.items()
        if not edge.static and edge.count > 1
    }
    wanted = config.topics.odometry
    for edges in (moving, still):
        candidates = {n: e for n, e in edges.items() if wanted in (None, e.topic)}
        if not candidates:
            continue
        fixed = {n: m for n, m in survey.transforms.fixed().items() if n not in candidates}
        tree = FrameTree(fixed)
        roots = Counter(tree.root(frame) for frame in _sensor_frames(survey))
        children = {child: edge for (_, child), edge in candidates.items()}
        for root, _ in roots.most_common():
            if root in children:
                return children[root].topic, children[root].record
        if len(candidates) == 1:
            edge = next(iter(candidates.values()))
            return edge.topic, edge.record
        if edges is moving:
            names = ", ".join(f"{p} -> {c}" for p, c in candidates)
            raise ConfigError(
                f"{log_name}: no odometry topic, and several transforms move ({names}), none of "
                "them the root of a sensor's frame. Record odometry, or the transforms in between."
            )
    raise NothingUsableError(nothing_of(survey, Kind.ODOMETRY, log_name))


def _sensor_frames(survey: Survey) -> list[str]:
    frames: list[str] = []
    for topic in survey.of_kind(Kind.LASER) + survey.of_kind(Kind.AUDIO):
        if isinstance(topic.record, LaserRecord | AudioRecord):
            frames += [frame for frame in topic.record.frame_ids if frame]
    return frames


def stamps_or_log_times(stamps: object, log_times: object, topic: str, losses: LossLedger) -> Times:
    """Header stamps, or the log's own time where no stamp was ever set; damaged ones stay."""
    stamp, log_time = np.array(stamps, dtype=np.int64), np.array(log_times, dtype=np.int64)
    unset = stamp == 0
    losses.remark(
        "message without a stamp",
        topic,
        count=int(np.count_nonzero(unset)),
        effect="time of logging used instead",
    )
    return np.where(unset, log_time, stamp)


def base_mounts(
    survey: Survey, config: Config, odometry: OdometryStream, log_name: str, losses: LossLedger
) -> Mounts:
    """Where all frames are in the frame whose motion the odometry tells."""
    fixed = {
        names: mount
        for names, mount in survey.transforms.fixed().items()
        if names != (odometry.parent, odometry.child)
    }
    tree = FrameTree(fixed)
    base = odometry.child
    if fixed and base not in tree:
        roots = [root for root in tree.roots if root != odometry.parent]
        if len(roots) == 1:
            losses.remark(
                f"odometry frame {base!r} is not among the transforms",
                odometry.topic,
                effect=f"taken to be {roots[0]!r}, their root",
            )
            base = roots[0]
    return Mounts(tree, base, config.mounts, log_name)


def laser_streams(
    survey: Survey, config: Config, mounts: Mounts, log_name: str, losses: LossLedger
) -> tuple[LaserStream, ...]:
    """How to read every scanner.

    Raises
    ------
    ConfigError
        A topic is not settled, or a mount unknown.
    NothingUsableError
        There are no scans, or not one return in them.
    """
    topics = laser_topics(survey, config, log_name)
    streams = [
        _laser_stream(topic, mounts, log_name, losses)
        for topic in topics
        if isinstance(topic.record, LaserRecord)
    ]
    if not any(stream.record.any_return for stream in streams):
        names = ", ".join(topic.name for topic in topics)
        raise NothingUsableError(
            f"{log_name}: no laser returns: every range on {names} is missing or out of the "
            "scanner's limits. Check the scanner."
        )
    return tuple(streams)


def _laser_stream(topic: Topic, mounts: Mounts, log_name: str, losses: LossLedger) -> LaserStream:
    record = topic.record
    if not isinstance(record, LaserRecord):
        raise NothingUsableError(f"{log_name}: {topic.name} cannot be read ({topic.problem}).")
    times = stamps_or_log_times(record.stamp_ns, record.log_time_ns, topic.name, losses)
    sound = np.flatnonzero(times != DAMAGED)
    rising = increasing(times[sound])
    losses.add(
        "laser stamp runs backward or repeats",
        topic.name,
        count=int(np.count_nonzero(~rising)),
        effect="scan left out",
    )
    times[sound[~rising]] = DAMAGED
    found = {frame: mounts.mount(frame, f"laser {topic.name}") for frame in record.frame_ids}
    for frame, mount in found.items():
        if mount.tilt_rad > TILT_WARNING_RAD:
            losses.remark(
                f"laser frame {frame!r} is tilted by {np.degrees(mount.tilt_rad):.1f} degrees",
                topic.name,
                effect="its rays are projected on the floor",
            )
    return LaserStream(
        topic,
        record,
        times,
        _ray_interval_is_sound(record, times[times != DAMAGED], losses),
        record.longest_m,
        found,
    )


def _ray_interval_is_sound(record: LaserRecord, times: Times, losses: LossLedger) -> bool:
    """Whether the rays of a sweep fit into the time from one sweep to the next."""
    if record.first is None or record.first.ray_interval_s == 0.0:
        return True
    sweep_s = record.first.ray_interval_s * (record.beams - 1)
    period_s = float(np.median(np.diff(times))) * 1e-9 if len(times) > 1 else np.inf
    if 0.0 <= sweep_s <= 1.1 * period_s:
        return True
    losses.remark(
        f"a sweep claims to take {sweep_s:.3g} s, but one comes every {period_s:.3g} s",
        record.topic,
        effect="all its rays are used at the time of the first",
    )
    return False


def audio_stream(survey: Survey, config: Config, log_name: str, losses: LossLedger) -> AudioStream:
    """How to read the microphones.

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
    stamps = stamps_or_log_times(record.stamp_ns, record.log_time_ns, topic.name, losses)[kept]
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
    _count_clock_losses(clock, topic.name, losses)
    return AudioStream(topic, encoding, sample, kept, clock, is_start)


def _count_clock_losses(clock: SampleClock, topic: str, losses: LossLedger) -> None:
    losses.add(
        "audio block repeats or overlaps the one before",
        topic,
        count=int(np.count_nonzero(~clock.kept)),
        effect="left out",
    )
    losses.add(
        "gap in the audio",
        topic,
        count=clock.gaps,
        effect=f"{clock.lost_s:.2f} s missing; nothing is joined over it",
    )
    if abs(clock.drift_ppm) > 2000.0:
        losses.remark(
            f"the sample rate by the stamps is {clock.rate_hz:.0f} Hz, not the recorder's",
            topic,
            effect="times follow the stamps",
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
    chosen = [i for i, e in enumerate(record.encodings) if e is None or e == encoding]
    usable = np.isin(index, chosen)
    losses.add(
        "audio block in another format than most",
        topic,
        count=int(np.count_nonzero(~usable & (index >= 0))),
        effect="left out",
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
        return found
    record = stream.topic.record
    own = record.frame_ids.most_common(1)[0][0] if isinstance(record, AudioRecord) else ""
    for frame in (own, "mic_array"):
        found = mounts.get(frame) if frame else None
        if found is not None:
            return found
    known = ", ".join(mounts.tree.frames) or "none"
    told = f"its audio names {own!r}" if own else "its audio names no frame"
    raise ConfigError(
        f"{log_name}: where the microphone array is mounted is unknown: {told}, and there is no "
        f"'mic_array'. Frames known: {known}. {advice}"
    )
