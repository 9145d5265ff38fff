import json

import numpy as np
import pytest
from logwriter import LogWriter, laser_scan, odometry, transform
from typer.testing import CliRunner

from soundmap.cli import app
from soundmap.config import Config
from soundmap.map_file import read_map
from soundmap.map_log import mapped
from soundmap.outputs.progress import SilentProgress
from tests import worlds
from tests.mapping import drives


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A log of a drive with two scanners, without audio, and the truth."""
    truth = worlds.driven([(1, 1), (4, 1), (6, 2), (3.5, 2.6), (3.5, 4)])
    reported = drives.reported(truth, scale=1.04, turn_per_metre=0.04)
    scans = worlds.laser_scans(truth, [worlds.FRONT, worlds.BACK], rate_hz=8, beams=271)
    path = tmp_path_factory.mktemp("log") / "hall.mcap"
    with LogWriter(path) as log:
        mounts = [
            transform("base_link", name, mount.translation_m, yaw=mount.yaw_rad)
            for name, mount in (("front", worlds.FRONT), ("back", worlds.BACK))
        ]
        first = int(truth.time_ns[0])
        log.ros2("/tf_static", "tf2_msgs/msg/TFMessage", {"transforms": mounts}, first)
        messages = [
            (int(time_ns), "/odom", "nav_msgs/msg/Odometry", odometry(int(time_ns), tuple(pose)))
            for time_ns, pose in zip(reported.time_ns, reported.pose, strict=True)
        ]
        for scan in scans:
            frame = ("front", "back")[scan.scanner]
            content = laser_scan(
                scan.time_ns,
                frame,
                scan.range_m.astype(np.float32),
                angle_min=float(scan.bearing_rad[0]),
                angle_increment=float(scan.bearing_rad[1] - scan.bearing_rad[0]),
                time_increment=scan.ray_interval_ns * 1e-9,
                range_min=0.05,
                range_max=30.0,
            )
            messages.append((scan.time_ns, f"/{frame}", "sensor_msgs/msg/LaserScan", content))
        for time_ns, topic, name, content in sorted(messages, key=lambda m: m[0]):
            log.ros2(topic, name, content, time_ns)
    return path, truth


def test_a_log_without_audio_is_mapped(drive):
    path, truth = drive
    run = mapped(path, Config(), progress=SilentProgress())
    true = drives.from_first(truth, run.trajectory.time_ns)
    assert np.median(drives.errors(run.trajectory.pose, true)[0]) < 0.01
    assert run.counts["laser scanners"] == 2
    assert run.facts["odometry_distance_scale"] == pytest.approx(1 / 1.04, abs=0.01)
    assert set(run.timings_s) == {"read", "map"}


def test_the_command_writes_a_map_that_opens(drive, tmp_path):
    path, _ = drive
    folder = tmp_path / "hall"
    result = CliRunner().invoke(app, ["map", str(path), "--out", str(folder), "--json"])
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["folder"] == str(folder)
    assert report["map"]["key_scans"] > 30
    room = read_map(folder / "map.yaml")
    assert room.free[tuple(room.frame.cells(np.zeros(2)))], "the robot starts at the origin"
    again = CliRunner().invoke(app, ["map", str(path), "--out", str(folder)])
    assert again.exit_code == 1
    assert "--force" in again.output
    quiet = ["map", str(path), "--out", str(folder), "--force", "--quiet", "--figures", "none"]
    replaced = CliRunner().invoke(app, quiet)
    assert (replaced.exit_code, replaced.output) == (0, "")
    assert not (folder / "map.png").exists()


def test_a_log_that_cannot_be_read_leaves_no_folder(tmp_path):
    result = CliRunner().invoke(
        app, ["map", str(tmp_path / "no.mcap"), "--out", str(tmp_path / "o")]
    )
    assert result.exit_code == 3
    assert not (tmp_path / "o").exists()
