"""A room of straight walls with exact geometry, independent of the package's grids and rays."""

from __future__ import annotations

import numpy as np

from soundmap.geometry import Mount, Trajectory, composed
from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.sensors import LaserScan

CELL = 0.05
HALF = 0.025

# An L-shaped room with a niche and a pillar; walls run through the middle of cells.
OUTLINE = np.array([[0, 0], [7, 0], [7, 3], [4.5, 3], [4.5, 5], [0, 5], [0, 3.2], [-0.8, 3.2],
                    [-0.8, 2.2], [0, 2.2]]) + HALF  # fmt: skip
PILLAR = np.array([[2.0, 2.0], [2.5, 2.0], [2.5, 2.6], [2.0, 2.6]]) + HALF


RINGS = (OUTLINE, PILLAR)


def segments(rings: tuple[np.ndarray, ...] = RINGS) -> np.ndarray:
    """Walls as segments, shape (S, 2, 2)."""
    return np.concatenate([np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in rings])


FRAME = GridFrame(CELL, (-1.5, -0.5), (120, 180))


def room(rings: tuple[np.ndarray, ...] = RINGS, frame: GridFrame = FRAME) -> OccupancyGrid:
    """A room as a grid: cells that a wall runs through are occupied, those inside are free."""
    occupied = np.zeros(frame.shape, dtype=bool)
    for start, end in segments(rings):
        steps = int(np.ceil(np.linalg.norm(end - start) / 0.01)) + 1
        cells = frame.cells(np.linspace(start, end, steps))
        occupied[cells[:, 0], cells[:, 1]] = True
    centres = frame.centres(np.moveaxis(np.indices(frame.shape), 0, -1))
    inside = _inside(centres, rings[0])
    for pillar in rings[1:]:
        inside &= ~_inside(centres, pillar)
    return OccupancyGrid(frame, occupied, inside & ~occupied)


def _inside(points: np.ndarray, ring: np.ndarray) -> np.ndarray:
    x, y = points[..., 0], points[..., 1]
    inside = np.zeros(x.shape, dtype=bool)
    for (ax, ay), (bx, by) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        if ay != by:
            crosses = (ay > y) != (by > y)
            inside ^= crosses & (x < ax + (y - ay) / (by - ay) * (bx - ax))
    return inside


def exact_ranges(
    origin: np.ndarray, bearing: np.ndarray, rings: tuple[np.ndarray, ...] = RINGS
) -> np.ndarray:
    """Distance from points (R, 2) along bearings (R,) to the nearest wall, by line intersection."""
    walls = segments(rings)
    direction = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)[:, None, :]
    along = (walls[:, 1] - walls[:, 0])[None]
    offset = walls[None, :, 0] - origin[:, None, :]
    cross = direction[..., 0] * along[..., 1] - direction[..., 1] * along[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (offset[..., 0] * along[..., 1] - offset[..., 1] * along[..., 0]) / cross
        share = (offset[..., 0] * direction[..., 1] - offset[..., 1] * direction[..., 0]) / cross
    hit = (distance > 0) & (share >= 0) & (share <= 1) & (np.abs(cross) > 1e-12)
    return np.min(np.where(hit, distance, np.inf), axis=1)


def driven(waypoints: list[tuple[float, float]], *, speed: float = 0.5) -> Trajectory:
    """A robot that drives straight from point to point and turns on the spot, at 50 Hz."""
    pose = [np.array([*waypoints[0], 0.0])]
    pose *= 25  # at rest at first
    for target in waypoints[1:]:
        here = pose[-1]
        leg = np.array(target) - here[:2]
        heading = np.arctan2(leg[1], leg[0])
        turn = (heading - here[2] + np.pi) % (2 * np.pi) - np.pi
        turns = max(int(abs(turn) / 0.016), 1)  # 0.8 rad/s
        pose += [here + np.array([0, 0, turn * k / turns]) for k in range(1, turns + 1)]
        steps = max(int(np.linalg.norm(leg) / speed * 50), 1)
        pose += [np.array([*(here[:2] + leg * k / steps), heading]) for k in range(1, steps + 1)]
    time_ns = 1_600_000_000_000_000_000 + np.arange(len(pose), dtype=np.int64) * 20_000_000
    return Trajectory(time_ns, np.array(pose), np.ones(len(pose), dtype=bool))


FRONT = Mount.planar(0.2, 0.0, 0.3, 0.0)
BACK = Mount.planar(-0.2, 0.05, 0.3, np.pi)


def laser_scans(
    truth: Trajectory,
    mounts: list[Mount],
    *,
    rate_hz: float = 20.0,
    beams: int = 361,
    rings: tuple[np.ndarray, ...] = RINGS,
) -> list[LaserScan]:
    """Noise-free sweeps of 270 degrees, every ray cast from where the robot is at its time."""
    bearing = np.linspace(-2.356, 2.356, beams)
    interval = 18_000_000 / beams
    scans = []
    for scanner, mount in enumerate(mounts):
        first = truth.time_ns[0] + 3_000_000 * scanner
        for time_ns in range(int(first), int(truth.time_ns[-1] - 2e7), int(1e9 / rate_hz)):
            at = time_ns + np.rint(np.arange(beams) * interval).astype(np.int64)
            sensor = np.array([*mount.translation_m[:2], mount.yaw_rad])
            pose = composed(truth.at(at), sensor)
            ranges = exact_ranges(pose[:, :2], pose[:, 2] + bearing, rings)
            scans.append(LaserScan(time_ns, interval, bearing, ranges, 30.0, mount, scanner))
    return sorted(scans, key=lambda scan: scan.time_ns)
