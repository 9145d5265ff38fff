"""What is in a log, what of it would be used, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from soundmap.config import Config
from soundmap.errors import NothingUsableError, SoundmapError
from soundmap.geometry import Mount, wrapped_angle
from soundmap.logs.array_health import array_health, without_faulty
from soundmap.logs.audio_blocks import audio_blocks
from soundmap.logs.audio_stream import AudioStream, audio_stream, microphone_array
from soundmap.logs.coverage import count_silences
from soundmap.logs.log_files import log_files
from soundmap.logs.messages import Kind
from soundmap.logs.microphones import MicrophoneHealth
from soundmap.logs.mounts import FrameTree, Mounts
from soundmap.logs.reader import McapLog
from soundmap.logs.stamps import DAMAGED
from soundmap.logs.streams import (
    LaserStream,
    OdometryStream,
    base_mounts,
    laser_streams,
    odometry_stream,
)
from soundmap.logs.survey import Survey, Topic
from soundmap.logs.timing import Timing, timing
from soundmap.losses import Loss, LossLedger

Found = TypeVar("Found")


@dataclass(frozen=True)
class TopicSummary:
    """One topic: type, encoding, messages, regularity, what it carries, whether it is used.

    See :class:`soundmap.logs.timing.Timing`.
    """

    name: str
    schema: str
    encoding: str
    messages: int
    rate_hz: float
    gaps: int
    longest_gap_s: float
    jitter_s: float
    drift_ppm: float | None
    kind: str
    used: bool
    problem: str


@dataclass(frozen=True)
class AudioSummary:
    """The microphones' topic, its clock and its channels.

    ``stamp`` is "start" or "end" of a block; ``level_db`` is that of each channel over the log [dB
    re (full scale)^2], ``unsound_channels`` are left out of the array.
    """

    topic: str
    channels: int
    rate_hz: float
    measured_rate_hz: float
    drift_ppm: float
    jitter_s: float
    gaps: int
    lost_s: float
    stamp: str
    level_db: tuple[float | None, ...]
    unsound_channels: tuple[int, ...]


@dataclass(frozen=True)
class LaserSummary:
    """One scanner; the mount is x, y, z [m] and yaw [rad] in the base frame."""

    topic: str
    frame: str
    beams: int
    rate_hz: float
    angular_span_rad: float
    range_max_m: float
    mount: tuple[float, float, float, float]
    tilt_rad: float
    upside_down: bool


@dataclass(frozen=True)
class OdometrySummary:
    """The odometry; ``source`` is "pose", "twist" or "transform"."""

    topic: str
    rate_hz: float
    source: str
    distance_m: float
    turn_rad: float


@dataclass(frozen=True)
class LogSummary:
    """A log at a glance; times in ns since epoch by the log's own clock.

    ``problems`` are what keeps the log, or a part of it, from being used, gravest first;
    ``ready_for`` tells which commands would begin; lost data comes before remarks in ``losses``.
    """

    path: Path
    size_bytes: int
    start_ns: int
    end_ns: int
    duration_s: float
    topics: tuple[TopicSummary, ...]
    audio: AudioSummary | None
    lasers: tuple[LaserSummary, ...]
    odometry: OdometrySummary | None
    base_frame: str | None
    mounts: dict[str, Mount]
    losses: tuple[Loss, ...]
    problems: tuple[str, ...]
    ready_for: dict[str, bool]

    def as_dict(self) -> dict[str, Any]:
        """Everything as plain lists, strings and numbers, ready for JSON."""
        return {
            "path": str(self.path),
            "size_bytes": self.size_bytes,
            "start_ns": self.start_ns,
            "end_ns": self.end_ns,
            "duration_s": self.duration_s,
            "topics": [asdict(topic) for topic in self.topics],
            "audio": asdict(self.audio) if self.audio else None,
            "lasers": [asdict(laser) | {"mount": list(laser.mount)} for laser in self.lasers],
            "odometry": asdict(self.odometry) if self.odometry else None,
            "base_frame": self.base_frame,
            "mounts": {frame: list(_planar(mount)) for frame, mount in self.mounts.items()},
            "losses": [asdict(loss) for loss in self.losses],
            "problems": list(self.problems),
            "ready_for": self.ready_for,
        }


def log_summary(path: Path, config: Config) -> LogSummary:
    """What is in a log and what of it would be used.

    Whatever is missing or ambiguous becomes a problem in the summary.

    Raises
    ------
    LogError
        The log cannot be read at all.
    """
    losses = LossLedger()
    log = McapLog(path, log_files(path), losses)
    survey = Survey(log, keep_times=True)
    name, problems = str(path), list[SoundmapError]()

    def attempted(make: Callable[[], Found]) -> Found | None:
        try:
            return make()
        except SoundmapError as error:
            problems.append(error)
            return None

    odometry = attempted(lambda: odometry_stream(survey, config, name, losses))
    ahead_ns = odometry.ahead_ns if odometry else None
    mounts = (
        base_mounts(survey, config, odometry, name, losses)
        if odometry
        else _mounts_without_odometry(survey, config, name)
    )
    lasers = attempted(lambda: laser_streams(survey, config, mounts, ahead_ns, name, losses)) or ()
    audio = attempted(lambda: audio_stream(survey, config, ahead_ns, name, losses))
    health = None
    if audio is not None:
        stream = audio
        array = attempted(lambda: microphone_array(config, stream, mounts, name))
        health = array_health(stream, array.positions_m if array else None, losses)
        if array is not None:
            whole = array
            attempted(lambda: without_faulty(whole, health, name))
        if audio.sample.kind == "f":
            every = np.arange(audio.encoding.channels)
            for _ in audio_blocks(log, survey, audio, every, losses):
                pass
    count_silences(filter(None, [odometry, *lasers, audio]), losses)
    used = {stream.topic.name for stream in lasers}
    used |= {audio.topic.name} if audio else set()
    used |= {odometry.topic} if odometry else set()
    return LogSummary(
        path=path,
        size_bytes=log.size_bytes,
        start_ns=survey.start_ns,
        end_ns=survey.end_ns,
        duration_s=(survey.end_ns - survey.start_ns) * 1e-9,
        topics=_topics(survey, used | _mount_topics(survey, odometry)),
        audio=_audio(audio, health) if audio else None,
        lasers=tuple(_laser(stream) for stream in lasers),
        odometry=_odometry(odometry) if odometry else None,
        base_frame=mounts.base or None,
        mounts=_known_mounts(mounts),
        losses=tuple(sorted(losses, key=lambda loss: not loss.data_lost)),
        problems=tuple(str(error) for error in sorted(problems, key=_gravity)),
        ready_for={
            "map": bool(odometry and lasers),
            "localize": bool(odometry and lasers),
            "process": not problems,
        },
    )


def _gravity(error: SoundmapError) -> int:
    """What a setting can mend comes after what is not in the log."""
    return 0 if isinstance(error, NothingUsableError) else 1


def _mounts_without_odometry(survey: Survey, config: Config, name: str) -> Mounts:
    tree = FrameTree(survey.transforms.fixed())
    return Mounts(tree, tree.roots[0] if tree.roots else "", config.mounts, name)


def _known_mounts(mounts: Mounts) -> dict[str, Mount]:
    frames = sorted({*mounts.tree.frames, *mounts.configured})
    found = {frame: mounts.get(frame) for frame in frames}
    return {frame: mount for frame, mount in found.items() if mount is not None}


def _planar(mount: Mount) -> tuple[float, float, float, float]:
    x, y, z = (float(value) for value in mount.translation_m)
    return x, y, z, mount.yaw_rad


def _rate(count: int, span_ns: int) -> float:
    return (count - 1) / (span_ns * 1e-9) if count > 1 and span_ns > 0 else 0.0


def _mount_topics(survey: Survey, odometry: OdometryStream | None) -> set[str]:
    """Topics that tell where a sensor is mounted."""
    driven = (odometry.parent, odometry.child) if odometry else None
    return {survey.transforms.edges[e].topic for e in survey.transforms.fixed() if e != driven}


def _topics(survey: Survey, used: set[str]) -> tuple[TopicSummary, ...]:
    return tuple(
        TopicSummary(
            name=topic.name,
            schema=topic.schema,
            encoding=topic.encoding,
            messages=topic.messages,
            **asdict(_timing(topic)),
            kind=str(topic.kind),
            used=topic.name in used or topic.kind is Kind.AUDIO_INFO,
            problem=topic.problem,
        )
        for topic in sorted(survey.topics.values(), key=lambda t: t.name)
    )


def _timing(topic: Topic) -> Timing:
    record = topic.record
    stamps = None
    if record is not None and len(record.stamp_ns) == len(topic.logged_ns):
        stamps = np.array(record.stamp_ns, dtype=np.int64)
    return timing(np.array(topic.logged_ns, dtype=np.int64), stamps)


def _audio(stream: AudioStream, health: MicrophoneHealth | None) -> AudioSummary:
    clock = stream.clock
    return AudioSummary(
        topic=stream.topic.name,
        channels=stream.encoding.channels,
        rate_hz=stream.encoding.rate_hz,
        measured_rate_hz=clock.rate_hz,
        drift_ppm=clock.drift_ppm,
        jitter_s=clock.jitter_s,
        gaps=clock.gaps,
        lost_s=clock.lost_s,
        stamp="start" if stream.stamp_is_start else "end",
        level_db=_levels(health) if health else (),
        unsound_channels=tuple(np.flatnonzero(~health.sound).tolist()) if health else (),
    )


def _levels(health: MicrophoneHealth) -> tuple[float | None, ...]:
    return tuple(level if np.isfinite(level) else None for level in health.level_db.tolist())


def _laser(stream: LaserStream) -> LaserSummary:
    record, first = stream.record, stream.record.first
    times = stream.time_ns[stream.time_ns != DAMAGED]
    frame = record.frame_ids.most_common(1)[0][0] if record.frame_ids else ""
    mount = stream.mounts.get(frame, Mount.planar(0.0, 0.0, 0.0, 0.0))
    limit = first.range_max_m if first else np.nan
    return LaserSummary(
        topic=stream.topic.name,
        frame=frame,
        beams=record.beams,
        rate_hz=_rate(len(times), int(np.ptp(times)) if len(times) else 0),
        angular_span_rad=abs(first.angle_step_rad) * (record.beams - 1) if first else 0.0,
        range_max_m=float(limit) if np.isfinite(limit) else stream.range_max_m,
        mount=_planar(mount),
        tilt_rad=mount.tilt_rad,
        upside_down=mount.handedness < 0,
    )


def _odometry(stream: OdometryStream) -> OdometrySummary:
    time_ns, pose = stream.trajectory.time_ns, stream.trajectory.pose
    steps = np.diff(pose, axis=0)
    return OdometrySummary(
        topic=stream.topic,
        rate_hz=_rate(len(time_ns), int(time_ns[-1] - time_ns[0])),
        source=stream.source,
        distance_m=float(np.sum(np.hypot(steps[:, 0], steps[:, 1]))),
        turn_rad=float(np.sum(np.abs(wrapped_angle(steps[:, 2])))),
    )
