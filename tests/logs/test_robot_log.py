"""Synthetic logs of every schema and fault, and the lab logs against their truth."""

import dataclasses
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from logwriter import (
    SECOND,
    START_NS,
    LogWriter,
    audio_frame,
    header,
    laser_scan,
    odometry,
    quaternion,
    reencoded_as_protobuf,
    repeated,
    stamped,
    time_of,
    transform,
    xyz,
)

from soundmap.config import Config, loaded_config
from soundmap.errors import ConfigError, LogError, NothingUsableError
from soundmap.logs.robot_log import open_log
from soundmap.logs.summary import log_summary

LAB = Path(__file__).parents[2] / ".." / "shared" / "data" / "lab"
needs_lab = pytest.mark.skipif(
    not LAB.is_dir(), reason="the lab logs (../shared/data/lab) are not here"
)

RATE = 16000
BLOCK = 160
CHANNELS = 4
SECONDS = 2.0
DATA = np.random.default_rng(3).integers(
    -3000, 3000, (int(SECONDS * RATE), CHANNELS), dtype=np.int16
)
RADIUS, SPEED = 2.0, 0.5
RANGES = np.linspace(1.0, 5.0, 91)
TREE = (
    transform("base_link", "laser", (0.2, 0.0, 0.3), yaw=0.1),
    transform("base_link", "mic_array", (0.0, 0.0, 0.6), yaw=0.5),
)
CONFIG = Config.model_validate(
    {"array": {"kind": "circle", "microphones": CHANNELS, "radius_m": 0.1}}
)


def configured(**tables):
    return Config.model_validate(
        {"array": {"kind": "circle", "microphones": CHANNELS, "radius_m": 0.1}} | tables
    )


def circle_pose(t):
    """On a circle at constant speed: pose and twist are known in closed form."""
    turn = SPEED / RADIUS
    return (RADIUS * np.sin(turn * t), RADIUS * (1 - np.cos(turn * t)), turn * t)


def blocks():
    for i in range(len(DATA) // BLOCK):
        yield START_NS + i * BLOCK * SECOND // RATE, DATA[i * BLOCK : (i + 1) * BLOCK], i * BLOCK


END = BLOCK * SECOND // RATE


def frames(log, **over):
    for start, samples, _ in blocks():
        log.ros2(
            "/audio",
            "audio_utils_msgs/msg/AudioFrame",
            audio_frame(start + END, samples, RATE, **over),
            start + END,
        )


def scans(log, topic="/scan", frame="laser", ranges=RANGES, write=None, offset=0, **fields):
    for i in range(int(SECONDS * 10)):
        stamp = START_NS + i * SECOND // 10 + offset
        (write or log.ros2)(
            topic, "sensor_msgs/msg/LaserScan", laser_scan(stamp, frame, ranges, **fields), stamp
        )


def drive(log, topic="/odom", write=None, change=lambda i, message: message, **names):
    for i in range(int(SECONDS * 50) + 1):
        stamp = START_NS + i * SECOND // 50
        message = odometry(stamp, circle_pose(i / 50), (SPEED, 0.0, SPEED / RADIUS), **names)
        (write or log.ros2)(topic, "nav_msgs/msg/Odometry", change(i, message), stamp)


def static(log, *tree, topic="/tf_static"):
    log.ros2(topic, "tf2_msgs/msg/TFMessage", {"transforms": list(tree or TREE)}, START_NS)


def written(path, *parts, **options):
    """A log of the parts given, each a function of the writer; static transforms, odometry, scans
    and audio unless a part is replaced by a keyword."""
    with LogWriter(path, **options) as log:
        for part in parts:
            part(log)
    return path


@pytest.fixture
def log_path(tmp_path):
    return tmp_path / "log.mcap"


def opened(path, *parts, config=CONFIG, need_audio=True, **options):
    return open_log(written(path, *parts, **options), config, need_audio=need_audio)


def what(log):
    return {loss.what: loss.count for loss in log.losses}


def sound(log):
    return np.concatenate([block.samples for block in log.audio()])


# Every schema


def test_a_log_gives_back_what_its_sensors_measured(log_path):
    log = opened(log_path, static, drive, scans, frames)
    assert (log.base_frame, log.scanners, log.sample_rate_hz) == ("base_link", ("/scan",), RATE)
    assert log.duration_s == pytest.approx(SECONDS)
    np.testing.assert_array_equal(sound(log), DATA)
    audio = list(log.audio())
    assert [b.time_ns for b in audio[:2]] == pytest.approx([START_NS, START_NS + END], abs=1000)
    assert [b.continues for b in audio[:3]] == [False, True, True]
    assert audio[0].full_scale == 32768.0
    lasers = list(log.lasers())
    assert len(lasers) == 20
    np.testing.assert_allclose(lasers[3].range_m, RANGES, rtol=1e-6)
    assert lasers[3].bearing_rad[[0, -1]] == pytest.approx([-2.356, 2.356], abs=1e-5)
    assert lasers[3].time_ns == START_NS + 3 * SECOND // 10
    assert lasers[0].mount.yaw_rad == pytest.approx(0.1)
    assert log.array.mount.yaw_rad == pytest.approx(0.5)
    np.testing.assert_allclose(log.odometry.pose[-1], circle_pose(SECONDS), atol=1e-9)
    assert len(log.losses) == 0


def raw_audio_ros2(log):
    for start, samples, _ in blocks():
        message = {
            "timestamp": time_of(start),
            "data": samples.tobytes(),
            "format": "pcm-s16",
            "sample_rate": RATE,
            "number_of_channels": CHANNELS,
        }
        log.ros2("/mics", "foxglove_msgs/msg/RawAudio", message, start + END)


def raw_audio_protobuf(log):
    for start, samples, _ in blocks():
        message = {
            "timestamp": stamped(start),
            "data": samples.tobytes(),
            "format": "pcm-s16",
            "sample_rate": RATE,
            "number_of_channels": CHANNELS,
        }
        log.protobuf("/mics", "foxglove.RawAudio", message, start + END)


def audio_data_stamped(log, coding="WAVE"):
    info = {
        "channels": CHANNELS,
        "sample_rate": RATE,
        "sample_format": "S16LE",
        "coding_format": coding,
    }
    log.ros2("/mics/info", "audio_common_msgs/msg/AudioInfo", info, START_NS)
    for start, samples, _ in blocks():
        message = {"header": header(start, "mic_array"), "audio": {"data": samples.tobytes()}}
        log.ros2("/mics/stamped", "audio_common_msgs/msg/AudioDataStamped", message, start + END)


def audio_data(log):
    info = {
        "channels": CHANNELS,
        "sample_rate": RATE,
        "sample_format": "S16LE",
        "coding_format": "wave",
    }
    log.ros2("/mics/info", "audio_common_msgs/msg/AudioInfo", info, START_NS)
    for start, samples, _ in blocks():
        log.ros2(
            "/mics/audio",
            "audio_common_msgs/msg/AudioData",
            {"data": samples.tobytes()},
            start + END,
        )


def counted_audio(log, layout=0, big_endian=False, skip=()):
    for number, (start, samples, first) in enumerate(blocks()):
        if number in skip:
            continue
        data = samples.T if layout else samples
        data = np.ascontiguousarray(data, dtype=">i2" if big_endian else "<i2").tobytes()
        message = {
            "header": header(start, "mic_array"),
            "seq_num": first,
            "frames": len(samples),
            "channels": CHANNELS,
            "sample_rate": RATE,
            "encoding": "S16BE" if big_endian else "S16LE",
            "is_bigendian": int(big_endian),
            "layout": layout,
            "step": 2 * CHANNELS,
            "data": data,
        }
        log.ros2("/mics", "audio_msgs/msg/Audio", message, start + END)


def audio_frame_ros1(log):
    for start, samples, _ in blocks():
        log.ros1(
            "/audio",
            "audio_utils_msgs/msg/AudioFrame",
            audio_frame(start + END, samples, RATE),
            start + END,
        )


@pytest.mark.parametrize(
    "write",
    [
        frames,
        raw_audio_ros2,
        raw_audio_protobuf,
        audio_data_stamped,
        audio_data,
        counted_audio,
        lambda log: counted_audio(log, layout=1),
        lambda log: counted_audio(log, big_endian=True),
        lambda log: counted_audio(log, layout=1, big_endian=True),
        audio_frame_ros1,
    ],
)
def test_every_audio_schema_gives_the_same_samples_at_the_same_time(log_path, write):
    log = opened(log_path, static, drive, scans, write)
    np.testing.assert_array_equal(sound(log), DATA)
    for block, (start, _, _) in zip(log.audio(), blocks(), strict=True):
        assert abs(block.time_ns - start) < 10_000
    assert sum(not block.continues for block in log.audio()) == 1


FORMATS = {
    "signed_8": lambda x: (x >> 8).astype("i1").tobytes(),
    "signed_32": lambda x: (x.astype("<i4") << 16).tobytes(),
    "signed_24": lambda x: (x.astype("<i4") << 8).view("u1").reshape(-1, 4)[:, :3].tobytes(),
    "signed_padded_24": lambda x: (
        ((x.astype("<i4") << 8) & 0xFFFFFF | 0x5A000000).astype("<i4").tobytes()
    ),
    "unsigned_8": lambda x: ((x >> 8) + 128).astype("u1").tobytes(),
    "unsigned_16": lambda x: (x.astype("i4") + 32768).astype("<u2").tobytes(),
    "unsigned_24": lambda x: (
        ((x.astype("<i4") << 8) + 2**23).view("u1").reshape(-1, 4)[:, :3].tobytes()
    ),
    "unsigned_32": lambda x: ((x.astype("i8") << 16) + 2**31).astype("<u4").tobytes(),
    "float": lambda x: (x / 32768).astype("<f4").tobytes(),
    "double": lambda x: (x / 32768).astype("<f8").tobytes(),
    "S24LE": lambda x: (x.astype("<i4") << 8).view("u1").reshape(-1, 4)[:, :3].tobytes(),
    "S24BE": lambda x: (
        (x.astype(">i4") << 8).astype(">i4").view("u1").reshape(-1, 4)[:, 1:].tobytes()
    ),
    "S24_32LE": lambda x: (x.astype("<i4") << 8).tobytes(),
    "F32BE": lambda x: (x / 32768).astype(">f4").tobytes(),
}


@pytest.mark.parametrize("name", list(FORMATS))
def test_every_sample_format_means_the_same_share_of_full_scale(log_path, name):
    def audio(log):
        for start, samples, _ in blocks():
            data = FORMATS[name](samples.ravel())
            log.ros2(
                "/audio",
                "audio_utils_msgs/msg/AudioFrame",
                audio_frame(start + END, samples, RATE, format=name, data=data),
                start + END,
            )

    log = opened(log_path, static, drive, scans, audio)
    block = next(log.audio())
    assert block.samples.dtype.isnative
    resolution = 2**-7 if name.endswith("_8") else 2**-16
    np.testing.assert_allclose(
        block.samples / block.full_scale, DATA[:BLOCK] / 32768, atol=resolution
    )


def test_lasers_of_either_ros_and_of_protobuf_agree(log_path):
    def protobuf(log):
        for i in range(20):
            stamp = START_NS + i * SECOND // 10
            pose = {"position": {"x": 0.2, "z": 0.3}, "orientation": quaternion(0.1)}
            message = {
                "timestamp": stamped(stamp),
                "frame_id": "base_link",
                "pose": pose,
                "start_angle": -2.356,
                "end_angle": 2.356,
                "ranges": RANGES.tolist(),
            }
            log.protobuf("/proto", "foxglove.LaserScan", message, stamp)

    def foxglove_ros2(log):
        for i in range(20):
            stamp = START_NS + i * SECOND // 10
            message = {
                "timestamp": time_of(stamp),
                "frame_id": "laser",
                "start_angle": -2.356,
                "end_angle": 2.356,
                "ranges": RANGES,
            }
            log.ros2("/foxglove", "foxglove_msgs/msg/LaserScan", message, stamp)

    log = opened(
        log_path,
        static,
        drive,
        scans,
        lambda w: scans(w, "/ros1", write=w.ros1),
        protobuf,
        foxglove_ros2,
        need_audio=False,
    )
    assert log.scanners == ("/foxglove", "/proto", "/ros1", "/scan")
    scan_points = [s.mount.base_points(s.bearing_rad, s.range_m) for s in log.lasers()]
    assert len(scan_points) == 80
    for points in scan_points:
        np.testing.assert_allclose(points, scan_points[0], atol=1e-5)
    assert {s.range_max_m for s in log.lasers()} == {30.0, 5.0}
    assert log.array is None


def test_mounts_and_odometry_come_from_protobuf_transforms_as_well(log_path):
    def transforms(log):
        for i in range(101):
            stamp, (x, y, yaw) = START_NS + i * SECOND // 50, circle_pose(i / 50)
            moving = {
                "timestamp": stamped(stamp),
                "parent_frame_id": "odom",
                "child_frame_id": "base",
                "translation": {"x": x, "y": y},
                "rotation": quaternion(yaw),
            }
            fixed = {
                "timestamp": stamped(stamp),
                "parent_frame_id": "base",
                "child_frame_id": "laser",
                "translation": {"x": 0.2},
                "rotation": quaternion(0.3),
            }
            log.protobuf(
                "/poses", "foxglove.FrameTransforms", {"transforms": [moving, fixed]}, stamp
            )
        mic = {
            "parent_frame_id": "laser",
            "child_frame_id": "mic_array",
            "translation": {"x": 1.0},
            "rotation": quaternion(0.2),
        }
        log.protobuf("/mount", "foxglove.FrameTransform", mic, START_NS)

    log = opened(log_path, transforms, scans, raw_audio_protobuf)
    assert log.base_frame == "base"
    np.testing.assert_allclose(log.odometry.pose[-1], circle_pose(SECONDS), atol=1e-9)
    assert log.array.mount.yaw_rad == pytest.approx(0.5)
    np.testing.assert_allclose(
        log.array.mount.translation_m, [0.2 + np.cos(0.3), np.sin(0.3), 0], atol=1e-9
    )


def test_a_type_without_definition_is_taken_from_the_built_in_ones(log_path):
    def bare(log):
        return lambda topic, name, values, time: log.ros2(
            topic, name, values, time, definition=False
        )

    def audio(log):
        for start, samples, _ in blocks():
            bare(log)(
                "/audio",
                "audio_utils_msgs/msg/AudioFrame",
                audio_frame(start + END, samples, RATE),
                start + END,
            )

    log = opened(
        log_path,
        static,
        lambda w: drive(w, write=bare(w)),
        lambda w: scans(w, write=bare(w)),
        audio,
    )
    np.testing.assert_array_equal(sound(log), DATA)
    assert len(list(log.lasers())) == 20
    assert not log.losses.data_lost
    assert sum("definition" in name for name in what(log)) == 1


def test_big_endian_messages_are_read(log_path):
    def write(log):
        return lambda topic, name, values, time: log.ros2(
            topic, name, values, time, big_endian=True
        )

    log = opened(
        log_path,
        static,
        lambda w: drive(w, write=write(w)),
        lambda w: scans(w, write=write(w)),
        need_audio=False,
    )
    np.testing.assert_allclose(next(log.lasers()).range_m, RANGES, rtol=1e-6)


def test_messages_are_known_by_their_fields_not_by_the_name_of_their_type(log_path):
    def own_odometry(log):
        drive(
            log,
            "/wheels",
            write=lambda t, _, values, time: log.ros2(
                t, "my_robot/msg/WheelOdometry", values, time
            ),
        )

    log = opened(log_path, static, own_odometry, scans, need_audio=False)
    np.testing.assert_allclose(log.odometry.pose[-1], circle_pose(SECONDS), atol=1e-9)


# Faults of the odometry


def spoilt(*, pose=None, twist=None, when=lambda i: True):
    def change(i, message):
        if when(i):
            if pose is not None:
                message["pose"]["pose"]["position"] = xyz((pose, pose, 0.0))
                message["pose"]["pose"]["orientation"] = dict.fromkeys("xyzw", pose)
            if twist is not None:
                message["twist"]["twist"]["linear"] = xyz((twist, twist, 0.0))
                message["twist"]["twist"]["angular"] = xyz((twist, twist, twist))
        return message

    return change


@pytest.mark.parametrize(
    "when",
    [
        lambda i: i > 0,
        lambda i: True,
        lambda i: i < 60,
        lambda i: 30 <= i < 70,
        lambda i: i % 2 == 1,
    ],
)
def test_where_the_pose_is_nan_the_twist_tells_the_motion(log_path, when):
    log = opened(
        log_path,
        static,
        lambda w: drive(w, change=spoilt(pose=np.nan, when=when)),
        scans,
        need_audio=False,
    )
    count = sum(when(i) for i in range(101))
    (loss,) = log.losses
    assert (loss.what, loss.count) == ("odometry pose is not finite", count)
    assert loss.effect == "motion taken from the twist"
    assert len(log.odometry) == 101
    from soundmap.geometry import relative

    expected = np.array([circle_pose(i / 50) for i in range(101)])
    moved = relative(log.odometry.pose[0], log.odometry.pose)
    np.testing.assert_allclose(moved, expected, atol=1e-6)


def test_a_pose_that_was_reset_does_not_make_the_robot_jump(log_path):
    def change(i, message):
        if 40 <= i < 60:
            return spoilt(pose=np.nan)(i, message)
        if i >= 60:
            x, y, yaw = circle_pose((i - 60) / 50)
            message["pose"]["pose"] = {
                "position": xyz((x + 50, y, 0)),
                "orientation": quaternion(yaw),
            }
        return message

    log = opened(log_path, static, lambda w: drive(w, change=change), scans, need_audio=False)
    np.testing.assert_allclose(log.odometry.pose[-1], circle_pose(SECONDS), atol=1e-6)


def test_without_a_usable_twist_messages_with_nan_are_left_out(log_path):
    change = spoilt(pose=np.nan, twist=np.nan, when=lambda i: i in (10, 11))
    log = opened(log_path, static, lambda w: drive(w, change=change), scans, need_audio=False)
    assert len(log.odometry) == 99
    assert what(log) == {"odometry pose is not finite, nor is the twist usable": 2}


def test_a_twist_that_is_never_filled_is_not_taken_for_standing_still(log_path):
    def change(i, message):
        return spoilt(pose=np.nan if i in (50, 51) else None, twist=0.0)(i, message)

    log = opened(log_path, static, lambda w: drive(w, change=change), scans, need_audio=False)
    assert len(log.odometry) == 99
    np.testing.assert_allclose(log.odometry.pose[-1], circle_pose(SECONDS), atol=1e-9)


def test_a_quaternion_of_noughts_is_no_heading(log_path):
    def change(i, message):
        if i == 20:
            message["pose"]["pose"]["orientation"] = dict.fromkeys("xyzw", 0.0)
        return message

    log = opened(log_path, static, lambda w: drive(w, change=change), scans, need_audio=False)
    assert what(log) == {"odometry pose is not finite": 1}
    np.testing.assert_allclose(log.odometry.pose[20], circle_pose(0.4), atol=1e-6)


def test_stamps_that_repeat_or_run_back_are_left_out(log_path):
    def change(i, message):
        if i in (30, 31):
            message["header"]["stamp"] = time_of(START_NS + 10 * SECOND // 50)
        return message

    log = opened(log_path, static, lambda w: drive(w, change=change), scans, need_audio=False)
    assert what(log) == {"odometry stamp runs backward or repeats": 2}
    assert len(log.odometry) == 99


def test_messages_without_stamps_get_the_time_of_logging(log_path):
    def change(i, message):
        message["header"]["stamp"] = time_of(0)
        return message

    log = opened(log_path, static, lambda w: drive(w, change=change), scans, need_audio=False)
    assert log.odometry.time_ns[1] == START_NS + SECOND // 50
    assert what(log) == {"message without a stamp": 101}
    assert not log.losses.data_lost


def test_one_stamp_in_the_far_future_costs_one_message(log_path):
    def change(i, message):
        if i == 30:
            message["header"]["stamp"] = time_of(START_NS + 10**6 * SECOND)
        return message

    log = opened(log_path, static, lambda w: drive(w, change=change), scans, frames)
    assert what(log) == {"stamp far from the time of logging": 1}
    assert len(log.odometry) == 100


def test_sensors_on_another_clock_are_brought_together_by_the_time_of_logging(log_path):
    behind = 3600 * SECOND

    def late_scans(log):
        for i in range(20):
            time = START_NS + i * SECOND // 10
            message = laser_scan(time - behind, "laser", RANGES)
            log.ros2("/scan", "sensor_msgs/msg/LaserScan", message, time)

    log = opened(log_path, static, drive, late_scans, frames)
    assert [s.time_ns for s in log.lasers()] == [START_NS + i * SECOND // 10 for i in range(20)]
    assert [loss.what for loss in log.losses] == ["stamps are -3600.0 s off those of the odometry"]
    assert not log.losses.data_lost


def test_odometry_comes_from_the_transform_under_the_sensors_when_there_is_no_topic(log_path):
    def moving(log):
        for i in range(101):
            stamp, (x, y, yaw) = START_NS + i * SECOND // 50, circle_pose(i / 50)
            tree = [
                transform("map", "odom", (0.001 * i, 0, 0), stamp_ns=stamp),
                transform("odom", "base_footprint", (x, y, 0.0), yaw=yaw, stamp_ns=stamp),
                transform("base_link", "wheel", (0, 0.2, 0), roll=0.1 * i, stamp_ns=stamp),
                transform("/base_footprint", "/base_link", (0, 0, 0.1), stamp_ns=stamp),
            ]
            log.ros2("/tf", "tf2_msgs/msg/TFMessage", {"transforms": tree}, stamp)

    log = opened(log_path, static, moving, scans, frames)
    assert log.base_frame == "base_footprint"
    np.testing.assert_allclose(log.odometry.pose[-1], circle_pose(SECONDS), atol=1e-9)
    assert log.array.mount.translation_m == pytest.approx([0, 0, 0.7])


# Faults of the lasers


def test_whatever_means_no_return_is_nan(log_path):
    ranges = [2.0, np.inf, -np.inf, np.nan, 0.0, 0.05, 30.0, 65.0, -1.0, 0.1001]
    log = opened(log_path, static, drive, lambda w: scans(w, ranges=ranges), need_audio=False)
    assert np.isfinite(next(log.lasers()).range_m).tolist() == [True] + [False] * 8 + [True]


def test_a_log_without_a_single_return_is_of_no_use(log_path):
    with pytest.raises(NothingUsableError, match="no laser returns"):
        opened(
            log_path,
            static,
            drive,
            lambda w: scans(w, ranges=np.full(90, np.inf)),
            need_audio=False,
        )


def test_empty_and_late_scans_are_counted_once_however_often_they_are_read(log_path):
    def lasers(log):
        for i in range(20):
            stamp = START_NS + (i if i != 7 else 2) * SECOND // 10
            log.ros2(
                "/scan",
                "sensor_msgs/msg/LaserScan",
                laser_scan(stamp, "laser", [] if i == 4 else RANGES),
                START_NS + i * SECOND // 10,
            )

    log = opened(log_path, static, drive, lasers, need_audio=False)
    for _ in range(2):
        times = [scan.time_ns for scan in log.lasers()]
        assert times == [START_NS + i * SECOND // 10 for i in range(20) if i not in (4, 7)]
    assert what(log) == {"laser scan without ranges": 1, "laser stamp runs backward or repeats": 1}


@pytest.mark.parametrize(
    ("increment", "expected"), [(1e-3, 1e6), (np.nan, 0), (0.0, 0), (-1e-3, 0), (5e-3, 0)]
)
def test_the_time_between_rays_is_believed_only_if_a_sweep_fits_its_period(
    log_path, increment, expected
):
    log = opened(
        log_path, static, drive, lambda w: scans(w, time_increment=increment), need_audio=False
    )
    assert next(log.lasers()).ray_interval_ns == pytest.approx(expected)
    assert len(log.losses) == (1 if increment in (-1e-3, 5e-3) else 0)


def test_scans_of_all_scanners_come_in_the_order_of_their_first_rays(log_path):
    log = opened(
        log_path, static, drive,
        lambda w: scans(w), lambda w: scans(w, "/other", offset=30_000_000),
        need_audio=False,
    )  # fmt: skip
    times = [(scan.time_ns, scan.scanner) for scan in log.lasers()]
    assert len(times) == 40
    assert times == sorted(times)
    assert [scanner for _, scanner in times[:4]] == [1, 0, 1, 0]


def test_a_scanner_that_hangs_upside_down_sees_left_on_the_left(log_path):
    tree = transform("base_link", "laser", (0.1, 0, 0.3), roll=np.pi)
    log = opened(
        log_path,
        lambda w: static(w, tree),
        drive,
        lambda w: scans(w, angle_min=0.0, angle_increment=np.pi / 180),
        need_audio=False,
    )
    scan = next(log.lasers())
    assert scan.mount.handedness == -1
    # The ray at +90 degrees in the scanner's frame points to the robot's right.
    assert scan.mount.base_points(scan.bearing_rad, scan.range_m)[90] == pytest.approx(
        [0.1, -5.0], abs=1e-3
    )
    assert len(log.losses) == 0


def test_a_tilted_scanner_is_remarked_on(log_path):
    tree = transform("base_link", "laser", (0.1, 0, 0.3), roll=0.1)
    log = opened(log_path, lambda w: static(w, tree), drive, scans, need_audio=False)
    assert [loss.what for loss in log.losses] == ["laser frame 'laser' is tilted by 5.7 degrees"]
    assert not log.losses.data_lost


# Mounts


def test_chains_of_transforms_are_followed_both_ways(log_path):
    tree = [
        transform("chassis", "base_link", (0, 0, 0.5)),
        transform("chassis", "tower", (1, 0, 0), yaw=np.pi / 2),
        transform("tower", "laser", (1, 0, 0)),
        transform("tower", "mic_array", (0, 0, 1.0)),
    ]
    log = opened(log_path, lambda w: static(w, *tree), drive, scans, frames)
    np.testing.assert_allclose(next(log.lasers()).mount.translation_m, [1, 1, -0.5], atol=1e-9)
    np.testing.assert_allclose(log.array.mount.translation_m, [1, 0, 0.5], atol=1e-9)


def test_the_configuration_wins_over_the_log(log_path):
    config = configured(mounts={"laser": [9, 8, 7, 1.0]})
    config = config.model_copy(
        update={"array": config.array.model_copy(update={"mount": (1, 2, 3, 0.25)})}
    )
    log = opened(log_path, static, drive, scans, frames, config=config)
    assert next(log.lasers()).mount.translation_m.tolist() == [9, 8, 7]
    assert log.array.mount.yaw_rad == pytest.approx(0.25)


def test_a_laser_in_the_base_frame_needs_no_transform(log_path):
    log = opened(log_path, drive, lambda w: scans(w, frame="base_link"), need_audio=False)
    np.testing.assert_array_equal(next(log.lasers()).mount.translation_m, [0, 0, 0])


def test_an_odometry_frame_outside_the_tree_is_taken_for_its_root(log_path):
    log = opened(
        log_path, static, lambda w: drive(w, child="base_footprint"), scans, need_audio=False
    )
    assert log.base_frame == "base_link"
    assert not log.losses.data_lost
    assert len(log.losses) == 1


def test_an_unknown_mount_is_named_with_the_frames_there_are(log_path):
    with pytest.raises(ConfigError, match=r"'lidar' .*base_link.*laser.*\[mounts\] \"lidar\" ="):
        opened(log_path, static, drive, lambda w: scans(w, frame="lidar"), need_audio=False)
    config = configured(array={"kind": "circle", "microphones": 4, "frame": "mic_aray"})
    with pytest.raises(ConfigError, match=r"'mic_aray' is not in the log.*Did you mean mic_array"):
        opened(log_path, static, drive, scans, frames, config=config)
    with pytest.raises(ConfigError, match=r"'horn'.*Frames known: base_link, laser"):
        opened(
            log_path,
            lambda w: static(w, TREE[0]),
            drive,
            scans,
            lambda w: frames(w, frame_id="horn"),
        )


# Choice of topics


def test_several_candidates_are_named_and_the_configuration_settles_it(log_path):
    parts = (static, drive, lambda w: drive(w, "/odom_filtered"), scans, frames, raw_audio_ros2)
    with pytest.raises(
        ConfigError, match=r"2 odometry topics: /odom, /odom_filtered.*\[topics\] odometry ="
    ):
        opened(log_path, *parts)
    with pytest.raises(ConfigError, match=r"2 audio topics: /audio, /mics.*\[topics\] audio ="):
        opened(log_path, *parts, config=configured(topics={"odometry": "/odom"}))
    chosen = {"odometry": "/odom", "audio": "/mics", "lasers": ["/scan"]}
    np.testing.assert_array_equal(
        sound(opened(log_path, *parts, config=configured(topics=chosen))), DATA
    )


@pytest.mark.parametrize(
    ("topics", "says"),
    [
        ({"audio": "/audoi"}, r"/audoi.*Did you mean /audio.*audio topics in the log: /audio"),
        ({"odometry": "/scan"}, r"/scan holds sensor_msgs.*not odometry.*: /odom"),
        ({"lasers": ["/scan", "/back"]}, "no messages on /back"),
    ],
)
def test_a_configured_topic_that_is_not_there_is_told_apart_from_one_of_another_kind(
    log_path, topics, says
):
    with pytest.raises(ConfigError, match=says):
        opened(log_path, static, drive, scans, frames, config=configured(topics=topics))


@pytest.mark.parametrize(
    ("parts", "says"),
    [
        ((static, drive, scans), "no audio topic.*holds .*/scan"),
        ((static, drive, frames), "no laser topic"),
        ((static, scans, frames), "no odometry topic"),
        ((), "no messages at all"),
    ],
)
def test_what_is_missing_is_said_with_what_is_there(log_path, parts, says):
    with pytest.raises(NothingUsableError, match=says) as error:
        opened(log_path, *parts)
    assert error.value.exit_code == 4


def test_channels_and_microphones_must_agree(log_path):
    with pytest.raises(ConfigError, match=r"log.mcap: topic /audio has 4 channels.*16 microphones"):
        opened(log_path, static, drive, scans, frames, config=Config())


# Faults of the audio


def test_compressed_audio_is_refused_by_name(log_path):
    with pytest.raises(NothingUsableError, match=r"'MP3'.*uncompressed"):
        opened(log_path, static, drive, scans, lambda w: audio_data_stamped(w, coding="MP3"))
    with pytest.raises(NothingUsableError, match=r"'opus'.*uncompressed"):
        opened(log_path, static, drive, scans, lambda w: frames(w, format="opus"))


def test_a_gap_in_the_counter_is_a_gap_in_the_audio(log_path):
    log = opened(log_path, static, drive, scans, lambda w: counted_audio(w, skip=(50, 51)))
    breaks = [b.time_ns for b in log.audio() if not b.continues]
    assert breaks == pytest.approx([START_NS, START_NS + 52 * END], abs=10_000)
    assert what(log) == {"gap in the audio": 1}


def test_blocks_that_contradict_their_header_are_left_out_and_leave_a_gap(log_path):
    def audio(log):
        for i, (start, samples, _) in enumerate(blocks()):
            message = audio_frame(start + END, samples, RATE)
            if i == 60:
                message["data"] = message["data"][:-6]
            if i == 90:
                message["frame_sample_count"] = 1
            log.ros2("/audio", "audio_utils_msgs/msg/AudioFrame", message, start + END)

    log = opened(log_path, static, drive, scans, audio)
    assert what(log) == {"audio block is not as long as its header says": 2, "gap in the audio": 2}
    assert len(sound(log)) == len(DATA) - 2 * BLOCK
    assert sum(not b.continues for b in log.audio()) == 3


def test_the_configuration_says_what_a_stamp_stands_for(log_path):
    log = opened(
        log_path, static, drive, scans, frames, config=configured(audio={"stamp": "start"})
    )
    assert next(log.audio()).time_ns == pytest.approx(START_NS + END, abs=1000)


def test_messages_of_nonsense_are_counted_and_the_rest_is_used(log_path):
    def nonsense(log):
        from logwriter import ROS2

        for topic, name in (
            ("/odom", "nav_msgs/msg/Odometry"),
            ("/scan", "sensor_msgs/msg/LaserScan"),
            ("/audio", "audio_utils_msgs/msg/AudioFrame"),
        ):
            text = ROS2.generate_msgdef(name, ros_version=2)[0].encode()
            for data in (
                b"",
                b"\x00\x01\x00\x00",
                b"\xff" * 40,
                b"\x00\x01\x00\x00" + bytes(30),
                struct.pack("<4s3I", b"\x00\x01\x00\x00", 1, 1, 2**31),
            ):
                log.raw(topic, (name, "ros2msg", text), "cdr", data, START_NS + SECOND)

    log = opened(log_path, static, drive, scans, frames, nonsense)
    np.testing.assert_array_equal(sound(log), DATA)
    assert len(list(log.lasers())) == 20
    assert what(log) == {f"damaged {kind} message": 5 for kind in ("odometry", "laser", "audio")}


# Whole files


def test_messages_that_rosbag2_packed_one_by_one_are_read(tmp_path):
    import zstandard

    pack = zstandard.ZstdCompressor().compress
    plain = opened(tmp_path / "plain.mcap", static, drive, scans, frames)
    with LogWriter(tmp_path / "packed.mcap") as log:
        raw = log.raw
        log.raw = lambda topic, schema, encoding, data, *times: raw(
            topic, schema, encoding, pack(data), *times
        )
        for part in (static, drive, scans, frames):
            part(log)
    (tmp_path / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  storage_identifier: mcap\n  compression_format: zstd\n"
        "  compression_mode: MESSAGE\n  relative_file_paths: [packed.mcap]\n"
    )
    packed = open_log(tmp_path, CONFIG)
    np.testing.assert_array_equal(sound(packed), sound(plain))
    np.testing.assert_array_equal(packed.odometry.pose, plain.odometry.pose)
    assert len(list(packed.lasers())) == 20
    assert what(packed) == {}


def test_a_packed_message_that_would_fill_the_memory_is_left_out(log_path):
    import zstandard

    def bomb(log):
        name = "audio_utils_msgs/msg/AudioFrame"
        data = zstandard.ZstdCompressor().compress(bytes(2**27))
        log.raw("/audio", (name, "ros2msg", b""), "cdr", data, START_NS + SECOND)

    log = opened(log_path, static, drive, scans, frames, bomb)
    np.testing.assert_array_equal(sound(log), DATA)
    assert what(log)["damaged audio message"] == 1


def test_a_folder_with_transforms_in_its_first_file_only_is_one_log(tmp_path):
    folder = tmp_path / "bag"
    folder.mkdir()
    written(folder / "bag_0.mcap", static, drive, frames)
    written(folder / "bag_1.mcap", scans)
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  storage_identifier: mcap\n"
        "  relative_file_paths: [bag_0.mcap, bag_1.mcap]\n"
    )
    log = open_log(folder, CONFIG)
    assert len(list(log.lasers())) == 20
    np.testing.assert_array_equal(sound(log), DATA)


@pytest.mark.parametrize("damage", ["cut", "flip"])
def test_a_damaged_log_gives_the_same_in_every_pass(log_path, damage):
    written(log_path, static, drive, scans, frames, chunk_size=20_000)
    content = bytearray(log_path.read_bytes())
    if damage == "cut":
        content = content[: int(0.8 * len(content))]
    else:
        content[len(content) // 2] ^= 1
    log_path.write_bytes(content)
    log = open_log(log_path, CONFIG)
    first = [(b.time_ns, b.samples.tobytes(), b.continues) for b in log.audio()]
    counted = tuple(log.losses)
    assert first == [(b.time_ns, b.samples.tobytes(), b.continues) for b in log.audio()]
    assert tuple(log.losses) == counted
    assert log.losses.data_lost
    assert 0.5 * len(DATA) / BLOCK < len(first) < len(DATA) / BLOCK


def test_a_summary_names_problems_instead_of_failing(log_path):
    summary = log_summary(written(log_path, frames, raw_audio_ros2), CONFIG)
    assert len(summary.problems) == 3
    assert "odometry" in summary.problems[0]
    assert summary.audio is None
    json.dumps(summary.as_dict(), allow_nan=False)
    with pytest.raises(LogError):
        log_summary(log_path.parent / "none.mcap", CONFIG)


def test_a_summary_tells_what_is_there_and_what_is_used(log_path):
    def other(log):
        log.ros2("/chatter", "std_msgs/msg/String", {"data": "hello"}, START_NS)

    summary = log_summary(written(log_path, static, drive, scans, frames, other), CONFIG)
    assert summary.problems == ()
    used = {topic.name: topic.used for topic in summary.topics}
    assert used == {
        "/audio": True,
        "/chatter": False,
        "/odom": True,
        "/scan": True,
        "/tf_static": True,
    }
    assert (summary.audio.channels, summary.audio.rate_hz, summary.audio.stamp) == (4, RATE, "end")
    assert summary.odometry.distance_m == pytest.approx(SPEED * SECONDS, rel=1e-3)
    assert summary.odometry.turn_rad == pytest.approx(SPEED / RADIUS * SECONDS, rel=1e-6)
    assert summary.lasers[0].mount == pytest.approx((0.2, 0.0, 0.3, 0.1))
    assert summary.ready_for == {"map": True, "localize": True, "process": True}
    assert dataclasses.replace(summary) == summary


def test_a_health_check_tells_rates_gaps_jitter_drift_and_levels(log_path):
    def late(log):
        rng = np.random.default_rng(1)
        for i in range(600):
            if not 200 <= i < 220:
                stamp = START_NS + int(i * 0.05 * SECOND + 1e5 * rng.standard_normal())
                # The log's clock is 200 ppm slow against that of the stamps.
                logged = START_NS + int(i * 0.05 * SECOND * (1 - 2e-4)) + 2_000_000
                log.ros2(
                    "/scan", "sensor_msgs/msg/LaserScan", laser_scan(stamp, "laser", RANGES), logged
                )

    summary = log_summary(written(log_path, static, drive, late, frames), CONFIG)
    scan = next(topic for topic in summary.topics if topic.name == "/scan")
    assert (scan.messages, scan.gaps) == (580, 1)
    assert scan.longest_gap_s == pytest.approx(1.05, abs=0.01)
    assert scan.jitter_s == pytest.approx(1.4e-4, rel=0.2)
    assert scan.drift_ppm == pytest.approx(200.0, abs=10.0)
    levels = 10 * np.log10(np.mean((DATA / 2**15) ** 2, axis=0))
    np.testing.assert_allclose(summary.audio.level_db, levels, atol=0.5)
    lost = [loss.data_lost for loss in summary.losses]
    assert lost == sorted(lost, reverse=True)
    json.dumps(summary.as_dict(), allow_nan=False)


# The lab


@needs_lab
def test_odometry_with_nan_poses_follows_the_truth_by_its_twist():
    log = open_log(LAB / "run1.mcap", loaded_config([LAB / "robot.toml"]))
    assert what(log) == {"odometry pose is not finite": 1334}
    truth = np.loadtxt(LAB / "truth" / "run1.tum")
    from soundmap.geometry import composed

    time_ns = np.rint(truth[:, 0] * 1e9).astype(np.int64)
    inside = time_ns <= log.odometry.time_ns[-1]
    start = [truth[0, 1], truth[0, 2], 2 * np.arctan2(truth[0, 6], truth[0, 7])]
    found = composed(start, log.odometry.at(time_ns[inside]))
    # The run is 11.7 m long; where wheels do not slip, wheel odometry is good to one per cent.
    assert np.nanmax(np.hypot(*(found[:, :2] - truth[inside, 1:3]).T)) < 0.12


@needs_lab
def test_a_lab_log_rewritten_in_protobuf_says_the_same(tmp_path):
    names = {"/scan_front": "/front/scan", "/scan_back": "/back/scan"}
    reencoded_as_protobuf(
        LAB / "run3.mcap", tmp_path / "p.mcap", laser_topics=names, odometry_topic="/wheel_odom"
    )
    config = loaded_config([LAB / "robot.toml"])
    ours, other = open_log(LAB / "run3.mcap", config), open_log(tmp_path / "p.mcap", config)
    assert other.scanners == ("/back/scan", "/front/scan")
    for a, b in zip(ours.audio(), other.audio(), strict=True):
        assert abs(a.time_ns - b.time_ns) < 1000
        np.testing.assert_array_equal(a.samples, b.samples)
    for a, b in zip(ours.lasers(), other.lasers(), strict=True):
        assert a.time_ns == b.time_ns
        np.testing.assert_allclose(a.range_m, b.range_m)
        np.testing.assert_allclose(a.bearing_rad, b.bearing_rad, atol=1e-9)


def test_a_longer_log_takes_no_more_memory(log_path):
    import tracemalloc

    written(log_path, static, drive, scans, frames)

    def peak(times):
        path = log_path.with_name(f"{times}.mcap")
        repeated(log_path, path, times, chunk_size=100_000)
        tracemalloc.start()
        log = open_log(path, CONFIG)
        count = sum(1 for _ in log.lasers()) + sum(1 for _ in log.audio())
        used = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return used, count

    peak(1)
    (short, few), (long, many) = peak(5), peak(20)
    assert many == 4 * few
    # The audio of 30 s more alone would be 3.8 MB; what grows is some 100 bytes a message.
    assert long < short + 0.6e6
