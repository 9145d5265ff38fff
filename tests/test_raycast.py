import numpy as np
import pytest
import worlds

from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.raycast import cast_ranges


def sampled_range(room, origin, bearing, *, range_max_m, step_m=0.001):
    """Plain reference: walk in steps of a millimetre, note the first stretch inside a wall."""
    distance = np.arange(0.0, range_max_m, step_m)
    points = np.array(origin) + distance[:, None] * [np.cos(bearing), np.sin(bearing)]
    cells = room.frame.cells(points)
    inside = room.frame.contains(cells)
    hit = np.zeros(len(points), dtype=bool)
    hit[inside] = room.occupied[cells[inside, 0], cells[inside, 1]]
    if not hit.any():
        return range_max_m
    first = np.argmax(hit)
    same_cell = np.all(cells == cells[first], axis=1)
    last = np.flatnonzero(same_cell & hit)[-1]
    return 0.0 if first == 0 else 0.5 * (distance[first] + distance[last])


def test_rays_agree_with_a_fine_walk_in_a_random_map():
    rng = np.random.default_rng(4)
    frame = GridFrame(0.05, (-2.0, 1.0), (90, 110))
    room = OccupancyGrid(frame, rng.random(frame.shape) < 0.01, np.ones(frame.shape, dtype=bool))
    origin = rng.uniform([-2.5, 0.5], [4.0, 6.0], size=(200, 2))  # some start outside the map
    bearing = rng.uniform(-np.pi, np.pi, 200)
    cast = cast_ranges(room, origin, bearing, range_max_m=4.0)
    slow = [
        sampled_range(room, o, b, range_max_m=4.0) for o, b in zip(origin, bearing, strict=True)
    ]
    off = np.abs(cast - slow)
    assert np.quantile(off, 0.97) < 0.002  # a step may miss the corner of a cell altogether
    assert np.mean(np.array(slow) < 4.0) > 0.3


def test_rays_along_the_axes_end_in_the_middle_of_the_wall():
    room = worlds.room()
    bearing = np.array([0.0, np.pi / 2, np.pi, -np.pi / 2])
    cast = cast_ranges(room, [1.0, 1.0], bearing, range_max_m=30.0)
    assert cast == pytest.approx([6.025, 4.025, 0.975, 0.975], abs=1e-9)


def test_ranges_in_a_room_agree_with_its_exact_geometry():
    rng = np.random.default_rng(5)
    origin = rng.uniform([0.2, 0.2], [1.8, 1.8], size=(2000, 2))
    bearing = rng.uniform(-np.pi, np.pi, 2000)
    off = cast_ranges(worlds.room(), origin, bearing, range_max_m=30.0) - worlds.exact_ranges(
        origin, bearing
    )
    assert np.median(np.abs(off)) < 0.01
    assert abs(np.median(off)) < 0.005


def test_rays_that_meet_nothing_have_the_greatest_range():
    frame = GridFrame(0.1, (0.0, 0.0), (10, 10))
    empty = OccupancyGrid(frame, np.zeros((10, 10), dtype=bool), np.ones((10, 10), dtype=bool))
    cast = cast_ranges(empty, [[0.5, 0.5], [-3.0, 0.5]], [0.3, 0.0], range_max_m=7.0)
    assert cast.tolist() == [7.0, 7.0]


def test_a_ray_that_starts_in_a_wall_has_range_zero():
    room = worlds.room()
    assert cast_ranges(room, [0.025, 1.0], 0.0, range_max_m=5.0) == 0.0


def test_rays_from_outside_the_map_enter_it():
    room = worlds.room()
    cast = cast_ranges(room, [-5.0, 1.0], 0.0, range_max_m=30.0)
    assert cast == pytest.approx(5.025)
