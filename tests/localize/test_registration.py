from dataclasses import replace

import numpy as np
import pytest

from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.localize.map_fit import map_surface
from soundmap.localize.registration import registered
from soundmap.localize.wall_lines import WallLines, wall_lines

FRAME = GridFrame(0.05, (-1.0, -1.0), (120, 160))
WALLS = [(0.0, 0.0), (6.0, 0.0), (6.0, 4.0), (0.0, 4.0)]
BLOCK = [(2.0, 1.5), (3.5, 1.5), (3.5, 2.5), (2.0, 2.5)]
SLANTED = [(0.3, 0.2), (5.8, 0.7), (5.4, 3.9), (0.1, 3.2)]


def surfaces(outlines):
    """Points 5 mm apart on closed outlines."""
    points = []
    for outline in outlines:
        corners = np.array(outline)
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            count = int(np.hypot(*(end - start)) / 0.005)
            points.append(start + np.linspace(0.01, 0.99, count)[:, None] * (end - start))
    return np.concatenate(points)


def drawn(points):
    """The surface of a map that has the cells in which the points lie."""
    occupied = np.zeros(FRAME.shape, dtype=bool)
    occupied[tuple(FRAME.cells(points).T)] = True
    return map_surface(OccupancyGrid(FRAME, occupied, ~occupied))


def lines_of(surface, points, seed=0):
    noise = np.random.default_rng(seed).normal(0.0, 0.01, (4, *points.shape))
    return wall_lines(surface, [points + each for each in noise])


def rigid_shift(before, after, surface):
    """Shift in x, y [m] and turn [rad] about the origin that the lines have made."""
    normal, centre = before.normal, surface.centre_m
    slope = np.column_stack([normal, normal[:, 1] * centre[:, 0] - normal[:, 0] * centre[:, 1]])
    found, *_ = np.linalg.lstsq(slope, after.offset_m - before.offset_m, rcond=None)
    return found


def moved(points, shift):
    """Points turned and shifted by a small rigid motion."""
    x, y, turn = shift
    return points + [x, y] + turn * np.column_stack([-points[:, 1], points[:, 0]])


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (0.02, -0.015, 0.003), (-0.045, 0.04, -0.004)])
def test_lines_that_are_off_together_come_back_to_their_cells(shift):
    points = surfaces([SLANTED])
    surface = drawn(points)
    lines = lines_of(surface, moved(points, shift))
    back = rigid_shift(lines, registered(surface, lines), surface)
    assert back[:2] == pytest.approx(-np.array(shift[:2]), abs=0.004)
    assert back[2] == pytest.approx(-shift[2], abs=0.0007)


def test_walls_on_the_edges_of_their_cells_shift_nothing_if_one_is_drawn_on_the_other_side():
    """Nine tenths of the cells have their centres half a cell above and right of the surface."""
    walls, block = surfaces([WALLS]), surfaces([BLOCK])
    points = np.concatenate([walls, block])
    surface = drawn(np.concatenate([walls + 1e-4, block + np.where(block > 2.0, -1e-4, 1e-4)]))
    centred = moved(points, (0.022, 0.022, 0.0))  # where all cells together pull the lines
    lines = lines_of(surface, centred)
    back = rigid_shift(lines, registered(surface, lines), surface)
    assert back[:2] == pytest.approx([-0.022, -0.022], abs=0.008)


def test_a_roughly_drawn_map_moves_lines_by_millimetres():
    """Three cells in ten are drawn beside their place."""
    points = surfaces([SLANTED])
    rng = np.random.default_rng(3)
    cells = np.unique(FRAME.cells(points), axis=0)
    stray = rng.random(len(cells)) < 0.3
    cells[stray] += rng.integers(-1, 2, (np.count_nonzero(stray), 2))
    surface = drawn(FRAME.centres(cells))
    lines = lines_of(surface, points)
    assert np.abs(rigid_shift(lines, registered(surface, lines), surface)[:2]).max() < 0.006


def test_a_part_of_a_site_that_has_drifted_is_drawn_back_to_its_cells():
    """A piece of one wall lies seven centimetres outside."""
    points = surfaces([WALLS])
    points[:, 1] += 0.02  # through the middle of cells
    surface = drawn(points)
    drifted = (points[:, 1] > 3.9) & (points[:, 0] > 2.0) & (points[:, 0] < 4.0)
    lines = lines_of(surface, points + drifted[:, None] * [0.0, 0.07])
    top, x = surface.centre_m[:, 1] > 3.9, surface.centre_m[:, 0]
    moved_m = (registered(surface, lines).offset_m - lines.offset_m) * lines.normal[:, 1]
    piece, rest = np.abs(x - 3.0) < 0.7, (x > 0.5) & (x < 5.5) & (np.abs(x - 3.0) > 1.3)
    back_m = np.median(moved_m[top & piece]) - np.median(moved_m[top & rest])
    assert back_m == pytest.approx(-0.0035, abs=0.0007)  # a tenth of what is outside


def test_nothing_is_moved_along_a_single_wall():
    points = np.column_stack([np.linspace(0.0, 5.0, 1000), np.full(1000, 1.02)])
    surface = drawn(points)
    lines = lines_of(surface, points)
    after = registered(surface, lines)
    assert np.abs(after.offset_m - lines.offset_m).max() < 0.03
    assert np.array_equal(after.normal, lines.normal)


def test_a_large_map_is_judged_by_some_of_its_cells(monkeypatch):
    points = surfaces([SLANTED])
    surface = drawn(points)
    lines = lines_of(surface, moved(points, (0.02, -0.015, 0.003)))
    monkeypatch.setattr("soundmap.localize.registration.MOST_CELLS", 100)
    back = rigid_shift(lines, registered(surface, lines), surface)
    assert back[:2] == pytest.approx([-0.02, 0.015], abs=0.006)


def test_no_lines_stay_no_lines():
    surface = drawn(surfaces([SLANTED]))
    count = len(surface.centre_m)
    none = WallLines(np.zeros((count, 2)), np.zeros(count))
    assert registered(surface, none) == none
    alone = none.normal.copy()
    alone[0] = 1.0, 0.0
    assert np.isfinite(registered(surface, replace(none, normal=alone)).offset_m).all()
