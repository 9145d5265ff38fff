import numpy as np
import pytest

from soundmap.geometry import transformed
from soundmap.mapping.surface_lines import LEAST_RETURNS, range_noise, surface_lines
from tests import worlds


def rays_of(origin, bearing, wall_normal, wall_distance):
    """Rays that end on the line n . p = d."""
    direction = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    along = (wall_distance - origin @ wall_normal) / (direction @ wall_normal)
    return np.broadcast_to(origin, direction.shape), origin + along[:, None] * direction


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0, -2.5])
@pytest.mark.parametrize("step_deg", [0.25, 1.0])
def test_a_straight_wall_has_its_own_normal_towards_the_scanner(angle, step_deg):
    outward = np.array([np.cos(angle), np.sin(angle)])
    bearing = angle + np.radians(np.arange(-40, 40, step_deg))
    origin, end = rays_of(np.array([0.3, -0.2]), bearing, outward, 4.0)
    normal, _ = surface_lines(origin, end)
    np.testing.assert_allclose(normal, np.tile(-outward, (len(end), 1)), atol=1e-9)


def test_lines_agree_with_the_eigenvectors_of_the_scatter_of_the_neighbours():
    rng = np.random.default_rng(1)
    bearing = np.radians(np.arange(-30, 30, 1.0))
    origin, end = rays_of(np.zeros(2), bearing, np.array([0.9, 0.436]), 3.0)
    end = end + rng.normal(0, 1e-4, end.shape)  # so little that five neighbours will do
    normal, point = surface_lines(origin, end)
    found = np.flatnonzero(np.any(normal != 0, axis=1))
    assert len(found) > 50
    turn = np.median(np.abs(np.diff(np.arctan2(end[:, 1], end[:, 0]))))
    for i in found:
        near = end[max(i - 5, 0) : i + 6]
        reach = max(0.12, 3 * turn * np.hypot(*end[i]))
        near = near[np.hypot(*(near - end[i]).T) <= reach]
        if len(near) < LEAST_RETURNS:  # at the ends: more are taken
            continue
        _, vectors = np.linalg.eigh(np.cov(near.T))
        across = vectors[:, 0] * (1 if vectors[:, 0] @ end[i] < 0 else -1)
        np.testing.assert_allclose(normal[i], across, atol=1e-9)
        foot = end[i] - across * (across @ (end[i] - near.mean(axis=0)))
        np.testing.assert_allclose(point[i], foot, atol=1e-9)


@pytest.mark.parametrize("noise_m", [0.01, 0.03, 0.05])
def test_where_noise_exceeds_the_spacing_more_returns_tell_the_line(noise_m):
    """Returns lie 5 mm apart; five on either side scatter as far across the wall as along it."""
    rng = np.random.default_rng(4)
    bearing = np.radians(np.arange(-70, 70, 0.3))
    origin, end = rays_of(np.zeros(2), bearing, np.array([1.0, 0.0]), 1.0)
    ray = end / np.hypot(*end.T)[:, None]
    end = end + rng.normal(0, noise_m, len(end))[:, None] * ray
    normal, point = surface_lines(origin, end)
    assert range_noise(end, end) == pytest.approx(noise_m, rel=0.15)
    known = np.any(normal != 0, axis=1)
    assert known.mean() > 0.9
    tilt = np.degrees(np.arctan2(normal[known, 1], -normal[known, 0]))
    assert np.sqrt(np.mean(tilt**2)) < 4.0
    off = np.abs(point[known, 0] - 1.0)
    raw = np.abs(end[known, 0] - 1.0)
    assert np.median(off) < 0.5 * np.median(raw)


def test_noise_makes_no_wall_along_the_ray():
    """A few returns side by side spread farther along their rays than across."""
    rng = np.random.default_rng(2)
    bearing = np.radians(np.linspace(-0.6, 0.6, 11))
    end = (1.0 + rng.normal(0, 0.05, 11))[:, None] * np.stack(
        [np.cos(bearing), np.sin(bearing)], axis=-1
    )
    normal, point = surface_lines(np.zeros_like(end), end)
    assert not normal.any()
    np.testing.assert_array_equal(point, end)


def test_the_noise_of_an_exact_scan_of_slanting_walls_is_nothing():
    bearing = np.radians(np.arange(-40, 40, 1.0))
    _, end = rays_of(np.zeros(2), bearing, np.array([0.6, 0.8]), 2.0)
    assert range_noise(end, end) == pytest.approx(0.0, abs=1e-9)


def test_corners_and_lone_returns_have_no_normal():
    corner = np.array([[2.0, -0.04], [2.0, -0.02], [2.0, 0.0], [1.98, 0.0], [1.96, 0.0]])
    lone = np.array([[5.0, 3.0]])
    end = np.concatenate([corner, lone])
    normal, _ = surface_lines(np.zeros_like(end), end)
    assert not normal[2].any()
    assert not normal[-1].any()


def test_turning_the_world_turns_the_lines():
    truth = worlds.driven([(1, 1), (1.2, 1)])
    scan = worlds.laser_scans(truth, [worlds.FRONT])[0]
    end = scan.mount.base_points(scan.bearing_rad, scan.range_m)
    origin = np.broadcast_to(scan.mount.translation_m[:2], end.shape)
    turn = np.array([0.0, 0.0, 1.1])
    turned, moved = surface_lines(transformed(turn, origin), transformed(turn, end))
    normal, point = surface_lines(origin, end)
    np.testing.assert_allclose(turned, transformed(turn, normal), atol=1e-9)
    np.testing.assert_allclose(moved, transformed(turn, point), atol=1e-9)


def test_nothing_seen_has_no_lines():
    normal, point = surface_lines(np.empty((0, 2)), np.empty((0, 2)))
    assert normal.shape == point.shape == (0, 2)
