"""Moving receivers against closed forms: delays, levels, Doppler shift."""

import numpy as np
import pytest

from soundmap.simulate.floor_plan import FloorPlan
from soundmap.simulate.image_sources import level_sequences, wall_sequences
from soundmap.simulate.propagation import KNOT_STEP, SoundTable, add_delayed
from soundmap.simulate.scene import Source
from soundmap.simulate.sound_field import Emitter, SoundField

RATE, SPEED = 48000.0, 343.0


def sine(frequency: float) -> SoundTable:
    time = np.arange(4 * 48000) / (4 * RATE)
    return SoundTable.from_period(np.sin(2 * np.pi * frequency * time).astype(np.float32), 4, RATE)


def free_field(frequency: float, **source: object) -> SoundField:
    """A source at (100, 100, 1) whose tone has amplitude 1 at 1 m; walls that swallow all."""
    corners = [[0.0, 0.0], [900.0, 0.0], [900.0, 900.0], [0.0, 900.0]]
    plan = FloorPlan.from_rings([corners], [0.0])
    described = Source(id="S", position_m=(100.0, 100.0, 1.0), level_dba_5cm=80.0, **source)
    emitter = Emitter(described, np.zeros(24001, dtype=complex), sine(frequency))
    sequences, levels = tuple(wall_sequences(plan, 2)), level_sequences(3.0, 0.0, 0.0, 2)
    return SoundField(plan, SPEED, sequences, levels, (emitter,), ())


def heard(field: SoundField, microphones: np.ndarray, first_s: float = 0.0) -> np.ndarray:
    """What microphones (Q, K + 1, 3) hear, shape (Q, K * KNOT_STEP)."""
    knots = microphones.shape[1]
    out = np.zeros((len(microphones), (knots - 1) * KNOT_STEP), dtype=np.float32)
    field.add_sound(out, first_s + np.arange(knots) * KNOT_STEP / RATE, microphones)
    return out


def phase_line(signal: np.ndarray, near_hz: float) -> tuple[float, float]:
    """Frequency [Hz] and phase at time 0 [rad] of a tone, by a line through its phase."""
    time = np.arange(len(signal)) / RATE
    window = 240  # whole periods of the tones used here
    mixed = signal * np.exp(-2j * np.pi * near_hz * time)
    smooth = np.convolve(mixed, np.hanning(window + 1), mode="valid")
    phase = np.unwrap(np.angle(smooth))
    slope, at_zero = np.polyfit(time[: len(phase)] + 0.5 * window / RATE, phase, 1)
    return near_hz + slope / (2 * np.pi), at_zero


def standing(*distances: float) -> np.ndarray:
    place = np.array([[100.0 + d, 100.0, 1.0] for d in distances])
    return np.repeat(place[:, None], 51, axis=1)


def test_the_level_falls_by_6_db_with_each_doubling_of_the_distance() -> None:
    tone = heard(free_field(1000.0), standing(0.5, 1.0, 2.0, 4.0))
    level = 10 * np.log10(2 * np.mean(tone.astype(float) ** 2, axis=1))
    assert level == pytest.approx([6.0206, 0.0, -6.0206, -12.0412], abs=0.01)


@pytest.mark.parametrize("frequency", [400.0, 2000.0, 6000.0])
def test_delays_are_those_of_the_distance_to_a_hundredth_of_a_sample(frequency: float) -> None:
    distances = np.array([0.3, 1.2345, 2.7182, 4.4])
    tone = heard(free_field(frequency), standing(*distances))
    for signal, distance in zip(tone, distances, strict=True):
        _, phase = phase_line(signal, frequency)
        expected = -2 * np.pi * frequency * distance / SPEED - np.pi / 2
        error = np.angle(np.exp(1j * (phase - expected)))
        assert abs(error) / (2 * np.pi * frequency) * RATE < 0.01


def test_a_receiver_moving_toward_a_tone_hears_the_doppler_shift() -> None:
    time = np.arange(501) * KNOT_STEP / RATE
    place = np.stack([104.0 - time, np.full(501, 100.0), np.ones(501)], axis=-1)
    tone = heard(free_field(2000.0), place[None])[0]
    tone = tone * np.interp(np.arange(len(tone)) * time[-1] / len(tone), time, 4.0 - time)
    frequency, _ = phase_line(tone, 2000.0)
    assert frequency == pytest.approx(2000.0 * (1 + 1.0 / SPEED), abs=0.002)


def test_a_source_moving_toward_a_receiver_is_heard_by_the_other_doppler_formula() -> None:
    field = free_field(2000.0, way_points_m=((140.0, 100.0),), speed_m_s=20.0)
    place = np.tile([150.0, 100.0, 1.0], (1, 251, 1))
    tone = heard(field, place, first_s=0.5)[0]
    frequency, _ = phase_line(tone, 2000.0 / (1 - 20.0 / SPEED))
    assert frequency == pytest.approx(2000.0 / (1 - 20.0 / SPEED), abs=0.1)


def test_a_pass_at_close_range_is_heard_at_its_true_delay_throughout() -> None:
    time = np.arange(501) * KNOT_STEP / RATE
    place = np.stack([99.5 + time, np.full(501, 100.3), np.ones(501)], axis=-1)
    tone = heard(free_field(2000.0), place[None])[0]
    exact_time = np.arange(len(tone)) / RATE
    distance = np.hypot(99.5 + exact_time - 100.0, 0.3)
    exact = np.sin(2 * np.pi * 2000.0 * (exact_time - distance / SPEED)) / distance
    assert np.abs(tone - exact).max() < 2e-3 * np.abs(exact).max()


def test_the_loudness_behind_a_directional_source_is_lower_by_what_was_asked() -> None:
    field = free_field(1000.0, front_to_back_db=12.0)
    front = heard(field, standing(2.0))
    back = heard(field, standing(-2.0))
    assert 20 * np.log10(front.std() / back.std()) == pytest.approx(12.0, abs=0.01)


def test_fast_interpolation_equals_a_plain_cubic_through_the_table() -> None:
    rng = np.random.default_rng(3)
    dense, length, knots = 4, 4096, 7
    period = rng.standard_normal(dense * length).astype(np.float32)
    table = SoundTable.from_period(period, dense, RATE)
    emission = np.cumsum(rng.uniform(0.9, 1.1, (3, knots)), axis=1) * KNOT_STEP / RATE
    emission -= np.array([[0.002], [50.0], [0.0]])
    gain = rng.uniform(0.5, 1.0, (3, knots))
    out = np.zeros((3, (knots - 1) * KNOT_STEP), dtype=np.float32)
    add_delayed(out, table, emission, gain)

    sample = np.arange(out.shape[1])
    for m in range(3):
        place = np.interp(sample, np.arange(knots) * KNOT_STEP, emission[m] * RATE * dense)
        left = np.floor(place).astype(int)
        d = place - left
        y = [period[(left + k) % len(period)].astype(float) for k in (-1, 0, 1, 2)]
        slow = (
            -d * (d - 1) * (d - 2) / 6 * y[0]
            + (d + 1) * (d - 1) * (d - 2) / 2 * y[1]
            - (d + 1) * d * (d - 2) / 2 * y[2]
            + (d + 1) * d * (d - 1) / 6 * y[3]
        ) * np.interp(sample, np.arange(knots) * KNOT_STEP, gain[m])
        assert out[m] == pytest.approx(slow, abs=2e-3)
