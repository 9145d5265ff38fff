"""Simulated drives without sound, as laser scans and odometry, with their truth."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from soundmap.config import Config
from soundmap.geometry import Trajectory
from soundmap.grid import OccupancyGrid
from soundmap.logs.robot_log import open_log
from soundmap.sensors import LaserScan
from soundmap.simulate.drive_log import laser_messages, mount_message, odometry_messages
from soundmap.simulate.log_writer import Topic, write_log
from soundmap.simulate.map_image import drawn_map
from soundmap.simulate.scene import Scene
from soundmap.simulate.scene_file import loaded_scene
from soundmap.simulate.simulation import drive_of


@dataclass(frozen=True)
class Drive:
    """What the sensors of a drive gave, the map of its site, and where the robot truly was."""

    scans: list[LaserScan]
    odometry: Trajectory
    room: OccupancyGrid
    truth: Trajectory


def simulated_drive(
    scene_file: Path, way_points_m: Sequence[tuple[float, float]] | None = None, seed: int = 1
) -> Drive:
    """A drive through a scene, along its own way points or others."""
    scene = loaded_scene(scene_file)
    robot = scene.robot
    if way_points_m is not None:
        robot = robot.model_copy(update={"way_points_m": tuple(way_points_m), "heading_deg": None})
    return drive_through(scene.model_copy(update={"robot": robot, "seed": seed}))


def drive_through(scene: Scene) -> Drive:
    """The drive of a scene."""
    seed = scene.seed
    drive, _ = drive_of(scene)
    odometry, _ = odometry_messages(drive, np.random.default_rng([seed, 1]))
    topics = [
        Topic("/tf_static", "tf2_msgs/msg/TFMessage", [mount_message(drive)], latched=True),
        Topic(scene.odometry.topic, "nav_msgs/msg/Odometry", odometry),
    ]
    for index, laser in enumerate(scene.lasers):
        messages = laser_messages(drive, laser, np.random.default_rng([seed, 10 + index]))
        topics.append(Topic(laser.topic, "sensor_msgs/msg/LaserScan", messages))
    with tempfile.TemporaryDirectory() as folder:
        write_log(Path(folder) / "drive.mcap", topics)
        log = open_log(Path(folder) / "drive.mcap", Config(), need_audio=False)
        scans = list(log.lasers())
    time_ns = np.arange(0, int(drive.motion.duration_s * 1e9), 10_000_000)
    pose = drive.motion.at(time_ns * 1e-9)
    truth = Trajectory(drive.start_ns + time_ns, pose, np.ones(len(time_ns), dtype=bool))
    return Drive(scans, log.odometry, drawn_map(scene), truth)
