from dataclasses import replace

import numpy as np
import pytest

from soundmap.config import ArrayConfig, ScanConfig
from soundmap.detect.evidence import (
    LONG_RUN_SCANS,
    gathered_evidence,
    ranged_scans,
    velocities,
)
from soundmap.geometry import Mount, Trajectory, wrapped_angle
from soundmap.sensors import MicArray
from soundmap.sound import AudioScans, LevelReference
from tests.detect.box_room import observed

ARRAY = MicArray(ArrayConfig().microphone_positions(), Mount.planar(0.1, 0.0, 0.5, 0.3), None)


def driven_laps(count, *, radius_m=4.0, scans=500):
    """Laps on a circle, 5 cm from scan to scan; each scan is as loud as its number."""
    rng = np.random.default_rng(1)
    number = np.arange(count * scans)
    time_ns = 10**18 + number * 100_000_000
    at = np.concatenate([time_ns - 50_000_000, time_ns[-1:] + 50_000_000])
    turn = 2 * np.pi * np.arange(len(at)) / scans
    pose = np.column_stack([radius_m * np.cos(turn), radius_m * np.sin(turn), turn])
    trajectory = Trajectory(at, pose, np.ones(len(at), dtype=bool))
    power = (1.0 + number)[:, None] * rng.uniform(0.5, 1.5, (len(number), 120))
    kept = AudioScans(
        time_ns,
        2 * np.pi * np.arange(120) / 120,
        power.astype(np.float32),
        LevelReference.FULL_SCALE,
        ARRAY.mount,
    )
    return kept, trajectory


def laps(count):
    kept, trajectory = driven_laps(count)
    ranges = np.full((len(kept), 360), 2.0, dtype=np.float32)
    return gathered_evidence(kept, ranges, trajectory, ARRAY, ScanConfig())


def test_a_short_run_is_used_whole():
    evidence = laps(2)
    assert len(evidence) == 1000
    assert np.all(evidence.merged == 1)


@pytest.mark.parametrize("count", [3, 12])
def test_of_a_long_run_as_much_is_used_as_of_a_short_one_from_everywhere_at_all_times(count):
    evidence = laps(count)
    assert 500 < len(evidence) <= LONG_RUN_SCANS
    assert np.all(evidence.merged == 1)  # no means, which scatter less than the fit knows
    angle = np.sort(np.arctan2(evidence.place_m[:, 1], evidence.place_m[:, 0]))
    assert np.diff(angle).max() * 4.0 < 0.3
    when = 1.0 / evidence.weight[:, 0] / (1.0 / evidence.weight[:, 0]).max()
    used = np.histogram(when, np.linspace(0.0, 1.0, count + 1))[0]
    assert used.min() > 0.2 * used.max()


@pytest.mark.parametrize("count", [1, 12])
def test_ranges_are_needed_of_just_those_scans_that_are_told(count):
    kept, trajectory = driven_laps(count)
    needed = ranged_scans(kept, trajectory, ARRAY, ScanConfig())
    ranges = np.full((len(kept), 360), np.nan, dtype=np.float32)
    ranges[needed] = needed[:, None]
    evidence = gathered_evidence(kept, ranges, trajectory, ARRAY, ScanConfig())
    assert evidence.range_m[:, 0].tolist() == needed.tolist()


@pytest.mark.parametrize("heading", [0.0, np.pi - 0.50, np.pi - 0.54])  # two turn past west
def test_velocities_are_those_of_the_array_at_each_scan(heading):
    scans, _, track, array = observed([(5.0, 3.0, 10.0)])
    turned = wrapped_angle(track.pose[:, 2] + heading)  # as it stands; it still drives as before
    track = replace(track, pose=np.column_stack([track.pose[:, :2], turned]))
    config = ScanConfig()
    evidence = gathered_evidence(
        scans, np.ones((len(scans), 360), np.float32), track, array, config
    )
    rate = velocities(scans, track, array, config)
    assert rate.shape == (len(evidence), 3)
    turning = np.abs(rate[:, 2]) > 0.5
    np.testing.assert_allclose(rate[turning][3:-3, 2], 0.5 * np.pi / 2.0, rtol=0.05)
    straight = evidence.place_m[:, 0] < 3.5
    np.testing.assert_allclose(
        rate[straight][1:, :2], [[0.3, 0.0]] * (straight.sum() - 1), atol=1e-6
    )
