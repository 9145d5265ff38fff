"""Scans made by a sum over sources and images in a rectangular room, with exact laser ranges."""

from dataclasses import replace

import numpy as np

from soundmap.config import ScanConfig
from soundmap.detect.evidence import gathered_evidence
from soundmap.detect.sparse_fit import SparseFit
from soundmap.detect.walls import surface_points, wall_lines
from soundmap.geometry import Mount, Trajectory
from soundmap.sensors import MicArray
from soundmap.sound import AudioScans, LevelReference

WIDTH, DEPTH = 6.0, 5.0
ANGLE = 2.0 * np.pi * np.arange(16) / 16
POSITIONS = np.stack([0.155 * np.cos(ANGLE), 0.155 * np.sin(ANGLE), 0.0 * ANGLE], axis=-1)
MOUNT = Mount.planar(0.1, 0.0, 0.5, 0.3)
FAR = ((0.3, 0.8), (1.9, 0.5), (4.4, 0.7))
"""Bearings of a far field, and the power from there."""


def way(speed_m_s=0.3):
    """Half a lap through the room in 20 s, with a turn in the middle."""
    time_s = np.arange(0.0, 20.0, 0.05)
    along = speed_m_s * time_s
    x = np.where(along < 3.0, 1.5 + along, 4.5)
    y = np.where(along < 3.0, 1.5, 1.5 + np.minimum(along - 3.0, 2.0))
    heading = np.clip((along - 2.7) / 0.6, 0.0, 1.0) * 0.5 * np.pi
    time_ns = (1_700_000_000 * 10**9 + time_s * 1e9).astype(np.int64)
    pose = np.column_stack([x, y, heading])
    return Trajectory(time_ns, pose, np.ones(len(pose), dtype=bool))


HERTZ = np.arange(1062.5, 6000.0, 125.0)
WAVENUMBER = 2.0 * np.pi * HERTZ / 343.0
SUB_BAND = np.searchsorted(ScanConfig().sub_band_hz, HERTZ) - 1


def _waves(toward):
    """Phases at the microphones of waves along the floor, shape (bearings, frequencies, 16)."""
    toward = np.asarray(toward)[:, None]
    way = np.cos(toward) * POSITIONS[:, 0] + np.sin(toward) * POSITIONS[:, 1]
    return np.exp(1j * WAVENUMBER[:, None] * way[:, None])


STEER = np.ascontiguousarray(_waves(2.0 * np.pi * np.arange(120) / 120).conj().swapaxes(0, 1)) / 16


def response(toward, aperture=1.0):
    """Power of the beamformer's output on 120 bearings for waves from ``toward``, white sound.

    Of each sub-band, shape (4, 120).
    """
    way = np.cos(toward) * POSITIONS[:, 0] + np.sin(toward) * POSITIONS[:, 1]
    wave = np.exp(1j * WAVENUMBER[:, None] * aperture * way)
    power = np.abs(np.einsum("fbm,fm->fb", STEER, wave)) ** 2
    return np.stack([power[part == SUB_BAND].sum(axis=0) for part in range(4)]) / 40


def observed(
    emitters,
    *,
    ambient=1.0,
    above_m=0.0,
    far=(),
    far_aperture=1.0,
    seed=1,
    speed_m_s=0.3,
    reflected=0.0,
):
    """Audio scans, laser ranges, way and array.

    Emitters are x, y and power at 1 m, or functions that tell these at a time [s]; a directivity d
    may follow, exp(d . u) of the power going toward u. far are bearings of the map and the power
    from there. Walls reflect a share.
    """
    rng = np.random.default_rng(seed)
    track = way(speed_m_s)
    time_ns = track.time_ns[2:-2:2]
    power, ranges = [], []
    for time_s, pose in zip(1e-9 * (time_ns - time_ns[0]), track.at(time_ns), strict=True):
        turn = pose[2] + MOUNT.yaw_rad
        place = pose[:2] + 0.1 * np.array([np.cos(pose[2]), np.sin(pose[2])])
        heard = ambient * np.tile([[0.2], [0.2], [0.3], [0.3]], 120)
        for emitter in emitters:
            told = emitter(time_s) if callable(emitter) else emitter
            for x, y, strength in _heard_at(place, *told, reflected=reflected):
                step = np.array([x, y]) - place
                toward, square = np.arctan2(step[1], step[0]) - turn, step @ step
                direct = square + above_m**2
                heard += strength / direct * response(toward, np.sqrt(square / direct))
                down = 2.0 * MOUNT.translation_m[2] + above_m  # below a floor that absorbs half
                aperture = np.sqrt(square / (square + down**2))
                heard += 0.5 * strength / (square + down**2) * response(toward, aperture)
        for bearing, strength in far:
            heard += strength * response(bearing - turn, far_aperture)
        power.append(heard * (1.0 + 0.02 * rng.standard_normal((4, 120))))
        ray = 2.0 * np.pi * np.arange(360) / 360 + turn
        with np.errstate(divide="ignore"):
            to_x = np.where(np.cos(ray) > 0, WIDTH - place[0], -place[0]) / np.cos(ray)
            to_y = np.where(np.sin(ray) > 0, DEPTH - place[1], -place[1]) / np.sin(ray)
        ranges.append(np.minimum(to_x, to_y))
    bearing = 2.0 * np.pi * np.arange(120) / 120
    parts = np.array(power, np.float32)
    scans = AudioScans(
        time_ns,
        bearing,
        parts.sum(axis=1),
        LevelReference.FULL_SCALE,
        sub_bands=parts,
        sub_band_hz=ScanConfig().sub_band_hz,
    )
    return scans, np.array(ranges, np.float32), track, MicArray(POSITIONS, MOUNT, None)


def _heard_at(place, x, y, strength, lobe=(0.0, 0.0), *, reflected):
    """An emitter and, if walls reflect, its images: where, and how loud toward a place."""
    seems = [(x, y, 1, 1, 1.0)]
    if reflected:
        seems += [(image, y, -1, 1, reflected) for image in (-x, 2.0 * WIDTH - x)]
        seems += [(x, image, 1, -1, reflected) for image in (-y, 2.0 * DEPTH - y)]
    for at_x, at_y, flip_x, flip_y, share in seems:
        leaves = (place - (at_x, at_y)) * (flip_x, flip_y)
        yield at_x, at_y, share * strength * np.exp(leaves @ lobe / np.hypot(*leaves))


def still_evidence():
    """What a source before the wall x = WIDTH sounds like to an array that does not turn."""
    gathered = gathered_evidence(*observed([(6.0, 3.0, 50.0)]), ScanConfig())
    return replace(gathered, turn_rad=0.0 * gathered.turn_rad)


def relative_error(change, expected):
    return np.linalg.norm(change - expected) / np.linalg.norm(expected)


def begun_fit(emitters, **more):
    """A fit to what was observed of some emitters, still without components."""
    evidence = gathered_evidence(*observed(emitters, **more), ScanConfig())
    return SparseFit(evidence, wall_lines(surface_points(evidence)))
