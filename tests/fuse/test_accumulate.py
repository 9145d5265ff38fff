import numpy as np
import pytest

from soundmap.fuse.accumulate import PowerAccumulator, neighbourhood
from soundmap.grid import GridFrame
from soundmap.sound import LevelReference

FRAME = GridFrame(0.05, (-1.0, 2.0), (40, 60))
REFERENCE = LevelReference.FULL_SCALE


def test_running_mean_and_count_follow_equations_4_and_5():
    rng = np.random.default_rng(0)
    accumulator = PowerAccumulator(FRAME, REFERENCE)
    mean, count = np.zeros(FRAME.shape), np.zeros(FRAME.shape)
    for _ in range(300):
        point = rng.uniform([-0.5, 2.5], [1.5, 3.5])
        power, distance = rng.exponential(), rng.uniform(0.3, 3.0)
        size = np.radians(3.0) * distance
        accumulator.add(point, power, size_m=size)
        # The recursion of the paper, cell by cell.
        row, column = FRAME.cells(point)
        hit = [
            (i, j)
            for i in range(40)
            for j in range(60)
            if np.hypot(i - row, j - column) * 0.05 <= size / 2 + 1e-9
        ]
        for i, j in hit:
            mean[i, j] = (mean[i, j] * count[i, j] + power / len(hit)) / (count[i, j] + 1)
            count[i, j] += 1
    result = accumulator.power_map()
    assert np.array_equal(result.visits, count)
    assert np.allclose(np.nan_to_num(result.power()), mean, rtol=1e-12)


def test_shares_add_up_to_the_power_of_the_estimate():
    accumulator = PowerAccumulator(FRAME, REFERENCE)
    assert accumulator.add([0.0, 3.0], 5.0, size_m=0.16)
    result = accumulator.power_map()
    assert result.power_sum.sum() == pytest.approx(5.0)
    assert result.visits.sum() == 9


def test_shares_over_the_edge_are_lost_but_the_others_stay():
    accumulator = PowerAccumulator(FRAME, REFERENCE)
    assert accumulator.add([-0.99, 2.01], 9.0, size_m=0.16)
    assert accumulator.power_map().power_sum.sum() == pytest.approx(4.0)


def test_points_outside_the_map_add_nothing():
    accumulator = PowerAccumulator(FRAME, REFERENCE)
    assert not accumulator.add([-1.01, 2.5], 9.0, size_m=0.16)
    assert accumulator.power_map().visits.sum() == 0


def test_a_map_taken_on_the_way_does_not_grow_afterwards():
    accumulator = PowerAccumulator(FRAME, REFERENCE)
    accumulator.add([0.0, 3.0], 1.0, size_m=0.0)
    early = accumulator.power_map()
    accumulator.add([0.0, 3.0], 3.0, size_m=0.0)
    assert early.visits.sum() == 1
    assert accumulator.power_map().power()[FRAME.cells([0.0, 3.0])[0], 20] == pytest.approx(2.0)


@pytest.mark.parametrize("size", [0.0, 0.05, 0.1, 0.2, 0.5])
def test_neighbourhood_is_a_disc_about_the_cell(size):
    offsets = neighbourhood(size, 0.05)
    assert [0, 0] in offsets.tolist()
    assert np.all(np.hypot(*offsets.T) * 0.05 <= size / 2 + 1e-9)
    assert sorted(map(tuple, offsets)) == sorted(map(tuple, -offsets))
    area = np.pi * (size / 2) ** 2 / 0.05**2
    assert len(offsets) == pytest.approx(area, rel=0.35, abs=2)
