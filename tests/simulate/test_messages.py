"""The simulator's encoder against decoders that are not its own."""

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from soundmap.simulate.messages import (
    DEFINITIONS,
    audio_frame_message,
    laser_message,
    odometry_message,
    raw_audio_message,
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


def test_an_audio_frame_comes_back() -> None:
    samples = np.arange(-30, 30, dtype=np.int16).reshape(20, 3)
    frame = decoded(
        audio_frame_message(STAMP, "mic_array", samples, 48000.0),
        "audio_utils_msgs/msg/AudioFrame",
    )
    assert (frame.format, frame.channel_count, frame.sampling_frequency) == ("signed_16", 3, 48000)
    assert frame.frame_sample_count == 20
    assert np.array_equal(frame.data.view("<i2").reshape(20, 3), samples)


def test_raw_audio_comes_back_by_the_descriptors_in_the_log() -> None:
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(raw_audio_schema()).file:
        pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName("foxglove.RawAudio"))
    samples = np.arange(-300, 300, dtype=np.int16).reshape(200, 3)
    audio = kind.FromString(raw_audio_message(STAMP, samples, 16000.0))
    assert audio.timestamp.seconds * 10**9 + audio.timestamp.nanos == STAMP
    assert (audio.format, audio.sample_rate, audio.number_of_channels) == ("pcm-s16", 16000, 3)
    assert np.array_equal(np.frombuffer(audio.data, "<i2").reshape(200, 3), samples)
