"""The simulator's encoder against decoders that are not its own."""

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from soundmap.simulate.messages import (
    DEFINITIONS,
    audio_info_message,
    audio_message,
    laser_message,
    odometry_message,
    raw_audio_schema,
    transform_message,
)

STAMP = 1_700_000_012_345_678_901


def decoded(data: bytes, name: str) -> object:
    """A message decoded by rosbags after the definition that goes into the log."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(DEFINITIONS[name], name))
    return store.deserialize_cdr(data, name)


@pytest.mark.parametrize("frame", ["l", "la", "las", "lase", "laser"])
def test_a_laser_scan_comes_back_whatever_the_alignment(frame: str) -> None:
    bearing, ranges = np.linspace(-1.0, 1.0, 5), np.array([1.0, 2.5, np.inf, 0.25, 30.0])
    data = laser_message(
        STAMP,
        frame,
        bearing,
        ranges,
        ray_interval_s=1e-5,
        scan_interval_s=0.025,
        range_min_m=0.1,
        range_max_m=30.0,
    )
    scan = decoded(data, "sensor_msgs/msg/LaserScan")
    assert (scan.header.stamp.sec, scan.header.stamp.nanosec) == divmod(STAMP, 10**9)
    assert scan.header.frame_id == frame
    assert scan.ranges.tolist() == ranges.tolist()
    assert (scan.angle_min, scan.angle_max) == pytest.approx((-1.0, 1.0))
    assert scan.angle_increment == pytest.approx(0.5)
    assert (scan.time_increment, scan.scan_time) == pytest.approx((1e-5, 0.025))
    assert len(scan.intensities) == 0


def test_odometry_comes_back() -> None:
    data = odometry_message(STAMP, "odom", "base", np.array([1.5, -2.0, 0.7]), np.array([0.4, 0.1]))
    said = decoded(data, "nav_msgs/msg/Odometry")
    pose, twist = said.pose.pose, said.twist.twist
    assert (pose.position.x, pose.position.y) == (1.5, -2.0)
    assert 2 * np.arctan2(pose.orientation.z, pose.orientation.w) == pytest.approx(0.7)
    assert (twist.linear.x, twist.angular.z) == (0.4, 0.1)
    assert said.pose.covariance[[0, 1, 7]].tolist() == [1e-3, 0.0, 1e-3]


def test_transforms_come_back() -> None:
    places = [
        (STAMP, "base", "laser", (0.1, 0.2, 0.3, np.pi)),
        (STAMP, "base", "mic", (0, 0, 1, 0)),
    ]
    first, second = decoded(transform_message(places), "tf2_msgs/msg/TFMessage").transforms
    assert (first.child_frame_id, second.child_frame_id) == ("laser", "mic")
    assert first.transform.rotation.z == pytest.approx(1.0)
    assert (second.header.frame_id, second.transform.translation.z) == ("base", 1.0)


SAMPLES = np.arange(-300, 300, dtype=np.int16).reshape(200, 3)


def encoded(schema: str) -> bytes:
    return audio_message(schema, STAMP, "mic_array", SAMPLES, rate_hz=48000.0, first_frame=960)


def samples_in(data: np.ndarray) -> np.ndarray:
    return np.frombuffer(bytes(data), "<i2").reshape(-1, 3)


def test_an_audio_frame_comes_back() -> None:
    name = "audio_utils_msgs/msg/AudioFrame"
    frame = decoded(encoded(name), name)
    assert (frame.format, frame.channel_count, frame.sampling_frequency) == ("signed_16", 3, 48000)
    assert (frame.frame_sample_count, frame.header.frame_id) == (200, "mic_array")
    assert np.array_equal(samples_in(frame.data), SAMPLES)


def test_audio_of_the_gstreamer_bridge_comes_back() -> None:
    name = "audio_msgs/msg/Audio"
    audio = decoded(encoded(name), name)
    assert (audio.seq_num, audio.frames, audio.channels, audio.sample_rate) == (960, 200, 3, 48000)
    assert (audio.encoding, audio.is_bigendian, audio.layout) == ("S16LE", 0, 0)
    assert np.array_equal(samples_in(audio.data), SAMPLES)


def test_stamped_audio_data_and_its_info_come_back() -> None:
    name = "audio_common_msgs/msg/AudioDataStamped"
    audio = decoded(encoded(name), name)
    assert (audio.header.stamp.sec, audio.header.stamp.nanosec) == divmod(STAMP, 10**9)
    assert np.array_equal(samples_in(audio.audio.data), SAMPLES)
    info = decoded(audio_info_message(3, 48000.0), "audio_common_msgs/msg/AudioInfo")
    assert (info.channels, info.sample_rate, info.sample_format) == (3, 48000, "S16LE")
    assert (info.bitrate, info.coding_format) == (2_304_000, "WAVE")


def test_raw_audio_of_ros_comes_back() -> None:
    name = "foxglove_msgs/msg/RawAudio"
    audio = decoded(encoded(name), name)
    assert (audio.timestamp.sec, audio.timestamp.nanosec) == divmod(STAMP, 10**9)
    assert (audio.format, audio.sample_rate, audio.number_of_channels) == ("pcm-s16", 48000, 3)
    assert np.array_equal(samples_in(audio.data), SAMPLES)


def test_raw_audio_comes_back_by_the_descriptors_in_the_log() -> None:
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(raw_audio_schema()).file:
        pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName("foxglove.RawAudio"))
    audio = kind.FromString(encoded("foxglove.RawAudio"))
    assert audio.timestamp.seconds * 10**9 + audio.timestamp.nanos == STAMP
    assert (audio.format, audio.sample_rate, audio.number_of_channels) == ("pcm-s16", 48000, 3)
    assert np.array_equal(samples_in(audio.data), SAMPLES)
