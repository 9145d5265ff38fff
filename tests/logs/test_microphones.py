"""Broken microphones are found from what they deliver; sound ones are left alone."""

from pathlib import Path

import numpy as np
import pytest

from soundmap.config import loaded_config
from soundmap.logs.microphones import microphone_health
from soundmap.logs.robot_log import open_log

SHARED = Path(__file__).parents[2] / ".." / "shared" / "data"
SAMPLES = Path(__file__).parents[2] / "sample_logs"
RATE = 16000
ANGLE = np.arange(8) * 2 * np.pi / 8
CIRCLE = 0.12 * np.stack([np.cos(ANGLE), np.sin(ANGLE), 0 * ANGLE], axis=-1)


def plane_waves(rng, positions, *, count=60, length=320, waves=3, self_noise=0.05):
    """Probes of a field of plane waves from random directions, each wave noise of its own."""
    frequency = np.fft.rfftfreq(length, 1 / RATE)
    probes = []
    for _ in range(count):
        spectrum = np.zeros((len(frequency), len(positions)), dtype=complex)
        for _ in range(waves):
            azimuth = rng.uniform(0, 2 * np.pi)
            ahead = positions[:, :2] @ [np.cos(azimuth), np.sin(azimuth)] / 343.0
            wave = rng.standard_normal(len(frequency)) + 1j * rng.standard_normal(len(frequency))
            spectrum += wave[:, None] * np.exp(2j * np.pi * frequency[:, None] * ahead)
        probe = np.fft.irfft(spectrum, length, axis=0)
        probe += self_noise * np.std(probe) * rng.standard_normal(probe.shape)
        probes.append(0.02 * probe / np.std(probe))
    return probes


def health(probes, positions=CIRCLE):
    return microphone_health(probes, RATE, positions)


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("spacing_m", [0.04, 0.2])
def test_a_sound_array_is_never_called_faulty(seed, spacing_m):
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-spacing_m, spacing_m, (6, 3)) * [1, 1, 0]
    gains = 10 ** (rng.uniform(-4, 4, 6) / 20)
    probes = plane_waves(rng, positions, waves=1 + seed % 4, self_noise=0.1 * seed)
    assert health([probe * gains for probe in probes], positions).sound.all()


@pytest.mark.parametrize("array", ["lab", "sample_logs"])
@pytest.mark.parametrize("run", ["run1", "run3"])
def test_the_microphones_of_recorded_logs_are_sound(array, run):
    folder = SAMPLES if array == "sample_logs" else SHARED / "lab"
    if not folder.is_dir():
        pytest.skip("the lab logs (../shared/data/lab) are not here")
    log = open_log(folder / f"{run}.mcap", loaded_config([folder / "robot.toml"]))
    assert log.array.microphones == 16
    assert not any("microphone" in loss.what for loss in log.losses)


def test_real_microphones_are_sound_and_one_turned_round_is_found():
    recordings = sorted((SHARED / "arrays" / "multi_ssl").glob("*/*.wav"))
    if not recordings:
        pytest.skip("the recordings (../shared/data/arrays) are not here")
    import soundfile

    side = 0.02285
    positions = side * np.array([[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    for recording in recordings:
        samples, rate = soundfile.read(recording)
        probes = np.split(samples[: len(samples) // 160 * 160], len(samples) // 160)[::4]
        assert microphone_health(probes, rate, positions).sound.all()
        turned = microphone_health([p * [1, 1, -1, 1] for p in probes], rate, positions)
        assert turned.inverted.tolist() == [False, False, True, False]


def test_a_dead_microphone_is_found_also_if_it_dies_on_the_way():
    probes = plane_waves(np.random.default_rng(1), CIRCLE)
    for i, probe in enumerate(probes):
        probe[:, 2] = 0.3  # a constant voltage is no sound
        if i >= 40:
            probe[:, 5] *= 1e-4
    found = health(probes)
    assert np.flatnonzero(found.dead).tolist() == [2, 5]
    assert np.flatnonzero(found.silent[:, 5])[0] == 40
    assert np.flatnonzero(~found.sound).tolist() == [2, 5]


def test_half_of_the_microphones_may_be_dead():
    probes = plane_waves(np.random.default_rng(1), CIRCLE)
    for probe in probes:
        probe[:, 4:] = 0.0
    assert health(probes).dead.tolist() == [False] * 4 + [True] * 4


def test_quiet_moments_of_all_microphones_are_no_fault():
    probes = plane_waves(np.random.default_rng(2), CIRCLE)
    rng = np.random.default_rng(3)
    for probe in probes[20:40]:
        probe[:] = np.rint(0.6 * rng.standard_normal(probe.shape)) / 2**15
        probe[:, 3] = 0.0
    assert health(probes).sound.all()


@pytest.mark.parametrize("turned", [[1], [0, 4, 6]])
def test_microphones_the_wrong_way_round_are_found(turned):
    probes = plane_waves(np.random.default_rng(4), CIRCLE)
    for probe in probes:
        probe[:, turned] *= -1
    found = health(probes)
    assert np.flatnonzero(found.inverted).tolist() == turned
    assert np.flatnonzero(~found.sound).tolist() == turned


def test_half_the_wrong_way_round_is_not_guessed_at():
    probes = plane_waves(np.random.default_rng(4), CIRCLE)
    for probe in probes:
        probe[:, ::2] *= -1
    assert health(probes).sound.all()


def test_a_disconnected_microphone_that_picks_up_noise_is_found():
    rng = np.random.default_rng(5)
    probes = plane_waves(rng, CIRCLE)
    for probe in probes:
        probe[:, 6] = 0.02 * rng.standard_normal(len(probe))
    found = health(probes)
    assert np.flatnonzero(found.unrelated).tolist() == [6]
    for probe in probes:
        probe[:, 6] *= 30.0
    assert np.flatnonzero(health(probes).odd_level).tolist() == [6]
    assert health(probes).sound.sum() == 7


@pytest.mark.parametrize("limit", [1.0, 0.03])
def test_clipping_is_found_at_any_level_and_loud_sound_is_none(limit):
    probes = plane_waves(np.random.default_rng(6), CIRCLE)
    loud = [probe * (limit / 0.02 / 2) for probe in probes]  # beyond the limit 5 % of the time
    clipped = [np.rint(np.clip(probe, -limit, limit) * 2**15) / 2**15 for probe in loud]
    unclipped = [np.rint(probe / 3 * 2**15) / 2**15 for probe in loud]
    found = health(clipped)
    np.testing.assert_allclose(found.clipped_share, 0.0455, rtol=0.15)
    assert found.sound.all()
    assert not health(unclipped).clipped_share.any()


def test_without_positions_levels_are_judged_all_the_same():
    probes = plane_waves(np.random.default_rng(7), CIRCLE)
    for probe in probes:
        probe[:, 0] = np.nan
    found = microphone_health(probes, RATE, None)
    assert np.flatnonzero(~found.sound).tolist() == [0]
