import numpy as np

from soundmap.detect.peaks import local_maxima


def test_maxima_of_a_smooth_map_are_its_summits():
    y, x = np.mgrid[0:60, 0:80]
    hills = [(10, 20, 3.0), (40, 60, 5.0), (45, 15, 1.0)]
    values = sum(h * np.exp(-((y - r) ** 2 + (x - c) ** 2) / 40) for r, c, h in hills)
    found = local_maxima(values, radius_cells=5).tolist()
    assert found[:3] == [[40, 60], [10, 20], [45, 15]]


def test_plateau_counts_once_at_its_middle():
    values = np.full((9, 9), np.nan)
    values[2:5, 3:8] = 2.0
    assert local_maxima(values, radius_cells=1.5).tolist() == [[3, 5]]


def test_missing_cells_neither_are_maxima_nor_hide_them():
    values = np.full((5, 5), np.nan)
    values[2, 2] = -3.0
    assert local_maxima(values, radius_cells=2).tolist() == [[2, 2]]
    assert len(local_maxima(np.full((5, 5), np.nan), radius_cells=2)) == 0


def test_of_two_maxima_within_the_radius_only_the_greater_counts():
    values = np.zeros((5, 20))
    values[2, 4], values[2, 8], values[2, 16] = 3.0, 2.0, 1.0
    kept = [cell for cell in local_maxima(values, radius_cells=5).tolist() if values[*cell] > 0]
    assert kept == [[2, 4], [2, 16]]


def test_equal_maxima_far_apart_are_both_found():
    values = np.zeros((3, 12))
    values[1, 2] = values[1, 9] = 1.0
    kept = [cell for cell in local_maxima(values, radius_cells=3).tolist() if values[*cell] > 0]
    assert kept == [[1, 2], [1, 9]]


def test_every_maximum_exceeds_its_surroundings_in_random_maps():
    rng = np.random.default_rng(0)
    values = np.where(rng.random((40, 50)) < 0.5, rng.random((40, 50)), np.nan)
    rows, columns = np.indices(values.shape)
    found = local_maxima(values, radius_cells=4.0)
    assert len(found) > 5
    for row, column in found:
        near = (rows - row) ** 2 + (columns - column) ** 2 <= 16
        assert values[row, column] == np.nanmax(values[near])
    assert np.all(np.diff(values[tuple(found.T)]) <= 0)
