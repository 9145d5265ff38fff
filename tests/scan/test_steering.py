from __future__ import annotations

import numpy as np
import pytest
from plane_waves import circle, mic_array, scattered

from soundmap.scan.steering import (
    BEARINGS_A_TILE,
    PHASE_TOLERANCE_RAD,
    distinct_baselines,
    scan_bearings,
    steering_table,
    steering_vectors,
)

WAVENUMBER_6_KHZ = 2.0 * np.pi * 6000.0 / 343.0


def baselines_of(positions, tolerance_m=PHASE_TOLERANCE_RAD / WAVENUMBER_6_KHZ):
    return distinct_baselines(mic_array(positions).positions_m, tolerance_m=tolerance_m)


def grid(rows, columns, spacing_m=0.03):
    row, column = np.mgrid[:rows, :columns]
    return spacing_m * np.column_stack([column.ravel(), row.ravel()])


@pytest.mark.parametrize(
    ("positions", "expected"),
    [
        (circle(16), 64),  # an even circle repeats every baseline but its diameters: Q^2 / 4
        (circle(16, 0.155, 0.1), 64),
        (circle(4), 4),
        (circle(10), 25),
        (circle(5), 10),  # an odd one repeats none
        (grid(4, 4), 24),  # steps of -3..3 by -3..3, less none, up to sign
        (grid(1, 6), 5),
        (scattered(9, np.random.default_rng(1)), 36),
        ([[0.0, 0.0]], 0),
    ],
)
def test_repeated_baselines_are_found_from_the_geometry(positions, expected):
    baselines = baselines_of(positions)
    assert len(baselines) == expected + 1  # and that of each microphone with itself
    microphones = len(positions)
    pairs = {
        frozenset((int(m), int(n))) for m, n in zip(baselines.first, baselines.second, strict=True)
    }
    assert len(pairs) == len(baselines.first) == microphones * (microphones + 1) // 2


def test_positions_in_whole_micrometres_still_merge():
    rng = np.random.default_rng(2)
    positions = np.round(circle(16), 6)
    assert len(baselines_of(positions)) == 65
    # Rounding need not be as symmetric as it happens to be in a file of a symmetric array.
    shaken = circle(16) + rng.choice([-3e-7, 3e-7], (16, 2))
    assert len(baselines_of(shaken)) == 65
    moved = circle(16) + rng.choice([-3e-6, 3e-6], (16, 2))
    assert len(baselines_of(moved)) > 65


@pytest.mark.parametrize("shake_m", [0.0, 2e-7, 1e-6, 2e-6])
def test_merging_moves_no_phase_by_more_than_the_tolerance(shake_m):
    rng = np.random.default_rng(3)
    positions = circle(16) + rng.uniform(-shake_m, shake_m, (16, 2))
    baselines = baselines_of(positions)
    for m, n, line in zip(baselines.first, baselines.second, baselines.baseline, strict=True):
        error_m = np.hypot(*(positions[m] - positions[n] - baselines.vector_m[line]))
        assert error_m * WAVENUMBER_6_KHZ <= PHASE_TOLERANCE_RAD * (1.0 + 1e-9)


def test_microphones_in_one_place_have_a_baseline_of_nothing():
    baselines = baselines_of([[0.1, 0.0], [0.1, 0.0], [0.0, 0.0]])
    assert np.hypot(*baselines.vector_m.T).round(12).tolist() == [0.0, 0.1, 0.0]


def test_steering_vectors_are_the_phases_of_delays():
    rng = np.random.default_rng(4)
    positions = rng.uniform(-0.2, 0.2, (5, 3))
    bearing = rng.uniform(0.0, 2.0 * np.pi, 7)
    vectors = steering_vectors(positions, bearing, 2500.0, speed_of_sound_m_s=340.0)
    for n in range(7):
        for q in range(5):
            ahead_m = positions[q, 0] * np.cos(bearing[n]) + positions[q, 1] * np.sin(bearing[n])
            expected = np.exp(2j * np.pi * 2500.0 * ahead_m / 340.0)
            assert vectors[n, q] == pytest.approx(expected)


@pytest.mark.parametrize(("bearings", "rows"), [(120, 60), (45, 45)])
def test_opposite_bearings_share_a_row(bearings, rows):
    table = steering_table(
        mic_array(circle(6)).positions_m,
        bearings,
        first_bin=25,
        frequency_hz=np.array([1000.0, 1040.0]),
        weight=np.array([1.0, 2.0]),
        speed_of_sound_m_s=343.0,
    )
    assert table.cosine.shape == table.sine.shape == (2, 1 + 9, BEARINGS_A_TILE)
    assert np.all(table.cosine[:, 0, :rows] == np.array([[1.0], [2.0]]))
    assert not table.cosine[:, :, rows:].any()
    assert table.halved is (bearings % 2 == 0)
    assert np.allclose(table.bearing_rad, scan_bearings(bearings))
    assert scan_bearings(bearings)[0] == 0.0
    assert np.allclose(np.diff(scan_bearings(bearings)), 2.0 * np.pi / bearings)
