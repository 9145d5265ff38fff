import numpy as np
import pytest
import worlds
from scipy.integrate import quad

from soundmap.deskew import deskewed_rays
from soundmap.geometry import transformed
from soundmap.localize.likelihood import (
    BeamModel,
    beam_log_likelihood,
    scan_log_likelihood,
)
from soundmap.raycast import cast_ranges

MODEL = BeamModel(0.05, 0.8, 0.1, 0.1, 1.0, 30.0)
TRUTH = worlds.driven([(1.0, 1.0), (4.0, 1.2)])


def rays_at(index, most=60):
    scan = worlds.laser_scans(TRUTH, [worlds.FRONT])[index]
    return deskewed_rays(scan, TRUTH, scan.middle_ns, most=most), TRUTH.at(scan.middle_ns)


def test_density_of_a_ray_integrates_to_the_sum_of_its_weights():
    def density(z):
        return float(np.exp(beam_log_likelihood(np.array(z), np.array(5.0), MODEL)))

    parts = [quad(density, a, b)[0] for a, b in [(0, 4.5), (4.5, 5), (5, 5.5), (5.5, 30)]]
    assert sum(parts) == pytest.approx(0.8 + 0.1 * (1 - np.exp(-5)) + 0.1, abs=1e-6)


def test_fast_kernel_agrees_with_the_plain_sum_over_rays():
    rays, pose = rays_at(20)
    room = worlds.room()
    rng = np.random.default_rng(3)
    poses = pose + rng.normal(size=(40, 3)) * [0.2, 0.2, 0.1]
    fast = scan_log_likelihood(room, poses, rays, MODEL)
    slow = []
    for candidate in poses:
        expected = cast_ranges(
            room,
            transformed(candidate, rays.origin_m),
            rays.bearing_rad + candidate[2],
            range_max_m=30.0,
        )
        slow.append(beam_log_likelihood(rays.range_m, expected, MODEL).sum())
    # The kernel stops its rays 6 sigma behind the measured range: e^-18 of the density is lost.
    assert fast == pytest.approx(np.array(slow), abs=1e-3)


def test_the_true_pose_is_likelier_than_any_other_nearby():
    rays, pose = rays_at(20, most=361)
    offsets = np.stack(np.meshgrid([-0.15, 0, 0.15], [-0.15, 0, 0.15], [-0.06, 0, 0.06]), -1)
    offsets = offsets.reshape(-1, 3)
    values = scan_log_likelihood(worlds.room(), pose + offsets, rays, MODEL)
    assert np.all(offsets[np.argmax(values)] == 0)
