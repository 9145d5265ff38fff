"""Sound field: what the microphones of a driving robot hear of the sources in a room."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from soundmap.geometry import FloatArray
from soundmap.simulate.floor_plan import FloorPlan
from soundmap.simulate.image_sources import (
    LevelSequences,
    WallSequences,
    level_sequences,
    visible,
    wall_sequences,
)
from soundmap.simulate.path import walked
from soundmap.simulate.propagation import FloatTable, SoundTable, add_delayed
from soundmap.simulate.reverberation import (
    WAVES,
    eyring_time,
    mean_directivity,
    tail_density,
    tail_response,
    tail_start,
    wave_directions,
)
from soundmap.simulate.scene import Room, Scene, Source
from soundmap.simulate.scene_file import floor_plan
from soundmap.simulate.spectra import (
    ComplexArray,
    noise_spectrum,
    one_period,
    wav_spectrum,
    with_level,
)

PERIOD_SAMPLES = 1 << 19
"""Sounds repeat after this many samples, 11 s at 48 kHz; only a longer wav file prolongs it."""
MOST_SAMPLES = 1 << 22
DIRECT_OVERSAMPLING, TAIL_OVERSAMPLING = 4, 2
NEAREST_M = 0.05
"""No microphone is taken to be nearer to a source than this."""
VISIBILITY_STEP_S = 0.02
FADE_S = 0.005
"""An intermittent source is switched on and off within this time."""


@dataclass(frozen=True)
class Emitter:
    """One sounding source.

    Attributes
    ----------
    source : Source
    spectrum : ndarray of complex, shape (L // 2 + 1,)
        Of one period of its sound at 1 m on its axis [Pa].
    table : SoundTable
        That period.
    """

    source: Source
    spectrum: ComplexArray
    table: SoundTable

    @property
    def steady(self) -> bool:
        """Whether it sounds all the time."""
        return self.source.on_s is None

    def position_at(self, time_s: FloatArray) -> FloatArray:
        """Positions at any times (...), shape (..., 3) [m]."""
        source = self.source
        if not source.way_points_m:
            return np.broadcast_to(np.array(source.position_m), (*time_s.shape, 3))
        way = (source.position_m[:2], *source.way_points_m)
        pose = walked(way, speed_m_s=source.speed_m_s, time_s=time_s)
        pose[..., 2] = source.position_m[2]
        return pose

    def loudness_at(self, time_s: FloatArray) -> FloatArray:
        """Amplitude at emission times (...): 1 while on, 0 while off."""
        source = self.source
        if source.on_s is None or source.off_s is None:
            return np.ones(time_s.shape)
        phase = time_s % (source.on_s + source.off_s)
        return np.asarray(np.clip(np.minimum(phase, source.on_s - phase) / FADE_S, 0.0, 1.0))


@dataclass(frozen=True)
class Tail:
    """Late reverberation of sources that are switched together.

    Attributes
    ----------
    emitter : Emitter or None
        Whose being on and off it follows; None if all are steady.
    tables : tuple of SoundTable
        One a plane wave.
    direction : ndarray, shape (waves, 3)
        Unit vectors to where the waves come from.
    reverberation_s : float
    """

    emitter: Emitter | None
    tables: tuple[SoundTable, ...]
    direction: FloatArray
    reverberation_s: float


@dataclass(frozen=True)
class SoundField:
    """Everything that sounds in a room, ready to be listened to.

    Attributes
    ----------
    plan : FloorPlan
    speed_of_sound_m_s : float
    sequences : tuple of WallSequences
        By order.
    levels : LevelSequences
    emitters : tuple of Emitter
    tails : tuple of Tail
    """

    plan: FloorPlan
    speed_of_sound_m_s: float
    sequences: tuple[WallSequences, ...]
    levels: LevelSequences
    emitters: tuple[Emitter, ...]
    tails: tuple[Tail, ...]

    def add_sound(self, out: FloatTable, time_s: FloatArray, microphones_m: FloatArray) -> None:
        """Add what the microphones hear [Pa] to ``out``, shape (Q, K * KNOT_STEP).

        Parameters
        ----------
        out : ndarray of float32
        time_s : ndarray, shape (K + 1,)
            True time of every `KNOT_STEP`-th sample [s].
        microphones_m : ndarray, shape (Q, K + 1, 3)
            Where the microphones are then, in the map frame [m].
        """
        for emitter in self.emitters:
            self._add_images(out, emitter, time_s, microphones_m)
        for tail in self.tails:
            self._add_tail(out, tail, time_s, microphones_m)

    def _add_images(
        self, out: FloatTable, emitter: Emitter, time_s: FloatArray, microphones_m: FloatArray
    ) -> None:
        coarse = np.arange(time_s[0], time_s[-1] + VISIBILITY_STEP_S, VISIBILITY_STEP_S)
        centre = microphones_m[..., :2].mean(axis=0)
        receiver = np.stack([np.interp(coarse, time_s, centre[:, axis]) for axis in (0, 1)], -1)
        source = emitter.position_at(coarse)[..., :2]
        for sequences in self.sequences:
            seen = visible(sequences, self.plan, source, receiver)
            for index in np.flatnonzero(seen.any(axis=1)):
                shown = np.interp(time_s, coarse, seen[index].astype(np.float64))
                for level in np.flatnonzero(self.levels.order <= self._highest - sequences.order):
                    self._add_image(
                        out,
                        emitter,
                        (sequences, int(index), int(level)),
                        time_s,
                        microphones_m,
                        shown,
                    )

    @property
    def _highest(self) -> int:
        return len(self.sequences) - 1

    def _add_image(
        self,
        out: FloatTable,
        emitter: Emitter,
        way: tuple[WallSequences, int, int],
        time_s: FloatArray,
        microphones_m: FloatArray,
        shown: FloatArray,
    ) -> None:
        """Add what arrives by one way; ``shown``, shape (K + 1,), is 0 where it does not exist."""
        emission, offset = self._emission(emitter, way, time_s, microphones_m)
        distance = np.maximum(np.linalg.norm(offset, axis=-1), NEAREST_M)
        sequences, index, level = way
        gain = sequences.coefficient[index] * self.levels.coefficient[level] * shown / distance
        gain = gain * emitter.loudness_at(emission)
        if emitter.source.front_to_back_db > 0.0:
            # The direction of departure is that of arrival, mirrored back.
            departure = offset[..., :2] @ sequences.matrix[index, -1]
            yaw = np.radians(emitter.source.facing_deg)
            cosine = (departure @ np.array([np.cos(yaw), np.sin(yaw)])) / distance
            gain = gain * 10.0 ** (-emitter.source.front_to_back_db / 40.0 * (1.0 - cosine))
        add_delayed(out, emitter.table, emission, gain)

    def _emission(
        self,
        emitter: Emitter,
        way: tuple[WallSequences, int, int],
        time_s: FloatArray,
        microphones_m: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """When what is heard left the source (Q, K + 1), and the way from its image then."""
        sequences, index, level = way
        matrix, shift = sequences.matrix[index, -1], sequences.shift[index, -1]
        emission = np.broadcast_to(time_s, microphones_m.shape[:2])
        for _ in range(4 if emitter.source.way_points_m else 1):
            position = emitter.position_at(emission)
            height = self.levels.sign[level] * position[..., 2:] + self.levels.shift_m[level]
            image = np.concatenate([position[..., :2] @ matrix.T + shift, height], axis=-1)
            offset = microphones_m - image
            emission = time_s - np.linalg.norm(offset, axis=-1) / self.speed_of_sound_m_s
        return emission, offset

    def _add_tail(
        self, out: FloatTable, tail: Tail, time_s: FloatArray, microphones_m: FloatArray
    ) -> None:
        loudness = np.ones(len(time_s))
        if tail.emitter is not None:
            loudness = _decaying_loudness(tail.emitter, time_s, tail.reverberation_s)
        gain = np.broadcast_to(loudness, microphones_m.shape[:2])
        centre = np.append(
            0.5 * (self.plan.start_m.min(axis=0) + self.plan.start_m.max(axis=0)), 0.0
        )
        for table, direction in zip(tail.tables, tail.direction, strict=True):
            emission = time_s + (microphones_m - centre) @ direction / self.speed_of_sound_m_s
            add_delayed(out, table, emission, gain)


def sound_field(
    scene: Scene, active: tuple[str, ...], folder: Path, rng: np.random.Generator
) -> SoundField:
    """The field of the active sources of a scene; wav files are looked up in ``folder``."""
    sources = [source for source in scene.sources if source.id in active]
    rate, room = scene.audio.rate_hz, scene.room
    length = _period(sources, folder, rate)
    emitters = tuple(_emitter(source, folder, length, rate, rng) for source in sources)
    groups: list[tuple[Emitter | None, list[Emitter]]] = [
        (None, [emitter for emitter in emitters if emitter.steady]),
        *((emitter, [emitter]) for emitter in emitters if not emitter.steady),
    ]
    plan = floor_plan(scene)
    reverberation_s = reverberation_time(room, plan)
    tails = [
        _tail(switch, group, room, plan, length, rate, rng)
        for switch, group in groups
        if group and reverberation_s > 0.0
    ]
    return SoundField(
        plan,
        room.speed_of_sound_m_s,
        tuple(wall_sequences(plan, room.image_order)),
        level_sequences(
            room.height_m, room.floor_reflection, room.ceiling_reflection, room.image_order
        ),
        emitters,
        tuple(tails),
    )


def reverberation_time(room: Room, plan: FloorPlan) -> float:
    """The room's reverberation time as given, else Eyring's [s]."""
    if room.reverberation_s is not None:
        return room.reverberation_s
    areas, reflection = _surfaces(room, plan)
    time = eyring_time(
        plan.area_m2 * room.height_m, areas, reflection, speed_of_sound_m_s=room.speed_of_sound_m_s
    )
    return min(time, 10.0)


def source_spectrum(
    source: Source, folder: Path, length: int, rate_hz: float, rng: np.random.Generator
) -> ComplexArray:
    """Half spectrum of one period of a source's sound at 1 m on its axis [Pa]."""
    if source.wav is not None:
        spectrum = wav_spectrum(folder / source.wav, length, rate_hz)
    else:
        spectrum = noise_spectrum(source.sound, length, rate_hz, rng)
    at_1m = source.level_dba_5cm + 20.0 * np.log10(0.05 / 1.0)
    return with_level(spectrum, length, rate_hz, float(at_1m))


def _emitter(
    source: Source, folder: Path, length: int, rate_hz: float, rng: np.random.Generator
) -> Emitter:
    spectrum = source_spectrum(source, folder, length, rate_hz, rng)
    period = one_period(spectrum, length, DIRECT_OVERSAMPLING)
    return Emitter(source, spectrum, SoundTable.from_period(period, DIRECT_OVERSAMPLING, rate_hz))


def _period(sources: list[Source], folder: Path, rate_hz: float) -> int:
    from soundmap.simulate.spectra import read_wav

    length = PERIOD_SAMPLES
    for source in sources:
        if source.wav is not None:
            signal, rate = read_wav(folder / source.wav)
            while length < min(len(signal) * rate_hz / rate, MOST_SAMPLES):
                length *= 2
    return length


def _tail(
    switch: Emitter | None,
    group: list[Emitter],
    room: Room,
    plan: FloorPlan,
    length: int,
    rate_hz: float,
    rng: np.random.Generator,
) -> Tail:
    from scipy import fft

    areas, _ = _surfaces(room, plan)
    volume, speed = plan.area_m2 * room.height_m, room.speed_of_sound_m_s
    time = reverberation_time(room, plan)
    density = tail_density(
        np.arange(min(length, int(1.5 * time * rate_hz) + 1)) / rate_hz,
        volume_m3=volume,
        reverberation_s=time,
        start_s=tail_start(
            volume, float(np.sum(areas)), room.image_order, speed_of_sound_m_s=speed
        ),
        speed_of_sound_m_s=speed,
    )
    radiated = np.zeros(length // 2 + 1, dtype=np.complex128)
    for emitter in group:
        radiated += np.sqrt(mean_directivity(emitter.source.front_to_back_db)) * emitter.spectrum
    tables = []
    for _ in range(WAVES):
        response = tail_response(density, rate_hz, WAVES, rng).astype(np.float32)
        spectrum = fft.rfft(response, length) * radiated
        period = one_period(spectrum, length, TAIL_OVERSAMPLING)
        tables.append(SoundTable.from_period(period, TAIL_OVERSAMPLING, rate_hz))
    return Tail(switch, tuple(tables), wave_directions(WAVES, rng), time)


def _surfaces(room: Room, plan: FloorPlan) -> tuple[FloatArray, FloatArray]:
    """Areas [m2] and reflection coefficients of the walls, the floor and the ceiling."""
    areas = np.concatenate([plan.lengths_m * room.height_m, [plan.area_m2, plan.area_m2]])
    flat = [room.floor_reflection, room.ceiling_reflection]
    return areas, np.concatenate([plan.reflection, flat])


def _decaying_loudness(emitter: Emitter, time_s: FloatArray, reverberation_s: float) -> FloatArray:
    """Amplitude of the tail of a source that is switched on and off, shape (K,).

    The energy in the room follows the power of the source with the decay of the room.
    """
    step = 0.002
    before = np.arange(0.0, reverberation_s, step)
    weight = np.exp(-6.0 * np.log(10.0) * before / reverberation_s)
    power = emitter.loudness_at(time_s[:, None] - before) ** 2
    return np.asarray(np.sqrt(power @ weight / np.sum(weight)))
