import numpy as np
import pytest
import worlds

from soundmap.deskew import deskewed_rays, interpolated_pose
from soundmap.geometry import Mount, Trajectory, relative, transformed
from soundmap.sensors import LaserScan


def turning(rate_rad_s=1.5, speed_m_s=0.4):
    time_ns = np.arange(0, 1_000_000_001, 1_000_000, dtype=np.int64)
    time_s = time_ns * 1e-9
    angle = rate_rad_s * time_s
    radius = speed_m_s / rate_rad_s
    pose = np.stack([1 + radius * np.sin(angle), 2 - radius * np.cos(angle), angle], axis=-1)
    return Trajectory(time_ns, pose, np.ones(len(time_ns), dtype=bool))


def test_rays_of_a_turning_robot_land_on_the_walls():
    truth = turning()
    for scan in worlds.laser_scans(truth, [worlds.FRONT, worlds.BACK])[::7]:
        rays = deskewed_rays(scan, truth, 500_000_000)
        points = transformed(truth.at(500_000_000), rays.end_m)
        exact = worlds.exact_ranges(
            transformed(truth.at(500_000_000), rays.origin_m),
            rays.bearing_rad + truth.at(500_000_000)[2],
        )
        assert np.max(np.abs(rays.range_m - exact)) < 1e-4, "every ray ends on a wall"
        assert len(points) == len(scan.range_m)


def test_without_deskewing_the_same_rays_would_be_bent():
    truth = turning()
    scan = worlds.laser_scans(truth, [worlds.FRONT])[3]
    frozen = LaserScan(
        scan.middle_ns, 0.0, scan.bearing_rad, scan.range_m, 30.0, scan.mount, scan.scanner
    )
    bent = deskewed_rays(frozen, truth, scan.middle_ns).end_m
    straight = deskewed_rays(scan, truth, scan.middle_ns).end_m
    assert np.max(np.hypot(*(bent - straight).T)) > 0.02


def test_returns_are_thinned_evenly_after_the_invalid_ones_are_dropped():
    truth = turning()
    ranges = np.full(100, np.nan)
    ranges[40:60] = 2.0
    bearing = np.linspace(-1, 1, 100)
    scan = LaserScan(0, 0.0, bearing, ranges, 30.0, Mount.planar(0, 0, 0, 0), 0)
    rays = deskewed_rays(scan, truth, 0, most=10)
    assert len(rays) == 10
    assert np.allclose(np.diff(rays.bearing_rad), 2 * (bearing[1] - bearing[0]))


def test_rays_outside_the_time_of_the_track_are_left_out():
    truth = turning()
    end = int(truth.time_ns[-1])
    bearing = np.linspace(-1, 1, 100)
    mount = Mount.planar(0, 0, 0, 0)
    scan = LaserScan(end - 500_000, 10_000, bearing, np.full(100, 2.0), 30.0, mount, 0)
    assert len(deskewed_rays(scan, truth, end)) == pytest.approx(51, abs=1)


def test_the_kernels_agree_with_the_plain_form():
    truth = turning(rate_rad_s=3.0)
    scan = worlds.laser_scans(truth, [worlds.BACK])[5]
    now = truth.at(scan.middle_ns)
    motion = relative(now, truth.at(scan.ray_time_ns))
    points = scan.mount.base_points(scan.bearing_rad, scan.range_m)
    rays = deskewed_rays(scan, truth, scan.middle_ns)
    assert rays.end_m == pytest.approx(transformed(motion, points), abs=1e-9)
    origin = scan.mount.translation_m[:2]
    assert rays.origin_m == pytest.approx(transformed(motion, origin), abs=1e-9)
    for time_ns in (-1, 0, 123_456_789, 1_000_000_000, 1_000_000_001):
        one = interpolated_pose(truth.time_ns, truth.pose, time_ns)
        assert one == pytest.approx(truth.at(time_ns), abs=1e-12, nan_ok=True)
