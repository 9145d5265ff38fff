"""Maps of one site in two frames are laid on each other by their walls."""

import itertools

import numpy as np
import pytest

from soundmap.geometry import inverted, transformed, wrapped_angle
from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.mapping.map_match import matched_maps

L_SHAPE = [(0, 0), (7, 0), (7, 3), (4.2, 3), (4.2, 5.5), (0, 5.5), (0, 0)]
SQUARE = [(0, 0), (5, 0), (5, 5), (0, 5), (0, 0)]
CORRIDOR = [[(0, 0), (40, 0)], [(0, 2), (40, 2)]]


def points_on(corners):
    corners = np.array(corners, dtype=float)
    steps = np.linspace(0.0, 1.0, 800)[:, None]
    legs = itertools.pairwise(corners)
    return np.concatenate([start + steps * (end - start) for start, end in legs])


def drawn(points_m, pose=(0.0, 0.0, 0.0), *, seed=0):
    """A map whose frame has a pose in that of the points; walls are blurred by a centimetre."""
    rng = np.random.default_rng(seed)
    points = transformed(inverted(pose), points_m + rng.normal(0.0, 0.01, points_m.shape))
    low = points.min(axis=0) - 1.0
    rows, columns = (np.ceil((points.max(axis=0) + 1.0 - low) / 0.05).astype(int))[::-1]
    frame = GridFrame(0.05, (float(low[0]), float(low[1])), (int(rows), int(columns)))
    occupied = np.zeros(frame.shape, dtype=bool)
    occupied[tuple(frame.cells(points).T)] = True
    return OccupancyGrid(frame, occupied, ~occupied)


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (0.7, -1.2, 0.2), (3.0, 4.0, 2.0)])
def test_the_pose_between_two_maps_is_found(pose):
    walls = points_on(L_SHAPE)
    match = matched_maps(drawn(walls), drawn(walls, pose, seed=1))
    assert match.agreeing > 0.95
    assert match.pose[:2] == pytest.approx(pose[:2], abs=0.03)
    assert wrapped_angle(match.pose[2] - pose[2]) == pytest.approx(0.0, abs=0.01)


def test_what_stands_about_in_one_of_them_does_not_matter():
    walls, box = points_on(L_SHAPE), points_on([(1, 1), (1.8, 1), (1.8, 1.6), (1, 1.6), (1, 1)])
    match = matched_maps(drawn(np.concatenate([walls, box])), drawn(walls, (0.5, 0.3, -0.1)))
    assert match.pose == pytest.approx([0.5, 0.3, -0.1], abs=0.03)


def test_of_places_that_look_alike_the_one_near_the_origin_is_taken():
    walls = points_on(SQUARE)
    match = matched_maps(drawn(walls), drawn(walls, (0.4, 0.2, 0.1)))
    assert match.pose == pytest.approx([0.4, 0.2, 0.1], abs=0.03)


def test_walls_that_do_not_tell_where_along_them_are_no_match():
    walls = np.concatenate([points_on(leg) for leg in CORRIDOR])
    middle = np.abs(walls[:, 0] - 20.0) < 10.0
    assert matched_maps(drawn(walls), drawn(walls[middle], (1.0, 0.0, 0.0))) is None


def test_other_sites_and_empty_maps_are_no_match():
    rng = np.random.default_rng(3)
    anywhere = rng.uniform(0.0, 8.0, (60, 2))
    assert matched_maps(drawn(points_on(L_SHAPE)), drawn(anywhere)) is None
    nothing = drawn(points_on(L_SHAPE))
    nothing = OccupancyGrid(nothing.frame, np.zeros_like(nothing.occupied), nothing.free)
    assert matched_maps(nothing, drawn(points_on(L_SHAPE))) is None
