"""What users get wrong: each has one clear message, an exit code, no traceback and no output."""

from pathlib import Path

import numpy as np
import pytest
import worlds
from logwriter import LogWriter, audio_frame, laser_scan, odometry, transform
from typer.testing import CliRunner

from soundmap.cli import app
from soundmap.geometry import Trajectory, relative
from soundmap.grid import OccupancyGrid
from soundmap.map_file import map_files

RATE = 16000
TRUTH = worlds.driven([(1.0, 1.0), (3.0, 1.0)])
SCANS = worlds.laser_scans(TRUTH, [worlds.FRONT], beams=181)
RELATIVE = relative(TRUTH.pose[0], TRUTH.pose)
ARRAY = '[array]\nkind = "circle"\nmicrophones = 4\nradius_m = 0.1\n'


def write_log(
    path: Path,
    *,
    audio: bool = True,
    lasers: bool = True,
    returns: bool = True,
    moving: bool = True,
    channels: int = 4,
) -> None:
    """A short drive through the test room with a microphone array that hears noise."""
    start = int(TRUTH.time_ns[0])
    with LogWriter(path) as log:
        tree = [
            transform("base_link", "laser", (0.2, 0.0, 0.3)),
            transform("base_link", "mic_array", (0.0, 0.0, 0.6)),
        ]
        log.ros2("/tf_static", "tf2_msgs/msg/TFMessage", {"transforms": tree}, start)
        for time_ns, pose in zip(TRUTH.time_ns, RELATIVE, strict=True):
            message = odometry(int(time_ns), tuple(pose) if moving else (0.0, 0.0, 0.0))
            log.ros2("/odom", "nav_msgs/msg/Odometry", message, int(time_ns))
        for scan in SCANS if lasers else []:
            ranges = scan.range_m if returns else np.full_like(scan.range_m, np.inf)
            message = laser_scan(
                scan.time_ns, "laser", ranges, time_increment=scan.ray_interval_ns * 1e-9
            )
            log.ros2("/scan", "sensor_msgs/msg/LaserScan", message, scan.time_ns)
        rng = np.random.default_rng(0)
        end = int(TRUTH.time_ns[-1])
        for time_ns in range(start, end, 10_000_000) if audio else []:
            samples = rng.integers(-900, 900, (RATE // 100, channels))
            message = audio_frame(time_ns + 10_000_000, samples, RATE)
            log.ros2("/mics", "audio_utils_msgs/msg/AudioFrame", message, time_ns + 10_000_000)


def write_map(folder: Path, room: OccupancyGrid) -> Path:
    for name, content in map_files(room).items():
        (folder / name).write_bytes(content)
    return folder / "map.yaml"


@pytest.fixture
def site(tmp_path):
    write_log(tmp_path / "run.mcap")
    write_map(tmp_path, worlds.room())
    (tmp_path / "robot.toml").write_text(ARRAY)
    return tmp_path


def processed(site: Path, log: str = "run.mcap", *more: object):
    settings = ["--map", site / "map.yaml", "--config", site / "robot.toml", "--out", site / "out"]
    arguments = ["process", site / log, *settings, *more]
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def assert_refused(result, site: Path, code: int, *words: str) -> None:
    assert result.exit_code == code, result.output
    assert not isinstance(result.exception, Exception) or isinstance(result.exception, SystemExit)
    message = " ".join(result.stderr.split())
    for word in words:
        assert word in message
    assert result.stdout == ""
    assert not (site / "out").exists()
    assert not list(site.glob(".out*"))


def test_the_sound_log_is_processed(site):
    result = processed(site)
    assert result.exit_code == 0, result.output
    assert (site / "out" / "sources.csv").exists()


def test_no_audio_topic(site):
    write_log(site / "deaf.mcap", audio=False)
    assert_refused(processed(site, "deaf.mcap"), site, 4, "deaf.mcap", "audio", "/scan")


def test_no_laser_topic(site):
    write_log(site / "blind.mcap", lasers=False)
    assert_refused(processed(site, "blind.mcap"), site, 4, "blind.mcap", "laser", "/odom")


def test_a_configured_topic_that_does_not_exist(site):
    (site / "robot.toml").write_text(ARRAY + '[topics]\naudio = "/mic"\n')
    assert_refused(processed(site), site, 2, "/mic", "/mics")


def test_another_number_of_channels_than_microphones(site):
    write_log(site / "eight.mcap", channels=8)
    assert_refused(processed(site, "eight.mcap"), site, 2, "/mics", "8 channels", "4")


def test_no_such_map(site):
    (site / "map.yaml").unlink()
    assert_refused(processed(site), site, 1, "map.yaml", "cannot be read")


def test_a_map_of_somewhere_else(site):
    hall = worlds.room()
    pillars = np.zeros_like(hall.occupied)
    pillars[10::30, 10::30] = True
    write_map(site, OccupancyGrid(hall.frame, pillars, ~pillars))
    assert_refused(processed(site), site, 1, "do not match the map")


def test_a_map_that_is_upside_down(site):
    room = worlds.room()
    write_map(site, OccupancyGrid(room.frame, room.occupied[::-1], room.free[::-1]))
    assert_refused(processed(site), site, 1, "do not match the map")


def test_a_map_with_free_and_occupied_swapped(site):
    path = site / "map.yaml"
    path.write_text(path.read_text().replace("negate: 0", "negate: 1"))
    assert_refused(processed(site, "run.mcap", "--start-pose", "1,1,0"), site, 1, "negate")


def test_laser_scans_without_any_return(site):
    write_log(site / "void.mcap", returns=False)
    assert_refused(processed(site, "void.mcap"), site, 4, "return")


def test_odometry_that_is_stuck(site):
    write_log(site / "stuck.mcap", moving=False)
    assert_refused(processed(site, "stuck.mcap"), site, 4, "odometry never moves")


def test_a_log_without_any_message(site):
    with LogWriter(site / "empty.mcap"):
        pass
    assert_refused(processed(site, "empty.mcap"), site, 4, "empty.mcap")


def test_an_empty_file(site):
    (site / "nothing.mcap").touch()
    assert_refused(processed(site, "nothing.mcap"), site, 3, "nothing.mcap", "empty")


def test_a_text_file_named_mcap(site):
    (site / "text.mcap").write_text("These are not the messages you are looking for.\n" * 9)
    assert_refused(processed(site, "text.mcap"), site, 3, "text.mcap", "MCAP")


def test_an_unknown_key_in_the_configuration(site):
    (site / "robot.toml").write_text(ARRAY + "[fuse]\nd_maximum_m = 2.0\n")
    assert_refused(
        processed(site), site, 2, "robot.toml", "'d_maximum_m'", "did you mean 'd_max_m'?"
    )


def test_audio_too_slow_for_the_band(site):
    (site / "robot.toml").write_text(ARRAY + "[scan]\nhigh_hz = 9000.0\n")
    assert_refused(processed(site), site, 2, "9000", "16000")


def test_audio_that_ends_before_one_scan_is_complete(site):
    end = int(TRUTH.time_ns[0]) + 50_000_000
    with LogWriter(site / "short.mcap") as log:
        samples = np.random.default_rng(0).integers(-900, 900, (RATE // 20, 4))
        message = audio_frame(end, samples, RATE)
        log.ros2("/mics", "audio_utils_msgs/msg/AudioFrame", message, end)
        tree = [
            transform("base_link", "laser", (0.2, 0.0, 0.3)),
            transform("base_link", "mic_array", (0.0, 0.0, 0.6)),
        ]
        log.ros2("/tf_static", "tf2_msgs/msg/TFMessage", {"transforms": tree}, end)
        for time_ns, pose in zip(TRUTH.time_ns, RELATIVE, strict=True):
            message = odometry(int(time_ns), tuple(pose))
            log.ros2("/odom", "nav_msgs/msg/Odometry", message, int(time_ns))
        for scan in SCANS:
            message = laser_scan(scan.time_ns, "laser", scan.range_m)
            log.ros2("/scan", "sensor_msgs/msg/LaserScan", message, scan.time_ns)
    assert_refused(processed(site, "short.mcap"), site, 4, "too short")


def test_every_fault_of_a_configuration_is_named_at_once(site):
    (site / "robot.toml").write_text(ARRAY + "[scan]\nbearings = 2\n[fuse]\ncell_m = -1\n")
    assert_refused(processed(site), site, 2, "2 wrong value(s)", "scan.bearings", "fuse.cell_m")


def test_the_trajectory_of_the_sound_log_is_right(site):
    processed(site)
    table = np.loadtxt(site / "out" / "trajectory.tum")
    start = TRUTH.time_ns[0] * 1e-9
    truth = Trajectory(TRUTH.time_ns - TRUTH.time_ns[0], TRUTH.pose, TRUTH.usable)
    expected = truth.at(np.rint((table[:, 0] - start) * 1e9).astype(np.int64))
    off = np.hypot(table[:, 1] - expected[:, 0], table[:, 2] - expected[:, 1])
    assert np.nanmedian(off) < 0.05
