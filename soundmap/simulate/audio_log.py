"""What the microphones of a drive leave in the log."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, Mount
from soundmap.simulate.clocks import arrivals_ns, kept, stamps_ns
from soundmap.simulate.drive_log import Drive
from soundmap.simulate.log_writer import Message
from soundmap.simulate.messages import audio_info_message, audio_message
from soundmap.simulate.noise import ambient_table, drive_table, self_noise_rms
from soundmap.simulate.propagation import KNOT_STEP, FloatTable
from soundmap.simulate.scene import Array
from soundmap.simulate.sound_field import PERIOD_SAMPLES, SoundField, sound_field

STRETCH_SAMPLES = 200 * KNOT_STEP
"""Samples computed at a time, 0.4 s at 48 kHz: what bounds the memory."""
SILENT_DBA = -100.0

Progress = Callable[[float], None]
"""Told the share of the run that is done."""


@dataclass(frozen=True)
class Microphones:
    """The array as it truly is.

    Attributes
    ----------
    positions_m : ndarray, shape (Q, 3)
        In the base frame [m].
    gain : ndarray, shape (Q,)
        Amplitude gain of each channel, 1 nominally.
    """

    positions_m: FloatArray
    gain: FloatArray

    def positions_at(self, base_pose: FloatArray) -> FloatArray:
        """Positions in the map frame for base poses (K, 3), shape (Q, K, 3) [m]."""
        cos, sin = np.cos(base_pose[:, 2]), np.sin(base_pose[:, 2])
        x, y, z = (column[:, None] for column in self.positions_m.T)
        return np.stack(
            [
                base_pose[:, 0] + cos * x - sin * y,
                base_pose[:, 1] + sin * x + cos * y,
                np.broadcast_to(z, (len(x), len(cos))),
            ],
            axis=-1,
        )


def true_microphones(array: Array, rng: np.random.Generator) -> Microphones:
    """The nominal array with the errors of its making."""
    nominal = array.nominal_positions()
    placed = nominal + array.position_error_m * rng.standard_normal(nominal.shape)
    mount = Mount.planar(*array.mount)
    gain_db = array.gain_error_db * rng.standard_normal(len(nominal))
    return Microphones(
        placed @ mount.rotation.T + mount.translation_m, np.asarray(10.0 ** (gain_db / 20.0))
    )


@dataclass(frozen=True)
class Recorder:
    """Turns a sound field and noise into samples.

    Attributes
    ----------
    drive : Drive
    microphones : Microphones
    field : SoundField
    ambient, motors : ndarray of float32, shape (Q, L), or None
        One period of noise that is the same wherever the robot is [Pa]; None: silence.
    """

    drive: Drive
    microphones: Microphones
    field: SoundField
    ambient: FloatTable | None
    motors: FloatTable | None

    @property
    def rate_hz(self) -> float:
        """True sample rate: the nominal one with the drift of the recorder's clock [Hz]."""
        audio = self.drive.scene.audio
        return audio.rate_hz * (1.0 + 1e-6 * audio.clock.drift_ppm)

    def pressure(self, first: int, count: int, rng: np.random.Generator) -> FloatTable:
        """Sound pressure at samples ``first`` ... of every microphone, shape (Q, count) [Pa].

        ``count`` is a multiple of `KNOT_STEP`.
        """
        knots = (first + np.arange(0, count + 1, KNOT_STEP)) / self.rate_hz
        where = self.microphones.positions_at(self.drive.motion.at(knots))
        out = np.zeros((len(where), count), dtype=np.float32)
        self.field.add_sound(out, knots, where)
        sample = np.arange(first, first + count)
        if self.ambient is not None:
            out += np.take(self.ambient, sample, axis=1, mode="wrap")
        if self.motors is not None:
            speed = self.drive.motion.speed_at(knots) / self.drive.scene.robot.speed_m_s
            loudness = np.interp(sample / self.rate_hz, knots, speed).astype(np.float32)
            if np.any(loudness):
                out += loudness * np.take(self.motors, sample, axis=1, mode="wrap")
        rms = self_noise_rms(self.drive.scene.array.self_noise_dba, self.drive.scene.audio.rate_hz)
        return out + np.float32(rms) * rng.standard_normal(out.shape, dtype=np.float32)

    def samples(self, first: int, count: int, rng: np.random.Generator) -> NDArray[np.int16]:
        """What the converter makes of it, shape (count, Q)."""
        scale = self.microphones.gain / self.drive.scene.array.pascal_per_count
        counts = np.rint(self.pressure(first, count, rng) * scale[:, None].astype(np.float32))
        return np.ascontiguousarray(np.clip(counts, -32768, 32767).astype(np.int16).T)


def recorder(drive: Drive, folder: Path, rng: np.random.Generator) -> Recorder:
    """The recorder of a drive; wav files are looked up in ``folder``.

    The errors of the array depend on the scene's seed alone: they are the same in all its runs.
    """
    scene = drive.scene
    microphones = true_microphones(scene.array, np.random.default_rng([scene.seed, 77]))
    rate, speed = scene.audio.rate_hz, scene.room.speed_of_sound_m_s
    shared = (PERIOD_SAMPLES, rate, speed, rng)
    ambient = motors = None
    if scene.noise.ambient_dba > SILENT_DBA:
        ambient = ambient_table(microphones.positions_m, scene.noise.ambient_dba, *shared)
    if scene.noise.drive_dba > SILENT_DBA:
        motors = drive_table(microphones.positions_m, scene.noise.drive_dba, *shared)
    return Recorder(
        drive, microphones, sound_field(scene, drive.active, folder, rng), ambient, motors
    )


def audio_messages(
    drive: Drive, folder: Path, rng: np.random.Generator, progress: Progress | None = None
) -> Iterator[Message]:
    """Sound of every microphone, block by block, in order of arrival."""
    scene = drive.scene
    audio, clock = scene.audio, scene.audio.clock
    recording = recorder(drive, folder, rng)
    blocks = int(drive.motion.duration_s * recording.rate_hz) // audio.block_frames
    start_s = np.arange(blocks) * audio.block_frames / recording.rate_hz
    end_s = start_s + audio.block_frames / recording.rate_hz
    at_end = audio.schema_name == "audio_utils_msgs/msg/AudioFrame"
    stamps = stamps_ns(end_s if at_end else start_s, clock, drive.start_ns, rng)
    arrivals = arrivals_ns(end_s, clock, drive.start_ns, rng)
    keep = kept(start_s, clock)
    stream = _blocks(recording, blocks, audio.block_frames, rng)
    for index, block in enumerate(stream):
        if progress is not None:
            progress((index + 1) / blocks)
        if keep[index]:
            stamp = int(stamps[index])
            data = audio_message(
                audio.schema_name,
                stamp,
                scene.array.frame,
                block,
                rate_hz=audio.rate_hz,
                first_frame=index * audio.block_frames,
            )
            yield Message(int(arrivals[index]), stamp, data)


def info_message(drive: Drive) -> Message:
    """The one AudioInfo of a recorder that tells channels and rate apart from the samples."""
    channels = len(drive.scene.array.nominal_positions())
    data = audio_info_message(channels, drive.scene.audio.rate_hz)
    return Message(drive.start_ns, drive.start_ns, data)


def _blocks(
    recording: Recorder, blocks: int, frames: int, rng: np.random.Generator
) -> Iterator[NDArray[np.int16]]:
    """Samples cut into messages, shape (frames, Q), computed a stretch at a time."""
    waiting = np.zeros((0, len(recording.microphones.gain)), dtype=np.int16)
    computed = 0
    for _ in range(blocks):
        while len(waiting) < frames:
            stretch = recording.samples(computed, STRETCH_SAMPLES, rng)
            waiting = np.concatenate([waiting, stretch])
            computed += STRETCH_SAMPLES
        yield waiting[:frames]
        waiting = waiting[frames:]
