import numpy as np
import pytest

from soundmap.geometry import transformed, wrapped_angle
from soundmap.mapping.correlation import CELL_M, best_placement, nearness_grid
from tests import worlds


def wall_points(spacing=0.03):
    parts = []
    for start, end in worlds.segments():
        count = int(np.linalg.norm(end - start) / spacing) + 1
        parts.append(np.linspace(start, end, count))
    return np.concatenate(parts)


def test_the_search_finds_what_trying_every_pose_finds():
    rng = np.random.default_rng(4)
    points = wall_points()
    grid = nearness_grid(points, np.array([3.0, 2.0]))
    scan = rng.uniform([-2, -2], [2, 2], (40, 2))
    expected = np.array([3.01, 2.02, 0.3])
    found = best_placement(grid, scan, expected, window_m=0.5, window_rad=0.1)
    step = CELL_M / max(np.quantile(np.hypot(*scan.T), 0.9), 1.0)
    turns = int(np.ceil(0.1 / step))
    best = -1.0
    rows, columns = grid.levels.shape[1:]
    for heading in expected[2] + step * np.arange(-turns, turns + 1):
        turned = transformed(np.array([*expected[:2], heading]), scan) - grid.origin_m
        cell = np.floor(turned / CELL_M).astype(int)
        for a in range(-10, 11):
            for b in range(-10, 11):
                row, column = cell[:, 1] + a, cell[:, 0] + b
                inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
                value = grid.levels[0][row[inside], column[inside]].astype(float).sum()
                best = max(best, value / 255 / len(scan))
    assert found.score == pytest.approx(best)


def test_a_scan_of_a_room_is_placed_to_within_a_cell():
    truth = np.array([3.1, 1.4, 0.8])
    bearing = np.linspace(-2.3, 2.3, 180)
    ranges = worlds.exact_ranges(np.tile(truth[:2], (180, 1)), truth[2] + bearing)
    scan = np.stack([ranges * np.cos(bearing), ranges * np.sin(bearing)], axis=-1)
    grid = nearness_grid(wall_points(), truth[:2])
    found = best_placement(
        grid,
        scan,
        truth + np.array([1.1, -0.8, 0.5]),
        window_m=2.0,
        window_rad=0.7,
        rival_beyond_m=0.5,
    )
    assert np.hypot(*(found.pose - truth)[:2]) < 1.5 * CELL_M
    assert abs(wrapped_angle(found.pose[2] - truth[2])) < 0.03
    assert found.score > 0.8
    assert found.rival < 0.7 * found.score, "an L-shaped room looks like itself nowhere else"


def test_a_corridor_has_rivals_all_along():
    x = np.arange(-10, 10, 0.04)
    walls = np.concatenate([np.stack([x, np.full(len(x), side)], -1) for side in (-1.0, 1.0)])
    scan = walls[np.abs(walls[:, 0]) < 3]
    found = best_placement(
        nearness_grid(walls, np.zeros(2)),
        scan,
        np.array([0.6, 0.1, 0.05]),
        window_m=1.5,
        window_rad=0.2,
        rival_beyond_m=0.5,
    )
    assert found.rival > 0.95 * found.score


def test_every_level_bounds_the_one_below():
    grid = nearness_grid(np.random.default_rng(0).uniform(-2, 2, (60, 2)), np.zeros(2))
    base = grid.levels[0].astype(int)
    for level in range(1, len(grid.levels)):
        size = 2**level
        padded = np.pad(base, ((0, size), (0, size)))
        shifted = [
            padded[a : a + base.shape[0], b : b + base.shape[1]]
            for a in range(size)
            for b in range(size)
        ]
        np.testing.assert_array_equal(grid.levels[level], np.max(shifted, axis=0))


def test_nothing_is_found_where_nothing_is_good_enough():
    grid = nearness_grid(wall_points(), np.array([3.0, 2.0]))
    scan = np.random.default_rng(1).uniform(-1, 1, (50, 2))
    at = np.array([3.0, 1.0, 0.0])
    assert best_placement(grid, scan, at, window_m=0.3, window_rad=0.1, least_score=0.9) is None
