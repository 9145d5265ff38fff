import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soundmap.geometry import (
    Mount,
    Trajectory,
    composed,
    inverted,
    relative,
    transformed,
    wrapped_angle,
)

poses = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-10, 10)).map(np.array)


def matrix(pose):
    x, y, a = pose
    return np.array([[np.cos(a), -np.sin(a), x], [np.sin(a), np.cos(a), y], [0, 0, 1]])


@given(poses, poses)
def test_composition_is_the_product_of_homogeneous_matrices(first, second):
    assert np.allclose(matrix(composed(first, second)), matrix(first) @ matrix(second), atol=1e-9)


@given(poses, poses)
def test_relative_pose_leads_from_one_pose_to_the_other(origin, pose):
    back = composed(origin, relative(origin, pose))
    assert np.allclose(matrix(back), matrix(pose), atol=1e-9)
    assert np.allclose(matrix(composed(inverted(pose), pose)), np.eye(3), atol=1e-9)


@given(poses, st.tuples(st.floats(-9, 9), st.floats(-9, 9)))
def test_transformed_points_follow_the_matrix(pose, point):
    expected = (matrix(pose) @ [*point, 1.0])[:2]
    assert np.allclose(transformed(pose, np.array(point)), expected, atol=1e-9)


def test_wrapped_angle_stays_in_its_half_open_interval():
    angle = np.linspace(-20, 20, 4001)
    wrapped = wrapped_angle(angle)
    assert np.all((wrapped >= -np.pi) & (wrapped < np.pi))
    assert np.allclose(np.exp(1j * wrapped), np.exp(1j * angle))


def test_composition_works_on_leading_axes():
    first, second = np.random.default_rng(0).normal(size=(2, 4, 5, 3))
    many = composed(first, second)
    assert many.shape == (4, 5, 3)
    assert np.allclose(many[2, 3], composed(first[2, 3], second[2, 3]))


class TestMount:
    def test_chained_mounts_equal_one_matrix_product(self):
        rng = np.random.default_rng(3)
        quaternions = rng.normal(size=(2, 4))
        outer = Mount.from_quaternion([1.0, 2.0, 3.0], quaternions[0])
        inner = Mount.from_quaternion([0.1, -0.2, 0.3], quaternions[1])
        point = np.array([0.4, 0.5, -0.6])
        nested = outer.rotation @ (inner.rotation @ point + inner.translation_m)
        chained = outer @ inner
        assert np.allclose(
            chained.rotation @ point + chained.translation_m, nested + outer.translation_m
        )
        back = chained.inverse() @ chained
        assert np.allclose(back.rotation, np.eye(3))
        assert np.allclose(back.translation_m, 0)

    def test_upside_down_sensor_sees_bearings_run_clockwise(self):
        hanging = Mount.from_quaternion([0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0])  # roll of 180 deg
        assert hanging.handedness == -1
        assert hanging.tilt_rad == pytest.approx(0.0, abs=1e-6)
        assert np.allclose(hanging.base_bearing([0.3, 1.0]), [-0.3, -1.0])
        assert np.allclose(hanging.base_points([np.pi / 2], [2.0]), [[0.0, -2.0]])

    def test_tilted_sensor_is_projected_on_the_floor(self):
        pitch = np.radians(30.0)
        mount = Mount.from_quaternion([0, 0, 0], [0, np.sin(pitch / 2), 0, np.cos(pitch / 2)])
        assert mount.tilt_rad == pytest.approx(pitch)
        assert np.allclose(mount.base_points([0.0], [1.0]), [[np.cos(pitch), 0.0]])

    def test_zero_quaternion_is_refused(self):
        with pytest.raises(ValueError, match="zero length"):
            Mount.from_quaternion([0, 0, 0], [0, 0, 0, 0])


def trajectory(times, poses, usable=None):
    usable = np.ones(len(times), dtype=bool) if usable is None else np.array(usable)
    return Trajectory(np.array(times, dtype=np.int64), np.array(poses, dtype=float), usable)


class TestTrajectory:
    def test_heading_is_interpolated_the_short_way_round(self):
        track = trajectory([0, 100], [[0, 0, np.pi - 0.1], [1, 0, -np.pi + 0.1]])
        middle = track.at(50)
        assert abs(abs(middle[2]) - np.pi) < 1e-9
        assert middle[0] == pytest.approx(0.5)

    def test_poses_outside_the_span_are_not_invented(self):
        track = trajectory([0, 100], [[0, 0, 0], [1, 0, 0]])
        assert np.isnan(track.at([-1, 101])).all()
        assert np.isfinite(track.at([0, 100])).all()

    def test_time_is_usable_only_between_two_usable_poses(self):
        track = trajectory([0, 10, 20, 30], np.zeros((4, 3)), [True, True, False, True])
        assert track.usable_at([5, 10, 15, 25, 31]).tolist() == [True, False, False, False, False]

    def test_driven_distance_adds_up_the_steps(self):
        track = trajectory([0, 1, 2], [[0, 0, 0], [3, 4, 1], [3, 2, 1]])
        assert track.driven_m().tolist() == [0, 5, 7]

    def test_large_times_keep_their_nanoseconds(self):
        start = 1_700_000_000_000_000_001
        track = trajectory([start, start + 2], [[0, 0, 0], [2, 0, 0]])
        assert track.at(start + 1)[0] == pytest.approx(1.0)

    def test_an_empty_trajectory_knows_nothing(self):
        track = trajectory([], np.empty((0, 3)))
        assert np.isnan(track.at([1, 2])).all()
        assert not track.usable_at([1, 2]).any()

    def test_times_out_of_order_are_refused(self):
        with pytest.raises(ValueError, match="increasing"):
            trajectory([10, 10], np.zeros((2, 3)))


def test_the_extent_of_a_trajectory_is_that_of_its_trusted_poses():
    pose = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 1.0], [90.0, 0.0, 0.0]])
    usable = np.array([True, True, False])
    way = Trajectory(np.arange(3), pose, usable)
    assert way.extent_m() == pytest.approx(5.0)
