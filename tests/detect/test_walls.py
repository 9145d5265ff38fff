import numpy as np

from soundmap.detect.walls import HIT_CELL_M, surface_pieces, wall_lines


def segment(start, end, rng):
    along = np.arange(0.0, 1.0, 0.04 / np.hypot(*np.subtract(end, start)))[:, None]
    points = np.array(start) + along * np.subtract(end, start)
    return points + 0.008 * rng.standard_normal(points.shape)


def test_every_wall_of_a_room_is_found_and_a_short_thing_is_not():
    rng = np.random.default_rng(2)
    corners = [(0.0, 0.0), (5.0, 0.8), (4.4, 4.8), (-0.6, 4.0)]
    sides = [segment(corners[i], corners[(i + 1) % 4], rng) for i in range(4)]
    thing = segment((2.0, 2.0), (2.5, 2.3), rng)
    lines = wall_lines(np.concatenate([*sides, thing]))
    assert len(lines) == 4
    for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
        off = np.abs(lines[:, :2] @ np.array([start, end]).T - lines[:, 2:])
        assert off.max(axis=1).min() < 0.02


def test_too_few_points_make_no_wall():
    assert wall_lines(np.zeros((3, 2))).shape == (0, 3)


def test_pieces_fill_a_wall_evenly_whatever_cells_it_crosses():
    rng = np.random.default_rng(5)
    wall = segment((0.0, 0.0), (1.5, 2.0), rng)
    pieces = surface_pieces(wall)
    along, off = pieces @ np.array([0.6, 0.8]), pieces @ np.array([0.8, -0.6])
    assert np.abs(off).max() < 0.04
    held = np.histogram(along, np.arange(0.1, 2.4, 0.02))[0] * HIT_CELL_M
    assert held.max() < 3.0 * held.mean()
    assert held.min() > 0.0


def test_pieces_of_single_points_stay_with_them():
    points = np.array([[0.0, 0.0], [3.0, 1.0]])
    pieces = surface_pieces(points).reshape(2, -1, 2)
    np.testing.assert_allclose(pieces, np.broadcast_to(points[:, None], pieces.shape))
    assert surface_pieces(np.zeros((0, 2))).shape == (0, 2)
