import numpy as np

from soundmap.fuse.bearing_range import ranges_on_bearings


def test_nearest_point_in_angle_is_found_as_by_exhaustive_search():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(300, 2)) * 3
    bearing = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    angle = np.arctan2(points[:, 1], points[:, 0])
    off = np.abs(np.angle(np.exp(1j * (angle[None] - bearing[:, None]))))
    nearest = off.argmin(axis=1)
    expected = np.where(off.min(axis=1) <= 0.02, np.hypot(*points[nearest].T), np.nan)
    assert 10 < np.isfinite(expected).sum() < 120
    found = ranges_on_bearings(points, bearing, tolerance_rad=0.02)
    assert np.array_equal(found, expected, equal_nan=True)


def test_the_circle_closes_at_180_degrees():
    points = [[-2.0, 0.001], [-3.0, -0.1]]
    assert ranges_on_bearings(points, [-np.pi + 1e-4], tolerance_rad=0.1)[0] < 2.1


def test_the_order_of_the_points_does_not_matter():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(50, 2))
    bearing = np.linspace(0, 2 * np.pi, 36, endpoint=False)
    first = ranges_on_bearings(points, bearing, tolerance_rad=0.2)
    second = ranges_on_bearings(points[::-1], bearing, tolerance_rad=0.2)
    assert np.array_equal(first, second, equal_nan=True)


def test_without_points_nothing_is_measured():
    assert np.isnan(ranges_on_bearings(np.empty((0, 2)), [0.0, 1.0], tolerance_rad=0.1)).all()
