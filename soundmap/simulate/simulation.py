"""Simulation: one run of a scene, as a log with its map, its truth and its robot's file."""

from __future__ import annotations

import math
import secrets
import shutil
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tomli_w

from soundmap.errors import ConfigError, OutputError
from soundmap.geometry import wrapped_angle
from soundmap.map_file import map_files
from soundmap.simulate.audio_log import Progress, audio_messages, info_message
from soundmap.simulate.drive_log import Drive, laser_messages, mount_message, odometry_messages
from soundmap.simulate.log_writer import Topic, write_log
from soundmap.simulate.map_image import drawn_map
from soundmap.simulate.scene import Run, Scene
from soundmap.simulate.scene_file import loaded_scene, motion_of
from soundmap.simulate.sound_field import PERIOD_SAMPLES, source_spectrum
from soundmap.simulate.spectra import band_level_db

TRUTH_STEP_S = 0.01
BAND_HZ = (1000.0, 6000.0)
"""Band of the level in the truth, the paper's (Sect. 2.3)."""


@dataclass(frozen=True)
class SimulatedRun:
    """What was written.

    Attributes
    ----------
    run : str
        Name of the run.
    log : Path
    files : tuple of Path
        Everything written, the log included.
    duration_s : float
    messages : int
    sources : tuple of str
        Which sources sound.
    """

    run: str
    log: Path
    files: tuple[Path, ...]
    duration_s: float
    messages: int
    sources: tuple[str, ...]


def simulated_run(
    scene_file: Path,
    out_dir: Path,
    *,
    run: str | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> SimulatedRun:
    """Simulate one run of a scene and write its log, map, truth and robot file.

    Parameters
    ----------
    scene_file : Path
        A TOML file; wav files that it names are looked up beside it.
    out_dir : Path
        Gets ``<run>.mcap``, ``map.pgm``, ``map.yaml``, ``sources.csv``, ``trajectory.tum`` and
        ``robot.toml`` (valid as ``--config``).
    run : str, optional
        One of the scene's runs; left out: the first. A scene without runs has one, named like
        the scene, in which all sources sound.
    force : bool
        Write into a folder that is not empty.
    progress : callable, optional
        Told the share that is done.

    Raises
    ------
    ConfigError
        The scene is impossible or has no such run.
    OutputError
        The folder is not empty, or cannot be written.
    """
    scene = loaded_scene(scene_file)
    drive, chosen = drive_of(scene, run)
    texts: dict[str, bytes] = {
        **map_files(drawn_map(scene)),
        "sources.csv": sources_csv(scene, drive.active, scene_file.parent).encode(),
        "trajectory.tum": trajectory_tum(drive).encode(),
        "robot.toml": robot_toml(scene).encode(),
    }
    name = f"{chosen.name}.mcap"
    with _filled_folder(out_dir, force=force) as new:
        topics = _topics(drive, chosen.name, scene_file.parent, progress)
        messages = write_log(new / name, topics)
        for each, content in texts.items():
            (new / each).write_bytes(content)
    log = out_dir / name
    files = (log, *(out_dir / name for name in texts))
    return SimulatedRun(chosen.name, log, files, drive.motion.duration_s, messages, drive.active)


@contextmanager
def _filled_folder(out_dir: Path, *, force: bool) -> Iterator[Path]:
    """A hidden folder whose files move to ``out_dir`` when the ``with`` block ends well.

    Other files of ``out_dir`` stay: ``force`` adds to a folder, it does not empty it.
    """
    if out_dir.is_file() or (out_dir.is_dir() and any(out_dir.iterdir()) and not force):
        raise OutputError(f"{out_dir}: is not an empty folder. Choose another, or pass --force.")
    new = out_dir.with_name(f".{out_dir.resolve().name}.partial-{secrets.token_hex(4)}")
    try:
        new.mkdir(parents=True)
        yield new
        out_dir.mkdir(exist_ok=True)
        for file in sorted(new.iterdir()):
            file.replace(out_dir / file.name)
    except OSError as error:
        raise OutputError(f"{out_dir}: cannot be written ({error.strerror}).") from None
    finally:
        shutil.rmtree(new, ignore_errors=True)


def drive_of(scene: Scene, run: str | None = None) -> tuple[Drive, Run]:
    """The drive of one run of a scene, by default the first.

    Raises
    ------
    ConfigError
        There is no such run.
    """
    everything = Run(name=scene.name, sources=tuple(source.id for source in scene.sources))
    runs = {each.name: each for each in scene.runs or (everything,)}
    if run is not None and run not in runs:
        raise ConfigError(f"scene {scene.name!r} has no run {run!r}. Runs: {', '.join(runs)}.")
    chosen = runs[run] if run is not None else next(iter(runs.values()))
    people = tuple(p for p in scene.people if chosen.people is None or p.name in chosen.people)
    start_ns = round(scene.start_time_s * 1e9)
    return Drive(scene, motion_of(scene), chosen.sources, people, start_ns), chosen


def sources_csv(scene: Scene, active: tuple[str, ...], folder: Path) -> str:
    """Truth: the sources that sound, with their in-band level at 1 m on their axis.

    Moving sources are left out: they are nowhere, and what is sought are fixed sources.
    """
    rows = ["id,x_m,y_m,z_m,level_1m_db,level_dba_5cm,sound"]
    rate = scene.audio.rate_hz
    for source in scene.sources:
        if source.id not in active or source.way_points_m:
            continue
        rng = np.random.default_rng(scene.seed)
        spectrum = source_spectrum(source, folder, PERIOD_SAMPLES, rate, rng)
        level = band_level_db(spectrum, PERIOD_SAMPLES, rate, *BAND_HZ)
        x, y, z = source.position_m
        name = source.wav or source.sound
        rows.append(f"{source.id},{x:g},{y:g},{z:g},{level:.2f},{source.level_dba_5cm:g},{name}")
    return "\n".join(rows) + "\n"


def trajectory_tum(drive: Drive) -> str:
    """Truth: poses of the base in the map frame, every 10 ms, in TUM format."""
    step_ns = round(TRUTH_STEP_S * 1e9)
    times = np.arange(0, int(drive.motion.duration_s * 1e9) + 1, step_ns)
    lines = []
    for offset, pose in zip(times, drive.motion.at(times * 1e-9), strict=True):
        x, y, heading = pose[0], pose[1], float(wrapped_angle(pose[2]))
        seconds, nanos = divmod(drive.start_ns + int(offset), 1_000_000_000)
        z, w = math.sin(0.5 * heading), math.cos(0.5 * heading)
        lines.append(f"{seconds}.{nanos:09d} {x:.6f} {y:.6f} 0 0 0 {z:.9f} {w:.9f}")
    return "\n".join(lines) + "\n"


def robot_toml(scene: Scene) -> str:
    """Configuration of the robot: its array as designed, its scale, its topics."""
    array: dict[str, object] = {"frame": scene.array.frame}
    if scene.array.positions_m is not None:
        array["positions_m"] = [list(row) for row in scene.array.positions_m]
    else:
        array |= {
            "kind": "circle",
            "microphones": scene.array.microphones,
            "radius_m": scene.array.radius_m,
            "first_angle_rad": scene.array.first_angle_rad,
        }
    array["pascal_per_count"] = scene.array.pascal_per_count
    topics = {
        "audio": scene.audio.topic,
        "lasers": [laser.topic for laser in scene.lasers],
        "odometry": scene.odometry.topic,
    }
    return tomli_w.dumps({"array": array, "topics": topics})


def _topics(drive: Drive, run: str, folder: Path, progress: Progress | None) -> list[Topic]:
    """All topics of the log; every sensor draws from random numbers of its own."""
    scene = drive.scene

    def random(sensor: int) -> np.random.Generator:
        return np.random.default_rng([scene.seed, zlib.crc32(run.encode()), sensor])

    odometry, transforms = odometry_messages(drive, random(1))
    topics = [
        Topic("/tf_static", "tf2_msgs/msg/TFMessage", [mount_message(drive)], latched=True),
        Topic(scene.odometry.topic, "nav_msgs/msg/Odometry", odometry),
    ]
    if transforms:
        topics.append(Topic("/tf", "tf2_msgs/msg/TFMessage", transforms))
    sound = audio_messages(drive, folder, random(2), progress)
    topics.append(Topic(scene.audio.topic, scene.audio.schema_name, sound))
    if scene.audio.schema_name == "audio_common_msgs/msg/AudioDataStamped":
        info = [info_message(drive)]
        name = f"{scene.audio.topic}_info"
        topics.append(Topic(name, "audio_common_msgs/msg/AudioInfo", info, latched=True))
    for index, laser in enumerate(scene.lasers):
        scans = laser_messages(drive, laser, random(10 + index))
        topics.append(Topic(laser.topic, "sensor_msgs/msg/LaserScan", scans))
    return topics
