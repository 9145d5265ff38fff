"""Messages as a ROS 2 robot writes them: definitions and an encoder that is the simulator's own.

CDR: little-endian, every value aligned to its own size counted from the fifth byte, strings with
length and a closing zero byte, arrays of variable length with their length in front.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray

_TIME = "builtin_interfaces/Time stamp"
_HEADER = f"MSG: std_msgs/Header\n{_TIME}\nstring frame_id"
_VECTOR3 = "MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z"
_POINT = "MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z"
_QUATERNION = "MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w"
_CLOCK = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec"
_RULE = "\n" + "=" * 80 + "\n"

DEFINITIONS: dict[str, str] = {
    "sensor_msgs/msg/LaserScan": _RULE.join(
        [
            "std_msgs/Header header\nfloat32 angle_min\nfloat32 angle_max\n"
            "float32 angle_increment\nfloat32 time_increment\nfloat32 scan_time\n"
            "float32 range_min\nfloat32 range_max\nfloat32[] ranges\nfloat32[] intensities",
            _HEADER,
            _CLOCK,
        ]
    ),
    "nav_msgs/msg/Odometry": _RULE.join(
        [
            "std_msgs/Header header\nstring child_frame_id\n"
            "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist",
            _HEADER,
            _CLOCK,
            "MSG: geometry_msgs/PoseWithCovariance\ngeometry_msgs/Pose pose\n"
            "float64[36] covariance",
            "MSG: geometry_msgs/Pose\ngeometry_msgs/Point position\n"
            "geometry_msgs/Quaternion orientation",
            _POINT,
            _QUATERNION,
            "MSG: geometry_msgs/TwistWithCovariance\ngeometry_msgs/Twist twist\n"
            "float64[36] covariance",
            "MSG: geometry_msgs/Twist\ngeometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
            _VECTOR3,
        ]
    ),
    "tf2_msgs/msg/TFMessage": _RULE.join(
        [
            "geometry_msgs/TransformStamped[] transforms",
            "MSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\n"
            "string child_frame_id\ngeometry_msgs/Transform transform",
            _HEADER,
            _CLOCK,
            "MSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\n"
            "geometry_msgs/Quaternion rotation",
            _VECTOR3,
            _QUATERNION,
        ]
    ),
    "audio_utils_msgs/msg/AudioFrame": _RULE.join(
        [
            "std_msgs/Header header\nstring format\nuint32 channel_count\n"
            "uint32 sampling_frequency\nuint32 frame_sample_count\nuint8[] data",
            _HEADER,
            _CLOCK,
        ]
    ),
    "audio_common_msgs/msg/AudioDataStamped": _RULE.join(
        [
            "std_msgs/Header header\naudio_common_msgs/AudioData audio",
            _HEADER,
            _CLOCK,
            "MSG: audio_common_msgs/AudioData\nuint8[] data",
        ]
    ),
    "audio_common_msgs/msg/AudioInfo": "uint8 channels\nuint32 sample_rate\n"
    "string sample_format\nuint32 bitrate\nstring coding_format",
    "audio_msgs/msg/Audio": _RULE.join(
        [
            "std_msgs/Header header\nuint64 seq_num\nuint32 frames\nuint32 channels\n"
            "int32 sample_rate\nstring encoding\nuint8 is_bigendian\nuint8 layout\n"
            "uint32 step\nuint8[] data",
            _HEADER,
            _CLOCK,
        ]
    ),
    "foxglove_msgs/msg/RawAudio": _RULE.join(
        [
            "builtin_interfaces/Time timestamp\nuint8[] data\nstring format\n"
            "uint32 sample_rate\nuint32 number_of_channels",
            _CLOCK,
        ]
    ),
}
"""ROS 2 message definitions, as recorded beside the messages."""


class CdrWriter:
    """One message in the making."""

    def __init__(self) -> None:
        self._bytes = bytearray(b"\x00\x01\x00\x00")

    def value(self, code: str, *values: float) -> CdrWriter:
        """Append numbers of one type; ``code`` is that of `struct`."""
        packing = struct.Struct("<" + code)
        for value in values:
            self._align(packing.size)
            self._bytes += packing.pack(value)
        return self

    def string(self, text: str) -> CdrWriter:
        """Append a string."""
        encoded = text.encode() + b"\x00"
        self.value("I", len(encoded))
        self._bytes += encoded
        return self

    def array(self, values: NDArray[np.generic]) -> CdrWriter:
        """Append an array of variable length."""
        self.value("I", values.size)
        if values.size:
            self._align(values.itemsize)
            self._bytes += values.tobytes()
        return self

    def header(self, stamp_ns: int, frame: str) -> CdrWriter:
        """Append a std_msgs/Header."""
        return self.time(stamp_ns).string(frame)

    def time(self, stamp_ns: int) -> CdrWriter:
        """Append a builtin_interfaces/Time."""
        return self.value("i", stamp_ns // 1_000_000_000).value("I", stamp_ns % 1_000_000_000)

    def quaternion(self, yaw_rad: float) -> CdrWriter:
        """Append a rotation about the vertical."""
        return self.value("d", 0.0, 0.0, np.sin(0.5 * yaw_rad), np.cos(0.5 * yaw_rad))

    def done(self) -> bytes:
        """The message."""
        return bytes(self._bytes)

    def _align(self, size: int) -> None:
        self._bytes += b"\x00" * (-(len(self._bytes) - 4) % size)


def laser_message(
    stamp_ns: int,
    frame: str,
    bearing_rad: FloatArray,
    range_m: FloatArray,
    *,
    ray_interval_s: float,
    scan_interval_s: float,
    range_min_m: float,
    range_max_m: float,
) -> bytes:
    """A sensor_msgs/LaserScan without intensities."""
    writer = CdrWriter().header(stamp_ns, frame)
    increment = (bearing_rad[-1] - bearing_rad[0]) / max(len(bearing_rad) - 1, 1)
    writer.value("f", bearing_rad[0], bearing_rad[-1], increment, ray_interval_s)
    writer.value("f", scan_interval_s, range_min_m, range_max_m)
    return writer.array(range_m.astype("<f4")).array(np.zeros(0, dtype="<f4")).done()


def odometry_message(
    stamp_ns: int, frame: str, base_frame: str, pose: FloatArray, twist: FloatArray
) -> bytes:
    """A nav_msgs/Odometry: pose (3,) in ``frame``, forward speed and turn rate (2,)."""
    writer = CdrWriter().header(stamp_ns, frame).string(base_frame)
    writer.value("d", pose[0], pose[1], 0.0).quaternion(float(pose[2]))
    writer.value("d", *_diagonal(1e-3))
    writer.value("d", twist[0], 0.0, 0.0, 0.0, 0.0, twist[1])
    return writer.value("d", *_diagonal(1e-3)).done()


def transform_message(
    transforms: Sequence[tuple[int, str, str, tuple[float, float, float, float]]],
) -> bytes:
    """A tf2_msgs/TFMessage of (stamp [ns], parent, child, (x, y, z, yaw))."""
    writer = CdrWriter().value("I", len(transforms))
    for stamp_ns, parent, child, (x, y, z, yaw) in transforms:
        writer.header(stamp_ns, parent).string(child).value("d", x, y, z).quaternion(yaw)
    return writer.done()


def audio_message(
    schema: str,
    stamp_ns: int,
    frame: str,
    samples: NDArray[np.int16],
    *,
    rate_hz: float,
    first_frame: int,
) -> bytes:
    """Samples (frames, channels) as a message of one of the audio schemas, interleaved.

    ``first_frame`` counts the frames before these, for the schema that tells it.
    """
    rate, (frames, channels) = round(rate_hz), samples.shape
    if schema == "foxglove.RawAudio":
        return _protobuf_raw_audio(stamp_ns, samples, rate)
    data = samples.astype("<i2").reshape(-1).view(np.uint8)
    writer = CdrWriter()
    if schema == "foxglove_msgs/msg/RawAudio":
        writer.time(stamp_ns).array(data).string("pcm-s16")
        return writer.value("I", rate, channels).done()
    writer.header(stamp_ns, frame)
    if schema == "audio_utils_msgs/msg/AudioFrame":
        writer.string("signed_16").value("I", channels, rate, frames)
    elif schema == "audio_msgs/msg/Audio":
        writer.value("Q", first_frame).value("I", frames, channels).value("i", rate)
        writer.string("S16LE").value("B", 0, 0).value("I", 2 * channels)
    return writer.array(data).done()


def audio_info_message(channels: int, rate_hz: float) -> bytes:
    """An audio_common_msgs/AudioInfo: what AudioDataStamped leaves out."""
    rate = round(rate_hz)
    writer = CdrWriter().value("B", channels).value("I", rate).string("S16LE")
    return writer.value("I", rate * channels * 16).string("WAVE").done()


def _protobuf_raw_audio(stamp_ns: int, samples: NDArray[np.int16], rate: int) -> bytes:
    """A protobuf foxglove.RawAudio of samples (frames, channels), interleaved."""
    seconds, nanos = divmod(stamp_ns, 1_000_000_000)
    clock = b"\x08" + _varint(seconds) + b"\x10" + _varint(nanos)
    data = samples.astype("<i2").tobytes()
    return b"".join(
        [
            b"\x0a" + _varint(len(clock)) + clock,
            b"\x12" + _varint(len(data)) + data,
            b"\x1a" + _varint(7) + b"pcm-s16",
            b"\x25" + struct.pack("<I", rate),
            b"\x2d" + struct.pack("<I", samples.shape[1]),
        ]
    )


@cache
def raw_audio_schema() -> bytes:
    """Descriptors of foxglove.RawAudio and of what it needs, as MCAP stores them."""
    from google.protobuf import descriptor_pb2, timestamp_pb2

    field = descriptor_pb2.FieldDescriptorProto
    described = descriptor_pb2.FileDescriptorSet()
    timestamp_pb2.DESCRIPTOR.CopyToProto(described.file.add())
    file = described.file.add()
    file.name, file.package, file.syntax = "foxglove/RawAudio.proto", "foxglove", "proto3"
    file.dependency.append("google/protobuf/timestamp.proto")
    message = file.message_type.add()
    message.name = "RawAudio"
    kinds = [
        ("timestamp", field.TYPE_MESSAGE),
        ("data", field.TYPE_BYTES),
        ("format", field.TYPE_STRING),
        ("sample_rate", field.TYPE_FIXED32),
        ("number_of_channels", field.TYPE_FIXED32),
    ]
    for number, (name, kind) in enumerate(kinds, start=1):
        entry = message.field.add()
        entry.name, entry.number, entry.type, entry.label = name, number, kind, 1
        if kind == field.TYPE_MESSAGE:
            entry.type_name = ".google.protobuf.Timestamp"
    return described.SerializeToString()


def _varint(value: int) -> bytes:
    parts = bytearray()
    while value > 0x7F:
        parts.append(value & 0x7F | 0x80)
        value >>= 7
    parts.append(value)
    return bytes(parts)


def _diagonal(variance: float) -> list[float]:
    return (variance * np.eye(6)).reshape(-1).tolist()
