import numpy as np
import pytest

from soundmap.fuse.bearing_range import ranges_around, ranges_on_bearings, surface_ranges
from soundmap.geometry import Mount, Trajectory, relative, transformed
from soundmap.surroundings import NO_SURROUNDINGS, SurroundingsPacker

MOUNTS = {
    "turned": Mount.planar(0.1, -0.05, 0.6, 0.7),
    "upside down": Mount.from_quaternion([0.2, 0.1, 0.6], [np.cos(0.4), np.sin(0.4), 0.0, 0.0]),
}


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


def driving(rng):
    """A track at 50 Hz and points around it every 100 ms."""
    time_ns = 10**18 + np.arange(200, dtype=np.int64) * 20_000_000
    step = rng.normal(0.0, [0.01, 0.002, 0.02], (200, 3))
    track = Trajectory(time_ns, np.cumsum(step, axis=0), np.ones(200, dtype=bool))
    points = rng.normal(0.0, 3.0, (40, 90, 2)).astype(np.float16)
    points[rng.random((40, 90)) < 0.2] = np.nan
    packer = SurroundingsPacker(90)
    for time, own in zip(time_ns[::5].tolist(), points, strict=True):
        packer.add(time, own)
    return track, packer.surroundings()


@pytest.mark.parametrize("mount", MOUNTS.values(), ids=MOUNTS)
@pytest.mark.parametrize("bearings", [8, 120])
def test_the_compiled_ranges_are_the_plain_ones(mount, bearings):
    rng = np.random.default_rng(2)
    track, surroundings = driving(rng)
    time_ns = rng.integers(track.time_ns[0], track.time_ns[-1], 50)
    spacing = 2 * np.pi / bearings
    bearing = spacing * (np.arange(bearings) + rng.uniform(-0.5, 0.5, (50, bearings)))
    bearing[rng.random(bearing.shape) < 0.3] = np.nan
    found = surface_ranges(
        surroundings, track, time_ns, mount, bearing, tolerance_rad=0.4 * spacing
    )
    measured = 0
    for time, wanted, ranges in zip(time_ns, bearing, found, strict=True):
        nearest = int(np.argmin(np.abs(surroundings.time_ns - time)))
        points = surroundings.points(np.array([nearest]))[0].astype(float)
        points = points[np.isfinite(points[:, 0])]
        motion = relative(track.at(time), track.at(surroundings.time_ns[nearest]))
        seen = transformed(motion, points) - mount.translation_m[:2]
        own = np.linalg.solve(mount.rotation[:2, :2], seen.T).T
        is_wanted = np.isfinite(wanted)
        expected = ranges_on_bearings(own, wanted[is_wanted], tolerance_rad=0.4 * spacing)
        assert np.allclose(ranges[is_wanted], expected, rtol=1e-6, atol=0, equal_nan=True)
        assert np.isnan(ranges[~is_wanted]).all()
        measured += np.isfinite(expected).sum()
    assert measured > 50


def test_ranges_are_unknown_where_no_surroundings_or_motion_are():
    track, surroundings = driving(np.random.default_rng(3))
    time_ns = track.time_ns[-1] + np.array([-(10**8), 1, 10**9])
    ranges = ranges_around(surroundings, track, time_ns, MOUNTS["turned"])
    assert np.isfinite(ranges).any(axis=1).tolist() == [True, False, False]
    assert np.isnan(ranges_around(NO_SURROUNDINGS, track, time_ns, MOUNTS["turned"])).all()


def test_ranges_at_some_times_are_those_among_all():
    track, surroundings = driving(np.random.default_rng(4))
    time_ns = np.linspace(track.time_ns[0], track.time_ns[-1], 40).astype(np.int64)
    every = ranges_around(surroundings, track, time_ns, MOUNTS["turned"])
    wanted = np.array([0, 3, 20, 39])
    some = ranges_around(surroundings, track, time_ns, MOUNTS["turned"], wanted)
    assert some.shape == every.shape
    assert np.array_equal(some[wanted], every[wanted], equal_nan=True)
