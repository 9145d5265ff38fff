import numpy as np
import pytest

from soundmap.simulate.lasers import (
    leg_circles,
    measured_ranges,
    ray_origins,
    ray_ranges,
    scan_bearings,
)
from soundmap.simulate.path import Motion

CORNERS = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0]])
WALLS = CORNERS, np.roll(CORNERS, -1, axis=0)
NO_CIRCLES = np.zeros((1, 0, 3))


def box_range(x: float, y: float, angle: np.ndarray) -> np.ndarray:
    """Distance from inside the 6 m x 4 m box to its wall: closed form."""
    with np.errstate(divide="ignore"):
        across = np.where(np.cos(angle) > 0, (6.0 - x) / np.cos(angle), -x / np.cos(angle))
        up = np.where(np.sin(angle) > 0, (4.0 - y) / np.sin(angle), -y / np.sin(angle))
    return np.minimum(across, up)


def test_ranges_in_a_box_are_those_of_the_closed_form() -> None:
    angle = np.linspace(-3.1, 3.1, 500)
    origin = np.tile([2.2, 1.3], (500, 1))
    ranges = ray_ranges(origin, angle, *WALLS, np.zeros((500, 0, 3)))
    assert ranges == pytest.approx(box_range(2.2, 1.3, angle), abs=1e-9)


def test_a_round_leg_is_hit_on_its_near_side() -> None:
    circles = np.array([[[4.0, 1.0, 0.1]]])
    assert ray_ranges([[1.0, 1.0]], [0.0], *WALLS, circles) == pytest.approx([2.9])
    assert ray_ranges([[1.0, 1.0]], [np.pi], *WALLS, circles) == pytest.approx([1.0])


def test_a_utm_30lx_has_1081_rays_over_270_degrees() -> None:
    bearing = scan_bearings(np.radians(270.0), np.radians(0.25))
    assert len(bearing) == 1081
    assert np.degrees(bearing[[0, 540, -1]]) == pytest.approx([-135.0, 0.0, 135.0])


def test_a_turning_robot_sees_its_room_bent_by_the_turn_within_a_sweep() -> None:
    turn_rate, ray_interval = 1.0, 0.025 / 1440
    motion = Motion(0.1, np.array([[3.0, 2.0, 0.0], [3.0, 2.0, 0.1 * turn_rate]]))
    bearing = scan_bearings(np.radians(270.0), np.radians(0.25))
    time = ray_interval * np.arange(1081)
    origin, direction = ray_origins(motion.at(time), (0.0, 0.0, 0.3, 0.0), bearing)
    ranges = ray_ranges(origin, direction, *WALLS, np.zeros((1081, 0, 3)))
    bent = box_range(3.0, 2.0, bearing + turn_rate * time)
    straight = box_range(3.0, 2.0, bearing)
    assert ranges == pytest.approx(bent, abs=1e-9)
    assert np.abs(ranges - straight).max() > 0.05


def test_a_mounted_scanner_measures_from_its_own_place() -> None:
    origin, direction = ray_origins(
        np.array([[1.0, 1.0, np.pi / 2]]), (0.2, 0.1, 0.3, np.pi), np.zeros(1)
    )
    assert origin[0] == pytest.approx([0.9, 1.2])
    assert np.exp(1j * direction[0]) == pytest.approx(np.exp(-0.5j * np.pi))


def test_noise_grows_with_range_and_drop_outs_are_as_frequent_as_asked() -> None:
    rng = np.random.default_rng(5)
    options = {"noise_m": 0.01, "noise_per_m": 0.002, "range_min_m": 0.1, "range_max_m": 30.0}
    for distance, sigma in ((1.0, 0.012), (20.0, 0.05)):
        measured = measured_ranges(np.full(20_000, distance), rng, dropout_share=0.05, **options)
        came_back = np.isfinite(measured)
        assert 1.0 - came_back.mean() == pytest.approx(0.05, abs=0.006)
        assert measured[came_back].mean() == pytest.approx(distance, abs=5 * sigma / 140)
        assert measured[came_back].std() == pytest.approx(sigma, rel=0.03)


def test_what_is_too_far_too_near_or_nowhere_does_not_come_back() -> None:
    measured = measured_ranges(
        np.array([0.01, 40.0, np.inf, 5.0]),
        np.random.default_rng(1),
        noise_m=0.0,
        noise_per_m=0.0,
        dropout_share=0.0,
        range_min_m=0.1,
        range_max_m=30.0,
    )
    assert measured.tolist() == [np.inf, np.inf, np.inf, 5.0]


def test_the_two_legs_of_a_walker_are_abreast_when_the_feet_pass() -> None:
    legs = leg_circles(np.array([[2.0, 1.0, np.pi / 2]]), np.array([0.0]), 0.06)
    assert legs[0] == pytest.approx(np.array([[2.1, 1.0, 0.06], [1.9, 1.0, 0.06]]))
