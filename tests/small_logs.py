"""A short drive past one loudspeaker, as events that a test may change before they are written.

Rooms and lasers are those of `worlds`; sound goes the direct way from a point to each microphone,
delayed and weakened by the distance, over a floor of noise of each microphone's own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import worlds
from logwriter import SECOND, LogWriter, audio_frame, laser_scan, odometry, transform

from soundmap.geometry import relative, transformed

RATE = 16000
BLOCK_NS = 20_000_000
MICROPHONES = 6
RADIUS_M = 0.1
SOURCE_M = np.array([3.0, 0.025])
START = (1.0, 1.0, 0.0)
ARRAY = f'[array]\nkind = "circle"\nmicrophones = {MICROPHONES}\nradius_m = {RADIUS_M}\n'

TRUTH = worlds.driven([(1.0, 1.0), (4.0, 1.0)])
START_NS, END_NS = int(TRUTH.time_ns[0]), int(TRUTH.time_ns[-1])

TYPES = {
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/odom": "nav_msgs/msg/Odometry",
    "/scan": "sensor_msgs/msg/LaserScan",
    "/mics": "audio_utils_msgs/msg/AudioFrame",
}


class Event(NamedTuple):
    """A message to be written: when it was logged, where, and its content."""

    time_ns: int
    topic: str
    values: dict[str, Any]


@cache
def _sound() -> np.ndarray:
    """What the microphones hear, shape (samples, microphones), as 16-bit numbers."""
    rng = np.random.default_rng(11)
    count = (END_NS - START_NS) * RATE // SECOND // 320 * 320
    over = 16
    spectrum = np.fft.rfft(rng.standard_normal(count + RATE))
    spectrum[np.fft.rfftfreq(count + RATE, 1 / RATE) < 200.0] = 0.0
    fine = np.fft.irfft(spectrum, over * (count + RATE)) * over
    emitted_s = np.arange(len(fine)) / (over * RATE) - 0.5
    time_s = np.arange(count) / RATE
    pose = TRUTH.at(START_NS + np.rint(time_s * SECOND).astype(np.int64))
    heard = 30.0 * rng.standard_normal((count, MICROPHONES))
    for mic, angle in enumerate(np.arange(MICROPHONES) * 2 * np.pi / MICROPHONES):
        offset = RADIUS_M * np.array([np.cos(angle), np.sin(angle)])
        distance = np.hypot(*(transformed(pose, offset) - SOURCE_M).T)
        heard[:, mic] += 1500.0 / distance * np.interp(time_s - distance / 343.0, emitted_s, fine)
    return np.clip(np.rint(heard), -32768, 32767).astype(np.int16)


@cache
def _lasers() -> list[Any]:
    return worlds.laser_scans(TRUTH, [worlds.FRONT], beams=361)


def events() -> list[Event]:
    """The whole drive in the order of logging; fresh dictionaries every time."""
    tree = [
        transform("base_link", "laser", (0.2, 0.0, 0.3)),
        transform("base_link", "mic_array", (0.0, 0.0, 0.6)),
    ]
    made = [Event(START_NS, "/tf_static", {"transforms": tree})]
    steps = relative(TRUTH.pose[0], TRUTH.pose)
    for time_ns, pose in zip(TRUTH.time_ns.tolist(), steps, strict=True):
        made.append(Event(time_ns, "/odom", odometry(time_ns, tuple(pose))))
    for scan in _lasers():
        values = laser_scan(
            scan.time_ns, "laser", scan.range_m, time_increment=scan.ray_interval_ns * 1e-9
        )
        made.append(Event(scan.time_ns + 20_000_000, "/scan", values))
    sound, frames = _sound(), RATE * BLOCK_NS // SECOND
    for i in range(len(sound) // frames):
        end = START_NS + (i + 1) * BLOCK_NS
        block = sound[i * frames : (i + 1) * frames]
        made.append(Event(end, "/mics", audio_frame(end, block, RATE)))
    return sorted(made, key=lambda event: event.time_ns)


def write(path: Path, content: Iterable[Event] | None = None, **options: Any) -> Path:
    """Write events, those of the whole drive by default; options are those of `LogWriter`."""
    options.setdefault("chunk_size", 20_000)
    with LogWriter(path, **options) as log:
        for event in events() if content is None else content:
            log.ros2(event.topic, TYPES[event.topic], event.values, event.time_ns)
    return path


def changed(
    content: Iterable[Event], topic: str, change: Callable[[int, Event], Event | None]
) -> list[Event]:
    """The events with those of a topic replaced by what ``change`` makes of number and event."""
    result, number = [], 0
    for event in content:
        if event.topic != topic:
            result.append(event)
            continue
        new = change(number, event)
        number += 1
        if new is not None:
            result.append(new)
    return result
