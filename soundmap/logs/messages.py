"""What kind of message a topic carries, told by its fields."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

from soundmap.logs.schemas import MessageType


class Kind(StrEnum):
    """What is measured or told; the names are those that a person reads."""

    AUDIO = "audio"
    AUDIO_INFO = "audio info"
    LASER = "laser"
    ODOMETRY = "odometry"
    TRANSFORMS = "transforms"
    OTHER = "other"


class Form(StrEnum):
    """Which of the known layouts a message has."""

    AUDIO_FRAME = "audio frame"
    RAW_AUDIO = "raw audio"
    AUDIO_DATA_STAMPED = "stamped audio data"
    AUDIO_DATA = "audio data"
    COUNTED_AUDIO = "counted audio"
    AUDIO_INFO = "audio info"
    LASER_SCAN = "laser scan"
    ANGLE_RANGE_SCAN = "laser scan by angles"
    ODOMETRY = "odometry"
    STAMPED_TRANSFORMS = "list of stamped transforms"
    FRAME_TRANSFORM = "frame transform"
    FRAME_TRANSFORMS = "list of frame transforms"
    OTHER = "other"


KINDS = {
    Form.AUDIO_FRAME: Kind.AUDIO,
    Form.RAW_AUDIO: Kind.AUDIO,
    Form.AUDIO_DATA_STAMPED: Kind.AUDIO,
    Form.AUDIO_DATA: Kind.AUDIO,
    Form.COUNTED_AUDIO: Kind.AUDIO,
    Form.AUDIO_INFO: Kind.AUDIO_INFO,
    Form.LASER_SCAN: Kind.LASER,
    Form.ANGLE_RANGE_SCAN: Kind.LASER,
    Form.ODOMETRY: Kind.ODOMETRY,
    Form.STAMPED_TRANSFORMS: Kind.TRANSFORMS,
    Form.FRAME_TRANSFORM: Kind.TRANSFORMS,
    Form.FRAME_TRANSFORMS: Kind.TRANSFORMS,
    Form.OTHER: Kind.OTHER,
}

_FIELDS: tuple[tuple[Form, tuple[str, ...]], ...] = (
    (
        Form.AUDIO_FRAME,
        (
            "header.stamp",
            "format",
            "channel_count",
            "sampling_frequency",
            "frame_sample_count",
            "data",
        ),
    ),
    (
        Form.COUNTED_AUDIO,
        ("header.stamp", "frames", "channels", "sample_rate", "encoding", "layout", "data"),
    ),
    (Form.RAW_AUDIO, ("timestamp", "data", "format", "sample_rate", "number_of_channels")),
    (Form.AUDIO_DATA_STAMPED, ("header.stamp", "audio.data")),
    (Form.AUDIO_INFO, ("channels", "sample_rate", "sample_format", "coding_format")),
    (
        Form.LASER_SCAN,
        ("header.stamp", "header.frame_id", "angle_min", "angle_increment", "range_max", "ranges"),
    ),
    (Form.ANGLE_RANGE_SCAN, ("timestamp", "frame_id", "start_angle", "end_angle", "ranges")),
    (
        Form.ODOMETRY,
        ("header.stamp", "child_frame_id", "pose.pose.orientation.w", "twist.twist.angular.z"),
    ),
    (
        Form.STAMPED_TRANSFORMS,
        (
            "transforms.header.frame_id",
            "transforms.child_frame_id",
            "transforms.transform.rotation.w",
        ),
    ),
    (
        Form.FRAME_TRANSFORMS,
        (
            "transforms.parent_frame_id",
            "transforms.child_frame_id",
            "transforms.rotation.w",
            "transforms.translation.x",
        ),
    ),
    (
        Form.FRAME_TRANSFORM,
        ("timestamp", "parent_frame_id", "child_frame_id", "rotation.w", "translation.x"),
    ),
)


_BYTES = ("uint8[]", "byte[]", "octet[]", "char[]", "int8[]")


def form_of(message: MessageType) -> Form:
    """The layout whose fields a message has.

    A scan must hold its ranges as numbers: echoes in a list of lists are something else. Nothing
    but bytes called ``data`` is audio data, as far as fields can tell.
    """
    for form, fields in _FIELDS:
        if message.has(*fields) and _values_fit(form, message):
            return form
    if set(message.fields) == {"data"} and message.fields["data"] in _BYTES:
        return Form.AUDIO_DATA
    return Form.OTHER


def _values_fit(form: Form, message: MessageType) -> bool:
    if KINDS[form] is Kind.LASER:
        return message.fields["ranges"] in ("float32[]", "float64[]")
    if form is Form.AUDIO_DATA_STAMPED:
        return message.fields["audio.data"] in _BYTES
    if KINDS[form] is Kind.AUDIO:
        return message.fields["data"] in _BYTES
    return True


def ros_stamp_ns(stamp: Any) -> int:
    """A ROS time [ns since epoch]; 0 if it was never set."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def timestamp_ns(stamp: Any) -> int:
    """A protobuf or ROS time [ns since epoch]; 0 if it was never set."""
    if hasattr(stamp, "nanos"):
        return int(stamp.seconds) * 1_000_000_000 + int(stamp.nanos)
    return ros_stamp_ns(stamp)


def frame_name(name: str) -> str:
    """A frame's name without the leading slash that ROS 1 tf put there."""
    return name.removeprefix("/")
