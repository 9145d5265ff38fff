import numpy as np
import pytest

from soundmap.simulate.path import Motion, driven, walked

WAY = [(1.0, 1.0), (5.0, 1.0), (5.0, 4.0), (1.0, 4.0)]


def loop(**changes: float) -> Motion:
    limits = {
        "speed_m_s": 0.6,
        "acceleration_m_s2": 0.5,
        "turn_radius_m": 0.5,
        "turn_rate_rad_s": 0.8,
        "rest_s": 1.0,
    }
    return driven(WAY, **(limits | changes))


def derivative(values: np.ndarray, step: float) -> np.ndarray:
    return np.diff(values, axis=0) / step


def test_the_robot_rests_at_the_start_and_at_the_end() -> None:
    motion = loop()
    assert np.ptp(motion.pose[:1000], axis=0).max() == 0.0
    assert np.ptp(motion.pose[-1000:], axis=0).max() == 0.0
    assert motion.pose[0] == pytest.approx([1.0, 1.0, 0.0])
    assert motion.pose[-1] == pytest.approx([1.0, 4.0, np.pi], abs=0.01)


def test_speed_acceleration_and_turn_rate_keep_to_their_limits() -> None:
    motion = loop()
    velocity = derivative(motion.pose, motion.step_s)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    assert speed.max() == pytest.approx(0.6, rel=1e-3)
    assert np.abs(derivative(speed, motion.step_s)).max() < 0.505
    assert np.abs(velocity[:, 2]).max() < 0.81


def test_a_differential_drive_moves_where_it_faces() -> None:
    motion = loop()
    step = np.diff(motion.pose, axis=0)
    heading = 0.5 * (motion.pose[1:, 2] + motion.pose[:-1, 2])
    sideways = -np.sin(heading) * step[:, 0] + np.cos(heading) * step[:, 1]
    assert np.abs(sideways).max() < 1e-6


def test_turns_are_rounded_inside_their_corner() -> None:
    motion = loop()
    gap = np.hypot(*(motion.pose[:, :2] - np.array(WAY[1])).T).min()
    assert gap == pytest.approx(0.5 * (np.sqrt(2.0) - 1.0), abs=0.02)


def test_a_way_that_doubles_back_is_turned_on_the_spot() -> None:
    motion = driven(
        [(0.0, 0.0), (2.0, 0.0), (0.0, 0.0)],
        speed_m_s=0.5,
        acceleration_m_s2=0.5,
        turn_radius_m=0.5,
        turn_rate_rad_s=1.0,
        rest_s=0.5,
        heading_rad=np.pi / 2,
    )
    assert motion.pose[0, 2] == np.pi / 2
    assert np.abs(motion.pose[:, 1]).max() < 1e-6
    assert motion.pose[:, 0].max() == pytest.approx(2.0, abs=2e-3)
    assert motion.pose[-1, 0] == pytest.approx(0.0, abs=2e-3)
    assert np.cos(motion.pose[-1, 2]) == pytest.approx(-1.0)


def test_poses_between_samples_lie_on_the_line_between_them() -> None:
    motion = Motion(0.001, np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 0.1]]))
    assert motion.at(0.00025) == pytest.approx([0.25, 0.5, 0.025])
    assert motion.at([-5.0, 5.0])[:, 0].tolist() == [0.0, 1.0]


def test_someone_walking_to_and_fro_turns_round_at_the_end() -> None:
    pose = walked([(0.0, 0.0), (3.0, 0.0)], speed_m_s=1.0, time_s=np.array([1.0, 4.0, 7.0]))
    assert pose[:, 0] == pytest.approx([1.0, 2.0, 1.0])
    assert np.cos(pose[:, 2]) == pytest.approx([1.0, -1.0, 1.0])
