"""A recorded log as the sensors' own measurements: odometry, laser scans, audio.

Opening a log takes one pass over it; scans and audio then come by further passes, in order, with
two chunks of the file in memory at a time.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soundmap.config import Config
from soundmap.geometry import FloatArray, Mount, Trajectory
from soundmap.logs.array_health import array_health, without_faulty
from soundmap.logs.audio_blocks import BlockReader, audio_blocks
from soundmap.logs.audio_stream import AudioStream, audio_stream, microphone_array
from soundmap.logs.coverage import count_silences
from soundmap.logs.laser_messages import LaserSweep, valid_ranges
from soundmap.logs.log_files import log_files
from soundmap.logs.reader import McapLog
from soundmap.logs.stamps import DAMAGED
from soundmap.logs.streams import (
    LaserStream,
    base_mounts,
    laser_streams,
    odometry_stream,
)
from soundmap.logs.survey import Survey
from soundmap.losses import LossLedger
from soundmap.sensors import AudioBlock, LaserScan, MicArray

SCANS_HELD = 64
"""Scans of each scanner held back to put those of all in order."""


@dataclass(frozen=True)
class RobotLog:
    """A log, ready to be read.

    Attributes
    ----------
    path : Path
        As the user named it.
    fingerprint : str
        Identifies the content.
    duration_s : float
        From the first to the last message [s].
    losses : LossLedger
        What was damaged, repaired or left out.
    odometry : Trajectory
        The base in the odometry frame.
    base_frame : str
    array : MicArray or None
        None if audio was not asked for.
    sample_rate_hz : float
        Nominal [Hz]; 0 if audio was not asked for.
    scanners : tuple of str
        Topics of the laser scanners; the index is ``LaserScan.scanner``.
    """

    path: Path
    fingerprint: str
    duration_s: float
    losses: LossLedger
    odometry: Trajectory
    base_frame: str
    array: MicArray | None
    sample_rate_hz: float
    scanners: tuple[str, ...]
    _log: McapLog
    _survey: Survey
    _laser_streams: tuple[LaserStream, ...]
    _audio_stream: AudioStream | None
    _channels: NDArray[np.intp]

    def lasers(self) -> Iterator[LaserScan]:
        """Scans of all scanners by the time of their first ray; a fresh pass every call."""
        return (item for item in self._measured(None) if isinstance(item, LaserScan))

    def audio(self) -> Iterator[AudioBlock]:
        """Blocks of audio in the order of time; a fresh pass every call.

        Raises
        ------
        ValueError
            The log was opened without audio.
        """
        stream = self._needed_audio()
        return audio_blocks(self._log, self._survey, stream, self._channels, self.losses)

    def measurements(self) -> Iterator[AudioBlock | LaserScan]:
        """What :meth:`audio` and :meth:`lasers` give, in one pass; each of them in its own order.

        Raises
        ------
        ValueError
            The log was opened without audio.
        """
        return self._measured(self._needed_audio())

    def _needed_audio(self) -> AudioStream:
        if self._audio_stream is None:
            raise ValueError("the log was opened without audio")
        return self._audio_stream

    def _measured(self, audio: AudioStream | None) -> Iterator[AudioBlock | LaserScan]:
        """Laser scans in the order of time, and between them blocks of audio as logged."""
        blocks = None
        if audio is not None:
            blocks = BlockReader(self._survey, audio, self._channels, self.losses)
        audio_name = audio.topic.name if audio is not None else ""
        lasers = {
            stream.topic.name: _ScanReader(stream, index)
            for index, stream in enumerate(self._laser_streams)
        }
        decoders, room = self._survey.decoders, SCANS_HELD * len(lasers)
        waiting: list[tuple[int, int, LaserScan]] = []
        for message in self._log.messages(lambda c: c.topic in lasers or c.topic == audio_name):
            if blocks is not None and message.channel.topic == audio_name:
                if (block := blocks.block(message)) is not None:
                    yield block
                continue
            reader = lasers[message.channel.topic]
            time_ns = reader.next_time()
            if time_ns == DAMAGED:
                continue
            scan = reader.scan(decoders.reader(message.channel)(message.data), time_ns)
            heapq.heappush(waiting, (scan.time_ns, scan.scanner, scan))
            if len(waiting) > room:
                yield heapq.heappop(waiting)[2]
        while waiting:
            yield heapq.heappop(waiting)[2]


class _ScanReader:
    """Turns messages of one scanner into scans; what does not change is made once."""

    def __init__(self, stream: LaserStream, scanner: int) -> None:
        self.stream, self.scanner = stream, scanner
        self._times = map(int, stream.time_ns)
        self._bearings: dict[tuple[float, float, int], FloatArray] = {}
        self._mounts: dict[Any, Mount] = {}

    def next_time(self) -> int:
        return next(self._times, DAMAGED)

    def scan(self, sweep: LaserSweep, time_ns: int) -> LaserScan:
        ranges = valid_ranges(sweep)
        limit = sweep.range_max_m
        known = np.isfinite(limit) and limit > max(sweep.range_min_m, 0.0)
        interval_s = sweep.ray_interval_s if self.stream.ray_interval_is_sound else 0.0
        return LaserScan(
            time_ns=time_ns,
            ray_interval_ns=interval_s * 1e9,
            bearing_rad=self._bearing(sweep, len(ranges)),
            range_m=ranges,
            range_max_m=float(limit) if known else self.stream.range_max_m,
            mount=self._mount(sweep),
            scanner=self.scanner,
        )

    def _bearing(self, sweep: LaserSweep, count: int) -> FloatArray:
        key = (sweep.first_angle_rad, sweep.angle_step_rad, count)
        if key not in self._bearings:
            if len(self._bearings) > 16:
                self._bearings.clear()
            self._bearings[key] = np.asarray(key[0] + key[1] * np.arange(count), dtype=np.float64)
        return self._bearings[key]

    def _mount(self, sweep: LaserSweep) -> Mount:
        frame_mount = self.stream.mounts[sweep.frame_id]
        if sweep.pose is None:
            return frame_mount
        key = (sweep.frame_id, sweep.pose)
        if key not in self._mounts:
            if len(self._mounts) > 16:
                self._mounts.clear()
            own = Mount.from_quaternion(sweep.pose[:3], sweep.pose[3:])
            self._mounts[key] = frame_mount @ own
        return self._mounts[key]


def open_log(path: Path, config: Config, *, need_audio: bool = True) -> RobotLog:
    """Open a log for reading.

    Parameters
    ----------
    path : Path
        An ``.mcap`` file or a rosbag2 folder.
    config : Config
        Topics, mounts and array; what it leaves out is found in the log.
    need_audio : bool
        Whether the microphones matter.

    Raises
    ------
    LogError
        The log cannot be read.
    NothingUsableError
        Something needed is not in it.
    ConfigError
        The configuration does not fit it, or has to settle something.
    """
    losses = LossLedger()
    with losses.told_with_errors():
        return _opened(path, config, losses, need_audio=need_audio)


def _opened(path: Path, config: Config, losses: LossLedger, *, need_audio: bool) -> RobotLog:
    log = McapLog(path, log_files(path), losses)
    survey = Survey(log, need_audio=need_audio)
    name = str(path)
    odometry = odometry_stream(survey, config, name, losses)
    ahead_ns = odometry.ahead_ns
    mounts = base_mounts(survey, config, odometry, name, losses)
    lasers = laser_streams(survey, config, mounts, ahead_ns, name, losses)
    audio = audio_stream(survey, config, ahead_ns, name, losses) if need_audio else None
    array, channels = None, np.zeros(0, dtype=np.intp)
    if audio:
        whole = microphone_array(config, audio, mounts, name)
        health = array_health(audio, whole.positions_m, losses)
        array, channels = without_faulty(whole, health, name)
    count_silences(filter(None, [odometry, *lasers, audio]), losses)
    survey.forget_messages()
    return RobotLog(
        path=path,
        fingerprint=log.fingerprint(),
        duration_s=(survey.end_ns - survey.start_ns) * 1e-9,
        losses=losses,
        odometry=odometry.trajectory,
        base_frame=mounts.base,
        array=array,
        sample_rate_hz=audio.rate_hz if audio else 0.0,
        scanners=tuple(stream.topic.name for stream in lasers),
        _log=log,
        _survey=survey,
        _laser_streams=lasers,
        _audio_stream=audio,
        _channels=channels,
    )
