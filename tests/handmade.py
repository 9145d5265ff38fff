"""Runs put together by hand, with known content, for tests of what is done with runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from soundmap.change import Change, ChangeKind, PowerRatio
from soundmap.config import Config
from soundmap.geometry import Trajectory
from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.losses import Loss
from soundmap.outputs.illustrator import Illustrator
from soundmap.outputs.picture_format import PictureFormat
from soundmap.run import Run
from soundmap.sensors import ArrayOffsets, Offset, OffsetVerdict
from soundmap.sound import (
    AudioScans,
    LevelReference,
    PowerMap,
    Reflection,
    Source,
    SourceFit,
    SourceList,
)

START_NS = 1_700_007_000_123_456_789
NO_PICTURES = Illustrator(PictureFormat.NONE)
FULL_SCALE = LevelReference.FULL_SCALE


def walled_room(width_m: float = 6.0, height_m: float = 4.5, step: float = 0.05) -> OccupancyGrid:
    """A rectangle of walls around open floor, with 0.5 m of unknown around it."""
    rows, columns = round((height_m + 1.0) / step), round((width_m + 1.0) / step)
    rim = round(0.5 / step)
    frame = GridFrame(step, (-0.5, -0.5), (rows, columns))
    occupied = np.zeros(frame.shape, dtype=bool)
    occupied[rim - 1 : rows - rim + 1, rim - 1 : columns - rim + 1] = True
    occupied[rim : rows - rim, rim : columns - rim] = False
    free = np.zeros(frame.shape, dtype=bool)
    free[rim : rows - rim, rim : columns - rim] = True
    return OccupancyGrid(frame, occupied, free)


def round_trip(width_m: float = 6.0, height_m: float = 4.5, poses: int = 400) -> Trajectory:
    """An oval way round the middle of the room, lost for a tenth of it."""
    turn = np.linspace(0.0, 1.8 * np.pi, poses)
    x = width_m / 2 + 0.3 * width_m * np.cos(turn)
    y = height_m / 2 + 0.3 * height_m * np.sin(turn)
    heading = np.arctan2(0.3 * height_m * np.cos(turn), -0.3 * width_m * np.sin(turn))
    usable = np.ones(poses, dtype=bool)
    usable[poses // 2 : poses // 2 + poses // 10] = False
    time_ns = START_NS + np.arange(poses, dtype=np.int64) * 50_000_000
    return Trajectory(time_ns, np.stack([x, y, heading], axis=-1), usable)


def heard_map(
    frame: GridFrame, places: list[tuple[float, float, float]], seed: int = 5
) -> PowerMap:
    """A power map with a hill (x [m], y [m], power) at each place over a random floor."""
    rng = np.random.default_rng(seed)
    centres = frame.centres(np.stack(np.indices(frame.shape), axis=-1))
    power = np.full(frame.shape, 1e-9)
    visits = rng.poisson(2.0, frame.shape).astype(np.int64)
    for x, y, loudness in places:
        distance = np.hypot(centres[..., 0] - x, centres[..., 1] - y)
        power += loudness * np.exp(-((distance / 0.25) ** 2))
        visits += np.where(distance < 0.4, 20, 0)
    power *= rng.lognormal(0.0, 0.2, frame.shape)
    return PowerMap(frame, power * visits, visits, FULL_SCALE)


def made_run(log: Path = Path("logs/run1.mcap"), *, config: Config | None = None) -> Run:
    """A run of 20 s with two sources and two losses."""
    room = walled_room()
    rng = np.random.default_rng(7)
    bearing = np.arange(120) * 2 * np.pi / 120
    time_ns = START_NS + np.delete(np.arange(200), slice(90, 110)) * 100_000_000
    swing = np.cos(bearing - 3.0 * np.arange(len(time_ns))[:, None] / len(time_ns))
    power = (1e-7 * (1.2 + swing) * rng.lognormal(0.0, 0.1, swing.shape)).astype(np.float32)
    places = [(3.1, 0.25, 4e-7), (5.75, 3.4, 1e-7)]
    sources = (Source(3.125, 0.275, 4e-7, 22), Source(5.7251234, 3.375, 1e-7, 17))
    return Run(
        log=log,
        fingerprint="0123abcd",
        config=config or Config(),
        room=room,
        trajectory=round_trip(),
        scans=AudioScans(time_ns, bearing, power, FULL_SCALE),
        power_map=heard_map(room.frame, places),
        sources=SourceList(sources, FULL_SCALE),
        losses=(
            Loss("odometry pose is not finite", "/odom", 1294, "motion taken from the twist", True),
            Loss("stamp repeated", "/scan_front", 1, "the later one kept", False),
        ),
        counts={"audio_scans": len(time_ns), "laser_scans": 2000},
        timings_s={"localize": 1.25, "scan": 0.5, "fuse": 0.25},
        duration_s=20.0,
    )


def fitted_run(log: Path = Path("logs/run1.mcap")) -> Run:
    """A run whose sources come from a fit: one is sure, the other is not; with mirror images."""
    run = made_run(log)
    sure, doubtful = run.sources.sources
    near = SourceFit(sure.power, np.diag([0.02**2, 0.02**2]), 1e-12, 2.0, (), 0.3)
    flags = ("not_seen_by_laser", "unsteady")
    far = SourceFit(doubtful.power, np.diag([0.12**2, 0.05**2]), 0.004, 0.5, flags)
    images = (Reflection(3.1, -0.4, 1e-8, 0), Reflection(9.0, 9.0, 5e-9, None))
    sources = (replace(sure, fit=near), replace(doubtful, fit=far))
    return replace(run, sources=SourceList(sources, FULL_SCALE, images))


def limited_run(log: Path = Path("logs/run1.mcap")) -> Run:
    """A run with sources of a fit, and a power map that holds limits but near them."""
    run = fitted_run(log)
    power_map = run.power_map
    centres = power_map.frame.centres(np.stack(np.indices(power_map.frame.shape), axis=-1))
    places = np.array([(source.x_m, source.y_m) for source in run.sources])
    distance = np.hypot(*np.moveaxis(centres[..., None, :] - places, -1, 0))
    return replace(run, power_map=replace(power_map, is_limit=distance.min(axis=-1) > 0.3))


def calibrated_run(log: Path = Path("logs/run1.mcap")) -> Run:
    """A run whose audio was late, and whose array was turned as believed."""
    clock = Offset(0.0503, 0.0041, OffsetVerdict.CORRECTED)
    yaw = Offset(np.radians(-0.3), np.radians(0.4), OffsetVerdict.NOUGHT)
    return replace(made_run(log), offsets=ArrayOffsets(clock, yaw, 0.81, 5))


def unlucky_run(log: Path = Path("logs/run1.mcap")) -> Run:
    """A run that heard nothing: no audio scans, no cells, no sources, no losses."""
    run = made_run(log)
    shape = run.power_map.frame.shape
    return replace(
        run,
        scans=AudioScans(
            np.zeros(0, dtype=np.int64),
            run.scans.bearing_rad,
            np.zeros((0, 120), dtype=np.float32),
            FULL_SCALE,
        ),
        power_map=PowerMap(
            run.power_map.frame, np.zeros(shape), np.zeros(shape, dtype=np.int64), FULL_SCALE
        ),
        sources=SourceList((), FULL_SCALE),
        losses=(),
    )


def made_ratio() -> PowerRatio:
    """A difference of two maps, in part without a background, with changes of three kinds."""
    room = walled_room()
    run = heard_map(room.frame, [(3.1, 0.25, 4e-7), (5.75, 3.4, 1e-7)])
    background = heard_map(room.frame, [(1.0, 3.0, 2e-7)], seed=6)
    power, floor = run.power(), background.power()
    measured = np.isfinite(floor)
    ratio_db = 10 * np.log10(power / np.where(measured, floor, np.nanmedian(floor)))
    appeared, louder, gone = ChangeKind.APPEARED, ChangeKind.LOUDER, ChangeKind.GONE
    changes = (
        Change(3.125, 0.275, 26.0204, 22, appeared, None, 1e-9, 0, None),
        Change(5.725, 3.375, 19.9, 17, louder, 0.4, 0.002, 1, 0),
        Change(1.0, 3.0, -14.0, 2, gone, None, 0.001, None, 1),
        Change(3.0, 4.2, 0.7, 9, ChangeKind.UNCHANGED, 0.5, 0.8, 2, 2),
    )
    return PowerRatio(room.frame, ratio_db, run.visits, measured, changes)
