"""The shortcut for the most common layouts, against the general decoder."""

import numpy as np
import pytest
from logwriter import (
    ROS2,
    START_NS,
    audio_frame,
    laser_scan,
    made,
    odometry,
    transform,
)

from soundmap.logs import decoders
from soundmap.logs.decoders import Decoders
from soundmap.logs.fixed_layouts import FIXED_LAYOUTS
from soundmap.logs.messages import Form, form_of
from soundmap.logs.records import Channel
from soundmap.logs.schemas import message_type

RANGES = [0.0, 1.5, np.nan, np.inf, 29.0]
SAMPLES = np.arange(12).reshape(3, 4)


def examples(frame, child):
    """A message of every layout with the shortcut, by its form and type."""
    pose = (1.0, -2.0, 0.3)
    edges = [transform(frame, child, (0.1, 0.2, 0.3), yaw=0.4), transform(child, frame, (1, 2, 3))]
    return {
        (Form.AUDIO_FRAME, "audio_utils_msgs/msg/AudioFrame"): audio_frame(
            START_NS + 7, SAMPLES, frame_id=frame, format=f"signed_16{child}"
        ),
        (Form.LASER_SCAN, "sensor_msgs/msg/LaserScan"): laser_scan(
            START_NS + 7, frame, RANGES, time_increment=1e-4, intensities=[1.0, 2.0]
        ),
        (Form.ODOMETRY, "nav_msgs/msg/Odometry"): odometry(
            START_NS + 7, pose, (0.5, 0.1, -0.2), parent=frame, child=child
        ),
        (Form.STAMPED_TRANSFORMS, "tf2_msgs/msg/TFMessage"): {"transforms": edges},
    }


FORMS = list(examples("", ""))


def channel_of(name):
    text = ROS2.generate_msgdef(name, ros_version=2)[0].encode()
    return Channel("/topic", "cdr", name, "ros2msg", text)


def serialized(name, values, **options):
    return bytes(ROS2.serialize_cdr(made(ROS2, name, values), name, **options))


def general_reader(channel, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(decoders, "FIXED_LAYOUTS", {})
        return Decoders().reader(channel)


def outcome(read, data):
    """What a reader makes of a message, comparable; numbers to the bit."""
    try:
        reading = read(memoryview(data))
    except (ValueError, TypeError, AttributeError, OverflowError, IndexError):
        return "damaged"
    if isinstance(reading, list):
        return repr(reading)
    bulk = {name: bytes(getattr(reading, name, b"")) for name in ("data", "ranges")}
    return repr(reading._replace(**{name: 0 for name in bulk if hasattr(reading, name)})), bulk


@pytest.mark.parametrize(("form", "name"), FORMS)
def test_the_shortcut_reads_what_the_general_decoder_reads(form, name, monkeypatch):
    channel = channel_of(name)
    assert message_type(channel).layout == FIXED_LAYOUTS[form][0]
    general, shortcut = general_reader(channel, monkeypatch), FIXED_LAYOUTS[form][1]
    for length in range(10):  # every alignment of what follows the names
        frame, child = "/" + "a" * length, "b" * (3 * length % 10)
        data = serialized(name, examples(frame, child)[form, name])
        assert outcome(shortcut, data) == outcome(general, data) != "damaged"


@pytest.mark.parametrize(("form", "name"), FORMS)
def test_what_is_not_as_expected_is_read_as_if_there_were_no_shortcut(form, name, monkeypatch):
    channel, rng = channel_of(name), np.random.default_rng(5)
    general, read = general_reader(channel, monkeypatch), Decoders().reader(channel)
    whole = serialized(name, examples("laser", "base_link")[form, name])
    damaged = [whole[:end] for end in range(len(whole))]
    damaged += [whole + bytes(more) for more in range(6)]
    for _ in range(2000):
        data = bytearray(whole)
        for place in rng.integers(len(data) if rng.random() < 0.5 else 80, size=2):
            data[place % len(data)] = rng.choice([0, 1, 4, 255, rng.integers(256)])
        damaged.append(bytes(data))
    outcomes = [outcome(general, data) for data in damaged]
    assert [outcome(read, data) for data in damaged] == outcomes
    assert 0 < outcomes.count("damaged") < len(outcomes)
    backward = serialized(name, examples("laser", "base_link")[form, name], little_endian=False)
    assert outcome(read, backward) == outcome(general, backward) != "damaged"


def test_other_layouts_of_a_form_do_without_the_shortcut():
    text = channel_of("nav_msgs/msg/Odometry").schema_data.decode()
    other = text.replace("float64[36] covariance", "float64[] covariance")
    assert other != text
    kind = message_type(Channel("", "cdr", "a/msg/B", "ros2msg", other.encode()))
    assert form_of(kind) is Form.ODOMETRY
    assert kind.layout != FIXED_LAYOUTS[Form.ODOMETRY][0]
