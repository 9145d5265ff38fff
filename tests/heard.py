"""Audio scans of a drive past sources, from the physics: for tests of what is made of scans.

Each scan is the steered response of the array to plane waves of many frequencies, summed one by
one; nothing here comes from the package but the nouns.
"""

import itertools

import numpy as np

from soundmap.geometry import Mount, Trajectory
from soundmap.sound import AudioScans, LevelReference

START_NS = 1_700_000_000_000_000_000
SPEED_OF_SOUND = 343.0
BEARINGS = 120


def circle(count=16, radius_m=0.155):
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle), 0 * angle], axis=-1)


def response(positions_m, looking_rad, coming_rad):
    """Delay-and-sum power of a wave of power 1 between 1 and 6 kHz, -6 dB/octave: (..., N)."""
    total, frequencies = 0.0, np.linspace(1000.0, 6000.0, 26)
    for hertz in frequencies:
        k = 2 * np.pi * hertz / SPEED_OF_SOUND

        def phases(angle, k=k):
            towards = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
            return np.exp(1j * k * (towards @ positions_m[:, :2].T))

        gain = phases(coming_rad) @ phases(looking_rad).conj().T / len(positions_m)
        total = total + np.abs(gain) ** 2 / hertz**2
    return total / np.sum(1 / frequencies**2)


def drive(way_points_m, speed_m_s=0.5, step_s=0.1):
    """Straight from point to point, turning on the spot at once."""
    points = np.array(way_points_m, dtype=float)
    poses = []
    for start, end in itertools.pairwise(points):
        way = np.hypot(*(end - start))
        heading = np.arctan2(*(end - start)[::-1])
        shares = np.arange(0.0, 1.0, speed_m_s * step_s / way)
        poses += [[*(start + share * (end - start)), heading] for share in shares]
    pose = np.array(poses)
    time_ns = START_NS + (np.arange(len(pose)) * step_s * 1e9).astype(np.int64)
    return Trajectory(time_ns, pose, np.ones(len(pose), dtype=bool))


def heard_scans(trajectory, sources, *, seed, noise=1e-9, wobble_db=1.0):
    """What the array hears of sources (x [m], y [m], mean square at 1 m) along a way.

    The level of each source wobbles slowly along the way, as directivity and floor make it, and
    each bearing of each scan scatters by a tenth.
    """
    rng = np.random.default_rng(seed)
    looking = 2 * np.pi * np.arange(BEARINGS) / BEARINGS
    power = np.full((len(trajectory), BEARINGS), noise)
    way = trajectory.driven_m()
    for x, y, loudness in sources:
        step = np.array([x, y]) - trajectory.pose[:, :2]
        bearing = np.arctan2(step[:, 1], step[:, 0]) - trajectory.pose[:, 2]
        knots = rng.normal(0.0, wobble_db, int(way[-1] / 0.25) + 2)
        wobble = 10 ** (np.interp(way, 0.25 * np.arange(len(knots)), knots) / 10)
        gain = loudness * wobble / (step[:, 0] ** 2 + step[:, 1] ** 2 + 0.3**2)
        power += gain[:, None] * response(circle(), looking, bearing)
    power *= rng.gamma(100.0, 0.01, power.shape)
    mount = Mount.planar(0.0, 0.0, 0.5, 0.0)
    reference = LevelReference.FULL_SCALE
    return AudioScans(trajectory.time_ns, looking, power.astype(np.float32), reference, mount)
