from dataclasses import replace

import numpy as np
import pytest
import worlds

from soundmap.deskew import deskewed_rays
from soundmap.geometry import transformed
from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.localize.map_fit import map_surface, point_pull
from soundmap.localize.wall_lines import has_line, line_pull, wall_lines

ROOM = worlds.room()
TRUTH = worlds.driven([(1.0, 1.0), (4.0, 1.2), (1.2, 1.8)])
SCANS = worlds.laser_scans(TRUTH, [worlds.FRONT], rate_hz=5.0, beams=181)
POSES = TRUTH.at([scan.middle_ns for scan in SCANS])
POINTS = [deskewed_rays(scan, TRUTH, scan.middle_ns).end_m for scan in SCANS]
FIRST = np.concatenate([[0], np.cumsum([len(points) for points in POINTS])]).astype(np.int64)
FLAT = np.concatenate(POINTS)


def settled(pose, pull):
    """Gauss-Newton until it no longer moves."""
    for _ in range(30):
        information, step = pull(pose)
        pose = pose + np.linalg.solve(information + 1e-9 * np.eye(3), step[..., None])[..., 0]
    return pose


def by_map(pose):
    share = np.ones(len(FLAT))
    return point_pull(map_surface(ROOM), pose, FLAT, FIRST, share, sigma_m=0.05, kernel_m=0.2)


def test_points_are_pulled_onto_the_walls_of_the_map():
    rng = np.random.default_rng(0)
    guess = POSES + rng.normal(size=POSES.shape) * [0.05, 0.05, 0.015]
    off = settled(guess, by_map) - POSES
    assert np.median(np.hypot(off[:, 0], off[:, 1])) < 0.015
    assert np.degrees(np.median(np.abs(off[:, 2]))) < 0.3


def test_the_pull_is_the_gradient_of_the_cost():
    pose = POSES[:1] + np.array([0.02, -0.03, 0.01])
    points, first = POINTS[0], np.array([0, len(POINTS[0])], dtype=np.int64)
    field, share = map_surface(ROOM), np.ones(len(POINTS[0]))
    field = replace(field, normal=np.zeros_like(field.normal))  # as if no wall were straight
    first_centre = field.corner_m + 0.5 * field.resolution_m

    def pull(at, kernel):
        return point_pull(field, at, points, first, share, sigma_m=0.05, kernel_m=kernel)[1][0]

    def cost(at):  # of a kernel so wide that every weight is 1
        place = (transformed(at[0], points) - first_centre) / field.resolution_m
        column, row = np.floor(place).astype(int).T
        a, b = (place - np.floor(place)).T
        d = field.distance_m
        off = (1 - b) * ((1 - a) * d[row, column] + a * d[row, column + 1]) + b * (
            (1 - a) * d[row + 1, column] + a * d[row + 1, column + 1]
        )
        return 0.5 * np.sum((off / 0.05) ** 2)

    small = 1e-7
    numeric = [
        -(cost(pose + small * unit) - cost(pose - small * unit)) / (2 * small) for unit in np.eye(3)
    ]
    assert pull(pose, 1e3) == pytest.approx(numeric, rel=1e-3)


@pytest.mark.parametrize("angle_deg", [0.0, 7.0, 30.0, 45.0])
def test_a_straight_wall_says_nothing_about_the_place_along_it(angle_deg):
    """However the cells of a wall at an angle make steps."""
    frame = GridFrame(0.05, (0.0, 0.0), (200, 200))
    along = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    wall = np.array([5.0, 5.0]) + np.linspace(-4.0, 4.0, 4000)[:, None] * along
    occupied = np.zeros(frame.shape, dtype=bool)
    occupied[tuple(frame.cells(wall).T)] = True
    pose, points = np.array([[5.0, 5.0, 0.0]]), np.linspace(-2.0, 2.0, 200)[:, None] * along
    surface = map_surface(OccupancyGrid(frame, occupied, ~occupied))
    information, _ = point_pull(
        surface, pose, points, np.array([0, 200]), np.ones(200), sigma_m=0.05, kernel_m=0.15
    )
    values = np.linalg.eigvalsh(information[0, :2, :2])
    assert values[0] < 0.01 * values[1]


def test_lines_stand_where_the_returns_are_and_not_where_the_cells_are():
    """A wall 2 cm off the middle of its cells is found there."""
    frame = GridFrame(0.05, (0.0, 0.0), (40, 60))
    occupied = np.zeros(frame.shape, dtype=bool)
    occupied[20] = True  # centre at y = 1.025
    surface = map_surface(OccupancyGrid(frame, occupied, ~occupied))
    rng = np.random.default_rng(1)
    x = rng.uniform(0.2, 2.8, 2000)
    points = np.column_stack([x, 1.005 + 0.01 * x + rng.normal(0, 0.01, 2000)])
    lines = wall_lines(surface, [points])
    assert has_line(surface, lines, points).mean() > 0.95
    exists = np.any(lines.normal != 0, axis=1)
    middle = surface.centre_m[exists]
    normal, offset = lines.normal[exists], lines.offset_m[exists]
    y = (offset - normal[:, 0] * middle[:, 0]) / normal[:, 1]
    inner = (middle[:, 0] > 0.3) & (middle[:, 0] < 2.7)
    assert np.abs(y - (1.005 + 0.01 * middle[:, 0]))[inner].max() < 0.006


def test_poses_fitted_to_lines_agree_to_millimetres():
    surface = map_surface(ROOM)
    lines = wall_lines(surface, [transformed(np.repeat(POSES, np.diff(FIRST), axis=0), FLAT)])

    def by_lines(pose):
        every = np.ones(len(FLAT), dtype=bool)
        return line_pull(surface, lines, pose, FLAT, FIRST, every, sigma_m=0.05, kernel_m=0.15)

    rng = np.random.default_rng(2)
    off = settled(POSES + rng.normal(size=POSES.shape) * [0.03, 0.03, 0.01], by_lines) - POSES
    assert np.median(np.hypot(off[:, 0], off[:, 1])) < 0.003
    assert np.degrees(np.median(np.abs(off[:, 2]))) < 0.05


def test_scattered_returns_and_few_returns_are_no_line():
    surface = map_surface(ROOM)
    rng = np.random.default_rng(3)
    cloud = surface.centre_m[100] + rng.normal(0, 0.05, (500, 2))
    assert has_line(surface, wall_lines(surface, [cloud]), cloud).mean() < 0.05
    few = surface.centre_m[100] + np.linspace(-0.02, 0.02, 3)[:, None] * [1.0, 0.0]
    assert not has_line(surface, wall_lines(surface, [few]), few).any()


@pytest.mark.parametrize(("returns", "most_deg"), [(2000, 2.0), (150, 3.0)])
def test_lines_of_few_noisy_returns_follow_the_wall_of_the_map(returns, most_deg):
    """Nine returns to a line, with 1.5 cm of noise, tell its direction to 7 degrees only."""
    frame = GridFrame(0.05, (0.0, 0.0), (40, 60))
    occupied = np.zeros(frame.shape, dtype=bool)
    occupied[20] = True
    surface = map_surface(OccupancyGrid(frame, occupied, ~occupied))
    rng = np.random.default_rng(5)
    points = np.column_stack(
        [rng.uniform(0.2, 2.8, returns), 1.02 + rng.normal(0.0, 0.015, returns)]
    )
    lines = wall_lines(surface, [points])
    exists = np.any(lines.normal != 0, axis=1)
    assert exists.mean() > 0.3
    tilt = np.degrees(np.arctan2(lines.normal[exists, 0], lines.normal[exists, 1]))
    tilt = (tilt + 90.0) % 180.0 - 90.0
    assert np.sqrt(np.mean(tilt**2)) < most_deg


def test_points_far_from_every_wall_do_not_pull():
    far = np.array([[0.0, 1.0], [0.5, 1.0]])  # in the middle of the room, seen from (1, 1)
    pose = np.array([[1.0, 1.0, 0.0]])
    information, pull = point_pull(
        map_surface(ROOM), pose, far, np.array([0, 2]), np.ones(2), sigma_m=0.05, kernel_m=0.15
    )
    assert not information.any()
    assert not pull.any()


def test_points_that_do_not_count_are_as_if_they_were_not_there():
    surface, keep = map_surface(ROOM), np.random.default_rng(6).random(len(FLAT)) < 0.6
    first = np.concatenate([[0], np.cumsum(keep)])[FIRST]
    kernel = {"sigma_m": 0.05, "kernel_m": 0.15}
    some = point_pull(surface, POSES, FLAT, FIRST, keep, **kernel)
    alone = point_pull(surface, POSES, FLAT[keep], first, np.ones(keep.sum()), **kernel)
    assert np.array_equal(some[0], alone[0])
    assert np.array_equal(some[1], alone[1])
    lines = wall_lines(surface, [transformed(np.repeat(POSES, np.diff(FIRST), axis=0), FLAT)])
    some = line_pull(surface, lines, POSES, FLAT, FIRST, keep, **kernel)
    alone = line_pull(
        surface, lines, POSES, FLAT[keep], first, np.ones(keep.sum(), dtype=bool), **kernel
    )
    assert np.array_equal(some[0], alone[0])
    assert np.array_equal(some[1], alone[1])
