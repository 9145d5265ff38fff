import numpy as np
import pytest

from soundmap.geometry import relative
from soundmap.odometry_model import OdometryModel, fitted_odometry
from tests import worlds
from tests.mapping import drives


def steps(scale, turn_per_metre, turn_scale):
    truth = worlds.driven(drives.ROUND * 2)
    odometry = drives.reported(
        truth, scale=scale, turn_per_metre=turn_per_metre, turn_scale=turn_scale
    )
    return (
        relative(odometry.pose[:-20:20], odometry.pose[20::20]),
        relative(truth.pose[:-20:20], truth.pose[20::20]),
    )


@pytest.mark.parametrize(
    ("scale", "turn_per_metre", "turn_scale"),
    [(1.05, 0.05, 1.0), (0.95, -0.05, 1.02), (1.0, 0.0, 0.97)],
)
def test_systematic_errors_are_found(scale, turn_per_metre, turn_scale):
    reported, driven = steps(scale, turn_per_metre, turn_scale)
    found = fitted_odometry(reported, driven, OdometryModel())
    assert found.distance_scale == pytest.approx(1 / scale, abs=0.003)
    assert found.turn_scale == pytest.approx(1 / turn_scale, abs=0.01)
    assert found.turn_per_metre == pytest.approx(-turn_per_metre / scale, abs=0.003)
    rest = found.corrected(reported) - driven
    assert np.median(np.abs(rest[:, 2])) < 0.002
    assert np.median(np.hypot(rest[:, 0], rest[:, 1])) < 0.003


def test_noise_is_smaller_for_better_odometry():
    reported, driven = steps(1.0, 0.0, 1.0)
    rng = np.random.default_rng(6)
    noise = rng.normal(0, 1, reported.shape) * [0.01, 0.01, 0.02]
    good = fitted_odometry(reported + 0.2 * noise, driven, OdometryModel())
    bad = fitted_odometry(reported + noise, driven, OdometryModel())
    assert bad.noise_distance_per_metre > 2 * good.noise_distance_per_metre
    assert bad.noise_turn_per_metre > 2 * good.noise_turn_per_metre


def test_a_robot_that_hardly_moved_says_nothing_about_its_odometry():
    start = OdometryModel(noise_turn_per_metre=0.07)
    few = np.zeros((50, 3))
    assert fitted_odometry(few, few, start) == start


def test_uncertainty_grows_with_the_way_and_the_turn():
    model = OdometryModel()
    along, turn = model.sigma(np.array([0.0, 1.0, 2.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0]))
    assert np.all(np.diff(along[:3]) > 0)
    assert np.all(np.diff(turn[:3]) > 0)
    assert turn[3] == pytest.approx(np.hypot(0.1, np.radians(0.15)))
    information = model.information(np.array([1.0]), np.array([0.0]))[0]
    np.testing.assert_allclose(
        np.diag(information), [along[1] ** -2, along[1] ** -2, turn[1] ** -2]
    )
