"""Writes logs for tests, with other libraries than the ones that read them where there are any.

Messages are given as nested dictionaries; what is left out is nought or empty. ROS messages are
serialised by rosbags against definitions written here, protobuf ones against descriptors built
here by hand, files are written by the official MCAP writer.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

SECOND = 1_000_000_000
START_NS = 1_700_000_000 * SECOND

HEADER = "std_msgs/Header header\n"
EXTRA_TYPES = {
    "audio_utils_msgs/msg/AudioFrame": HEADER
    + "string format\nuint32 channel_count\nuint32 sampling_frequency\n"
    "uint32 frame_sample_count\nuint8[] data\n",
    "audio_common_msgs/msg/AudioData": "uint8[] data\n",
    "audio_common_msgs/msg/AudioDataStamped": HEADER + "audio_common_msgs/AudioData audio\n",
    "audio_common_msgs/msg/AudioInfo": "uint8 channels\nuint32 sample_rate\n"
    "string sample_format\nuint32 bitrate\nstring coding_format\n",
    "audio_msgs/msg/Audio": HEADER
    + "uint64 seq_num\nuint32 frames\nuint32 channels\nint32 sample_rate\nstring encoding\n"
    "uint8 is_bigendian\nuint8 layout\nuint32 step\nuint8[] data\n",
    "foxglove_msgs/msg/RawAudio": "builtin_interfaces/Time timestamp\nuint8[] data\n"
    "string format\nuint32 sample_rate\nuint32 number_of_channels\n",
    "foxglove_msgs/msg/LaserScan": "builtin_interfaces/Time timestamp\nstring frame_id\n"
    "geometry_msgs/Pose pose\nfloat64 start_angle\nfloat64 end_angle\nfloat64[] ranges\n"
    "float64[] intensities\n",
    "my_robot/msg/WheelOdometry": HEADER
    + "string child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
    "geometry_msgs/TwistWithCovariance twist\n",
}


def _store(ros: Stores) -> Any:
    store = get_typestore(ros)
    for name, text in EXTRA_TYPES.items():
        if name not in store.fielddefs:
            store.register(get_types_from_msg(text, name))
    return store


ROS2 = _store(Stores.ROS2_HUMBLE)
ROS1 = _store(Stores.ROS1_NOETIC)


def time_of(stamp_ns: int) -> dict[str, int]:
    return {"sec": stamp_ns // SECOND, "nanosec": stamp_ns % SECOND}


def made(store: Any, name: str, values: Mapping[str, Any]) -> Any:
    """A ROS message from nested dictionaries."""
    fields = {}
    for field, kind in store.fielddefs[name][1]:
        fields[field] = _made_field(store, kind, values.get(field))
    unknown = set(values) - set(fields)
    assert not unknown, f"{name} has no {unknown}"
    return store.types[name](**fields)


def _made_field(store: Any, kind: Any, value: Any) -> Any:
    if kind[0] == Nodetype.NAME:
        return made(store, kind[1], value or {})
    if kind[0] == Nodetype.BASE:
        return value if value is not None else ("" if kind[1][0] == "string" else 0)
    element = kind[1][0]
    if element[0] == Nodetype.NAME:
        return [made(store, element[1], item) for item in value or []]
    dtype = {"byte": "uint8", "char": "uint8", "octet": "uint8"}.get(element[1][0], element[1][0])
    if value is None:
        value = np.zeros(kind[1][1] if kind[0] == Nodetype.ARRAY else 0)
    if isinstance(value, bytes):
        return np.frombuffer(value, dtype=np.uint8)
    return np.asarray(value, dtype=dtype)


# Protocol Buffers

_P = descriptor_pb2.FieldDescriptorProto
_PROTO_KINDS = {
    "double": _P.TYPE_DOUBLE,
    "string": _P.TYPE_STRING,
    "bytes": _P.TYPE_BYTES,
    "fixed32": _P.TYPE_FIXED32,
}
_PROTO = {
    "foxglove.Vector3": ("x double", "y double", "z double"),
    "foxglove.Quaternion": ("x double", "y double", "z double", "w double"),
    "foxglove.Pose": ("position foxglove.Vector3", "orientation foxglove.Quaternion"),
    "foxglove.RawAudio": (
        "timestamp google.protobuf.Timestamp",
        "data bytes",
        "format string",
        "sample_rate fixed32",
        "number_of_channels fixed32",
    ),
    "foxglove.LaserScan": (
        "timestamp google.protobuf.Timestamp",
        "frame_id string",
        "pose foxglove.Pose",
        "start_angle double",
        "end_angle double",
        "*ranges double",
        "*intensities double",
    ),
    "foxglove.FrameTransform": (
        "timestamp google.protobuf.Timestamp",
        "parent_frame_id string",
        "child_frame_id string",
        "translation foxglove.Vector3",
        "rotation foxglove.Quaternion",
    ),
    "foxglove.FrameTransforms": ("*transforms foxglove.FrameTransform",),
}


def _proto_file() -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto(
        name="test.proto", package="foxglove", syntax="proto3"
    )
    file.dependency.append("google/protobuf/timestamp.proto")
    for name, fields in _PROTO.items():
        message = file.message_type.add(name=name.partition(".")[2])
        for number, entry in enumerate(fields, start=1):
            field_name, kind = entry.lstrip("*").split()
            label = _P.LABEL_REPEATED if entry.startswith("*") else _P.LABEL_OPTIONAL
            field = message.field.add(name=field_name, number=number, label=label)
            if kind in _PROTO_KINDS:
                field.type = _PROTO_KINDS[kind]
            else:
                field.type, field.type_name = _P.TYPE_MESSAGE, f".{kind}"
    return file


def _proto_classes() -> tuple[bytes, dict[str, Any]]:
    stamp_file = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp_file)
    files = descriptor_pb2.FileDescriptorSet(file=[stamp_file, _proto_file()])
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.AddSerializedFile(file.SerializeToString())
    classes = {
        name: message_factory.GetMessageClass(pool.FindMessageTypeByName(name)) for name in _PROTO
    }
    return files.SerializeToString(), classes


PROTO_SCHEMA, PROTO_CLASSES = _proto_classes()


class LogWriter(AbstractContextManager["LogWriter"]):
    """An MCAP file in the making; options are those of ``mcap.writer.Writer``."""

    def __init__(self, path: Path, *, profile: str = "ros2", **options: Any) -> None:
        self.path = path
        options.setdefault("compression", CompressionType.ZSTD)
        self._file = path.open("wb")
        self._writer = Writer(self._file, **options)
        self._writer.start(profile=profile)
        self._schemas: dict[Any, int] = {}
        self._channels: dict[Any, int] = {}

    def __exit__(self, *_: object) -> None:
        self._writer.finish()
        self._file.close()

    def raw(
        self,
        topic: str,
        schema: tuple[str, str, bytes],
        encoding: str,
        data: bytes,
        log_time_ns: int,
        publish_time_ns: int | None = None,
    ) -> None:
        """Write a serialised message; ``schema`` is name, encoding, definition."""
        if schema not in self._schemas:
            self._schemas[schema] = self._writer.register_schema(*schema)
        key = (topic, encoding, self._schemas[schema])
        if key not in self._channels:
            self._channels[key] = self._writer.register_channel(*key)
        published = log_time_ns if publish_time_ns is None else publish_time_ns
        self._writer.add_message(self._channels[key], log_time_ns, data, published)

    def ros2(
        self,
        topic: str,
        name: str,
        values: Mapping[str, Any],
        log_time_ns: int,
        *,
        definition: bool = True,
        big_endian: bool = False,
    ) -> None:
        """Write a ROS 2 message, with or without the definition of its type."""
        message = made(ROS2, name, values)
        data = bytes(ROS2.serialize_cdr(message, name, little_endian=not big_endian))
        text = ROS2.generate_msgdef(name, ros_version=2)[0] if definition else ""
        self.raw(topic, (name, "ros2msg", text.encode()), "cdr", data, log_time_ns)

    def ros1(self, topic: str, name: str, values: Mapping[str, Any], log_time_ns: int) -> None:
        """Write a ROS 1 message."""
        data = bytes(ROS1.serialize_ros1(made(ROS1, name, values), name))
        text = ROS1.generate_msgdef(name, ros_version=1)[0]
        self.raw(
            topic, (name.replace("/msg/", "/"), "ros1msg", text.encode()), "ros1", data, log_time_ns
        )

    def protobuf(self, topic: str, name: str, values: Mapping[str, Any], log_time_ns: int) -> None:
        """Write a protobuf message; times are given as ``stamped`` makes them."""
        data = PROTO_CLASSES[name](**values).SerializeToString()
        self.raw(topic, (name, "protobuf", PROTO_SCHEMA), "protobuf", data, log_time_ns)


def stamped(stamp_ns: int) -> dict[str, int]:
    """A protobuf timestamp."""
    return {"seconds": stamp_ns // SECOND, "nanos": stamp_ns % SECOND}


def header(stamp_ns: int, frame_id: str) -> dict[str, Any]:
    return {"stamp": time_of(stamp_ns), "frame_id": frame_id}


def xyz(values: Iterable[float]) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


def quaternion(yaw: float = 0.0, roll: float = 0.0) -> dict[str, float]:
    """Rotation about x by roll, then about z by yaw."""
    cy, sy, cr, sr = np.cos(yaw / 2), np.sin(yaw / 2), np.cos(roll / 2), np.sin(roll / 2)
    return {"x": cy * sr, "y": sy * sr, "z": sy * cr, "w": cy * cr}


def transform(
    parent: str,
    child: str,
    translation: Iterable[float],
    *,
    yaw: float = 0.0,
    roll: float = 0.0,
    stamp_ns: int = START_NS,
) -> dict[str, Any]:
    """One element of a TFMessage."""
    return {
        "header": header(stamp_ns, parent),
        "child_frame_id": child,
        "transform": {"translation": xyz(translation), "rotation": quaternion(yaw, roll)},
    }


def odometry(
    stamp_ns: int,
    pose: tuple[float, float, float],
    twist: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    parent: str = "odom",
    child: str = "base_link",
) -> dict[str, Any]:
    """A nav_msgs/Odometry: x, y, heading and vx, vy, turn rate."""
    rotation = quaternion(pose[2])
    return {
        "header": header(stamp_ns, parent),
        "child_frame_id": child,
        "pose": {"pose": {"position": xyz((pose[0], pose[1], 0.0)), "orientation": rotation}},
        "twist": {
            "twist": {"linear": xyz((twist[0], twist[1], 0.0)), "angular": xyz((0, 0, twist[2]))}
        },
    }


def laser_scan(stamp_ns: int, frame_id: str, ranges: Any, **fields: float) -> dict[str, Any]:
    """A sensor_msgs/LaserScan over 270 degrees unless ``fields`` say otherwise."""
    count = max(len(ranges) - 1, 1)
    values: dict[str, Any] = {
        "angle_min": -2.356,
        "angle_max": 2.356,
        "angle_increment": 4.712 / count,
        "time_increment": 0.0,
        "range_min": 0.1,
        "range_max": 30.0,
    }
    return values | fields | {"header": header(stamp_ns, frame_id), "ranges": ranges}


def audio_frame(
    stamp_ns: int, samples: Any, rate_hz: int = 16000, *, frame_id: str = "mic_array", **over: Any
) -> dict[str, Any]:
    """An audio_utils AudioFrame of 16-bit samples, shape (frames, channels); stamp = end."""
    values = {
        "header": header(stamp_ns, frame_id),
        "format": "signed_16",
        "channel_count": samples.shape[1],
        "sampling_frequency": rate_hz,
        "frame_sample_count": len(samples),
        "data": np.ascontiguousarray(samples, dtype="<i2").tobytes(),
    }
    return values | over


# Existing logs rewritten


def _messages(src: Path) -> Iterable[tuple[Any, Any, Any]]:
    with src.open("rb") as stream:
        yield from make_reader(stream).iter_messages()


def _ros2_reader(schema: Any, stores: dict[str, Any]) -> Any:
    if schema.name not in stores:
        store = get_typestore(Stores.EMPTY)
        types = get_types_from_msg(schema.data.decode(), schema.name)
        store.register({n: d for n, d in types.items() if n not in store.fielddefs})
        stores[schema.name] = store
    return stores[schema.name]


def reencoded_as_protobuf(
    src: Path,
    dst: Path,
    *,
    audio_topic: str = "/mics",
    laser_topics: Mapping[str, str] | None = None,
    odometry_topic: str | None = None,
    lasers_as_protobuf: bool = True,
) -> None:
    """Rewrite a ROS 2 log with AudioFrame and LaserScan messages.

    Audio becomes protobuf ``foxglove.RawAudio`` with the stamp of the block's start, scans become
    ``foxglove.LaserScan`` or stay as they are, under the topic names given.
    """
    stores: dict[str, Any] = {}
    names = dict(laser_topics or {})
    with LogWriter(dst) as log:
        for schema, channel, message in _messages(src):
            time, kind = message.log_time, schema.name.rpartition("/")[2]
            topic = names.get(channel.topic, channel.topic)
            if kind == "Odometry" and odometry_topic is not None:
                topic = odometry_topic
            if kind == "AudioFrame":
                m = _ros2_reader(schema, stores).deserialize_cdr(message.data, schema.name)
                log.protobuf(audio_topic, "foxglove.RawAudio", _as_raw_audio(m), time)
            elif kind == "LaserScan" and lasers_as_protobuf:
                m = _ros2_reader(schema, stores).deserialize_cdr(message.data, schema.name)
                log.protobuf(topic, "foxglove.LaserScan", _as_angle_range_scan(m), time)
            else:
                definition = (schema.name, schema.encoding, schema.data)
                log.raw(topic, definition, channel.message_encoding, message.data, time)


def _stamp_ns(stamp: Any) -> int:
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def _as_raw_audio(message: Any) -> dict[str, Any]:
    assert message.format == "signed_16"
    length_ns = round(message.frame_sample_count / message.sampling_frequency * SECOND)
    return {
        "timestamp": stamped(_stamp_ns(message.header.stamp) - length_ns),
        "data": message.data.tobytes(),
        "format": "pcm-s16",
        "sample_rate": message.sampling_frequency,
        "number_of_channels": message.channel_count,
    }


def _as_angle_range_scan(message: Any) -> dict[str, Any]:
    last = message.angle_min + (len(message.ranges) - 1) * message.angle_increment
    ranges = np.where(message.ranges < message.range_max, message.ranges, np.inf)
    return {
        "timestamp": stamped(_stamp_ns(message.header.stamp)),
        "frame_id": message.header.frame_id,
        "pose": {"orientation": {"w": 1.0}},
        "start_angle": message.angle_min,
        "end_angle": last,
        "ranges": ranges.astype(float).tolist(),
    }


def repeated(src: Path, dst: Path, times: int, **options: Any) -> None:
    """Rewrite a ROS 2 log so that it is ``times`` as long: its content again and again, later.

    The robot jumps back to its start at every repetition.
    """
    stores: dict[str, Any] = {}
    with src.open("rb") as stream:
        statistics = make_reader(stream).get_summary().statistics
    # Whole blocks of 10 ms, so that audio goes on without a gap where its length allows it.
    period = -(-(statistics.message_end_time - statistics.message_start_time) // 10**7) * 10**7
    with LogWriter(dst, **options) as log:
        for turn in range(times):
            shift = turn * period
            for schema, channel, message in _messages(src):
                store = _ros2_reader(schema, stores)
                decoded = store.deserialize_cdr(message.data, schema.name)
                if turn and channel.topic == "/tf_static":
                    continue
                _shift(decoded, shift)
                log.raw(
                    channel.topic,
                    (schema.name, schema.encoding, schema.data),
                    channel.message_encoding,
                    bytes(store.serialize_cdr(decoded, schema.name)),
                    message.log_time + shift,
                    message.publish_time + shift,
                )


def _shift(message: Any, by_ns: int) -> None:
    """Move all header stamps of a message."""
    for part in getattr(message, "transforms", [message]):
        if hasattr(part, "header"):
            stamp = part.header.stamp
            later = _stamp_ns(stamp) + by_ns
            stamp.sec, stamp.nanosec = later // SECOND, later % SECOND
