import numpy as np

from soundmap.detect.walls import wall_lines


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
