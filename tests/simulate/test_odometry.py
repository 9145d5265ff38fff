import numpy as np
import pytest

from soundmap.simulate.odometry import wheel_odometry
from soundmap.simulate.path import driven


def drive() -> np.ndarray:
    motion = driven(
        [(1.0, 1.0), (5.0, 1.0), (5.0, 4.0)],
        speed_m_s=0.6,
        acceleration_m_s2=0.5,
        turn_radius_m=0.5,
        turn_rate_rad_s=0.8,
        rest_s=0.5,
    )
    return motion.at(np.arange(0.0, motion.duration_s, 0.02))


def test_faultless_wheels_follow_the_true_way() -> None:
    pose = drive()
    odometry, twist = wheel_odometry(pose, 0.02, np.random.default_rng(1), wheelbase_m=0.33)
    assert odometry[-1] == pytest.approx(pose[-1] - [1.0, 1.0, 0.0], abs=1e-4)
    assert twist[:, 0].max() == pytest.approx(0.6, rel=1e-3)


def test_wrong_wheels_make_the_error_of_the_closed_form() -> None:
    straight = np.zeros((501, 3))
    straight[:, 0] = np.linspace(0.0, 5.0, 501)
    odometry, _ = wheel_odometry(
        straight,
        0.02,
        np.random.default_rng(1),
        wheelbase_m=0.4,
        left_scale=0.99,
        right_scale=1.01,
        wheelbase_scale=0.5,
    )
    heading = 5.0 * 0.02 / (0.4 * 0.5)
    assert odometry[-1, 2] == pytest.approx(heading)
    assert odometry[-1, :2] == pytest.approx(
        5.0 / heading * np.array([np.sin(heading), 1.0 - np.cos(heading)]), abs=1e-4
    )


def test_random_error_grows_with_the_root_of_the_way() -> None:
    straight = np.zeros((201, 3))
    straight[:, 0] = np.linspace(0.0, 4.0, 201)
    ends = [
        wheel_odometry(
            straight, 0.02, np.random.default_rng(k), wheelbase_m=0.4, noise_m_per_sqrt_m=0.01
        )[0][-1, 2]
        for k in range(400)
    ]
    assert np.std(ends) == pytest.approx(0.01 * 2.0 * np.sqrt(2.0) / 0.4, rel=0.12)
