import numpy as np
import pytest

from soundmap.geometry import composed, wrapped_angle
from soundmap.localize.motion import MotionNoise, moved

STILL = MotionNoise(0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("step", [(0.3, 0.1, 0.4), (-0.3, 0.02, -0.1), (0.0, 0.0, 1.0), (0, 0, 0)])
def test_without_noise_particles_move_exactly_as_the_odometry_says(step):
    pose = np.random.default_rng(0).normal(size=(50, 3))
    after = moved(pose, np.array(step), STILL, np.random.default_rng(0))
    expected = composed(pose, np.array(step))
    assert np.allclose(after[:, :2], expected[:, :2], atol=1e-12)
    assert np.allclose(wrapped_angle(after[:, 2] - expected[:, 2]), 0, atol=1e-12)


def test_noise_grows_with_each_of_the_four_coefficients():
    start = np.zeros((200_000, 3))
    step = np.array([1.0, 0.0, 0.5])  # drives a metre straight on, then turns half a radian
    rng = np.random.default_rng(1)
    along = moved(start, step, MotionNoise(0, 0, 0.1, 0), rng)
    assert along[:, 0].std() == pytest.approx(0.1, rel=0.02)
    assert along[:, 1].std() == 0
    assert along[:, 2].std() == pytest.approx(0, abs=1e-12)
    turned = moved(start, step, MotionNoise(0.2, 0, 0, 0), rng)
    assert turned[:, 2].std() == pytest.approx(0.1, rel=0.02)
    drift = moved(start, step, MotionNoise(0, 0.1, 0, 0), rng)
    assert drift[:, 2].std() == pytest.approx(0.1 * np.sqrt(2), rel=0.02)
    slip = moved(start, step, MotionNoise(0, 0, 0, 0.2), rng)
    assert slip[:, 0].std() == pytest.approx(0.1, rel=0.02)


def test_driving_backwards_is_no_half_turn():
    rng = np.random.default_rng(2)
    after = moved(np.zeros((10_000, 3)), np.array([-0.5, 0.0, 0.0]), MotionNoise(0.5, 0, 0, 0), rng)
    assert np.abs(wrapped_angle(after[:, 2])).max() < 1e-9
    assert after[:, 0] == pytest.approx(-0.5)


def test_the_same_seed_moves_the_particles_the_same_way():
    noise, step, pose = MotionNoise(0.1, 0.1, 0.1, 0.1), np.array([0.1, 0, 0.1]), np.zeros((9, 3))
    first = moved(pose, step, noise, np.random.default_rng(7))
    assert np.array_equal(first, moved(pose, step, noise, np.random.default_rng(7)))
    assert not np.array_equal(first, moved(pose, step, noise, np.random.default_rng(8)))
