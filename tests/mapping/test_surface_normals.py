import numpy as np
import pytest

from soundmap.geometry import transformed
from soundmap.mapping.surface_normals import surface_normals
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
    normal = surface_normals(origin, end)
    np.testing.assert_allclose(normal, np.tile(-outward, (len(end), 1)), atol=1e-9)


def test_normals_agree_with_the_eigenvectors_of_the_scatter_of_the_neighbours():
    rng = np.random.default_rng(1)
    bearing = np.radians(np.arange(-30, 30, 0.5))
    origin, end = rays_of(np.zeros(2), bearing, np.array([0.9, 0.436]), 2.0)
    end = end + rng.normal(0, 0.003, end.shape)
    normal = surface_normals(origin, end)
    found = np.flatnonzero(np.any(normal != 0, axis=1))
    assert len(found) > 100
    turn = np.median(np.abs(np.diff(np.arctan2(end[:, 1], end[:, 0]))))
    for i in found:
        near = end[max(i - 5, 0) : i + 6]
        reach = max(0.12, 3 * turn * np.hypot(*end[i]))
        near = near[np.hypot(*(near - end[i]).T) <= reach]
        _, vectors = np.linalg.eigh(np.cov(near.T))
        across = vectors[:, 0] * (1 if vectors[:, 0] @ end[i] < 0 else -1)
        np.testing.assert_allclose(normal[i], across, atol=1e-9)


def test_corners_and_lone_returns_have_no_normal():
    corner = np.array([[2.0, -0.04], [2.0, -0.02], [2.0, 0.0], [1.98, 0.0], [1.96, 0.0]])
    lone = np.array([[5.0, 3.0]])
    end = np.concatenate([corner, lone])
    normal = surface_normals(np.zeros_like(end), end)
    assert not normal[2].any()
    assert not normal[-1].any()


def test_turning_the_world_turns_the_normals():
    truth = worlds.driven([(1, 1), (1.2, 1)])
    scan = worlds.laser_scans(truth, [worlds.FRONT])[0]
    end = scan.mount.base_points(scan.bearing_rad, scan.range_m)
    origin = np.broadcast_to(scan.mount.translation_m[:2], end.shape)
    turn = np.array([0.0, 0.0, 1.1])
    turned = surface_normals(transformed(turn, origin), transformed(turn, end))
    np.testing.assert_allclose(turned, transformed(turn, surface_normals(origin, end)), atol=1e-9)


def test_nothing_seen_has_no_normals():
    assert surface_normals(np.empty((0, 2)), np.empty((0, 2))).shape == (0, 2)
