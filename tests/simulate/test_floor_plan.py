import numpy as np
import pytest

from soundmap.simulate.floor_plan import FloorPlan, distance_to_walls

OUTER = [[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0]]
PILLAR = [[2.0, 1.0], [3.0, 1.0], [3.0, 2.0], [2.0, 2.0]]


@pytest.mark.parametrize("turn", [1, -1])
def test_a_pillar_is_cut_out_of_the_floor_whichever_way_it_is_drawn(turn: int) -> None:
    plan = FloorPlan.from_rings([OUTER[::turn], PILLAR], [0.9, [0.1, 0.2, 0.3, 0.4]])
    assert plan.area_m2 == pytest.approx(23.0)
    points = [[1.0, 1.0], [2.5, 1.5], [5.9, 3.9], [6.1, 1.0], [-0.1, 0.0]]
    assert plan.contains(points).tolist() == [True, False, True, False, False]
    assert plan.reflection.tolist() == [0.9] * 4 + [0.1, 0.2, 0.3, 0.4]


def test_a_way_through_the_pillar_is_crossed_and_one_that_ends_at_a_wall_is_not() -> None:
    plan = FloorPlan.from_rings([OUTER, PILLAR], [0.9, 0.9])
    start = np.array([[1.0, 1.5], [1.0, 1.5], [1.0, 3.0], [1.0, 3.0]])
    end = np.array([[4.0, 1.5], [2.0, 1.5], [5.0, 3.0], [7.0, 3.0]])
    assert plan.crossed(start, end).tolist() == [True, False, False, True]


def test_the_distance_to_the_nearest_wall_is_that_of_its_nearest_point() -> None:
    plan = FloorPlan.from_rings([OUTER, PILLAR], [0.9, 0.9])
    distance = distance_to_walls([[1.0, 1.5], [3.3, 2.4]], plan.start_m, plan.end_m)
    assert distance == pytest.approx([1.0, 0.5])
