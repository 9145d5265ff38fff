import numpy as np
import pyroomacoustics as pra
import pytest

from soundmap.simulate.reverberation import (
    eyring_time,
    mean_directivity,
    tail_density,
    tail_start,
    wave_directions,
)

SIZE = (6.0, 4.5, 2.6)
VOLUME = float(np.prod(SIZE))
AREAS = np.array([SIZE[0] * SIZE[1]] * 2 + [SIZE[0] * SIZE[2]] * 2 + [SIZE[1] * SIZE[2]] * 2)


def test_eyrings_time_is_that_of_the_textbook() -> None:
    time = eyring_time(VOLUME, AREAS, np.full(6, 0.9), speed_of_sound_m_s=343.0)
    absorption = 1.0 - 0.9**2
    assert time == pytest.approx(
        0.161 * VOLUME / (-AREAS.sum() * np.log(1 - absorption)), rel=0.005
    )


def test_the_tail_carries_the_energy_that_later_reflections_carry() -> None:
    """High-order image sources of pyroomacoustics in a shoebox, source and receiver apart."""
    reflection = 0.85
    material = pra.Material(1.0 - reflection**2)
    room = pra.ShoeBox(SIZE, fs=48000, materials=material, max_order=30, air_absorption=False)
    room.add_source([1.3, 3.1, 0.9])
    room.add_microphone([4.1, 1.2, 1.4])
    room.image_source_model()
    image, damping = room.sources[0].images, room.sources[0].damping[0]
    distance = np.linalg.norm(image.T - np.array([4.1, 1.2, 1.4]), axis=1)
    start = tail_start(VOLUME, float(AREAS.sum()), 2, speed_of_sound_m_s=343.0)
    late = distance / 343.0 >= start
    exact = np.sum((damping[late] / distance[late]) ** 2)
    time = eyring_time(VOLUME, AREAS, np.full(6, reflection), speed_of_sound_m_s=343.0)
    steps = np.arange(0.0, 2.0, 1e-5)
    density = tail_density(
        steps, volume_m3=VOLUME, reverberation_s=time, start_s=start, speed_of_sound_m_s=343.0
    )
    level = 10 * np.log10(np.sum(density) * 1e-5 / exact)
    assert level == pytest.approx(0.0, abs=1.5)  # diffuse-field theory itself is no better


def test_waves_come_evenly_from_all_sides() -> None:
    direction = wave_directions(32, np.random.default_rng(3))
    assert np.linalg.norm(direction, axis=1) == pytest.approx(np.ones(32))
    assert np.abs(direction.mean(axis=0)).max() < 0.02
    assert direction.T @ direction / 32 == pytest.approx(np.eye(3) / 3, abs=0.02)


def test_mean_directivity_is_the_mean_over_the_sphere() -> None:
    cosine = np.linspace(-1.0, 1.0, 200_001)
    fall = 10 ** (-12.0 / 20.0 * (1.0 - cosine))
    assert mean_directivity(12.0) == pytest.approx(fall.mean(), rel=1e-4)
    assert mean_directivity(0.0) == 1.0
