"""What a schema stored in a log says: the fields of its messages, and how to decode them.

Nothing is assumed about type names. Fields are given as dotted paths with the type at the end,
``header.stamp.sec`` -> ``int32``, ``transforms.child_frame_id`` -> ``string``, whatever the
language of the definition, so that messages can be recognised by what they contain.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from soundmap.logs.records import Channel

MAX_MESSAGE_BYTES = 64 * 2**20
"""A packed message that would expand to more than this is taken for damaged."""

_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

MAX_DEPTH = 8
"""Definitions may refer to themselves; fields nested deeper than this are not looked at."""

Decoder = Callable[[memoryview], Any]


class SchemaError(ValueError):
    """The definition cannot be used; the message says why in a few words."""


class MessageError(ValueError):
    """One message does not fit its definition."""


@dataclass(frozen=True)
class MessageType:
    """Fields of a type and how to decode its messages.

    Attributes
    ----------
    fields : mapping of str to str
        Dotted path to the type of the value there, with ``[]`` behind it for a list.
    decoder : callable
        Makes the function that turns bytes into an object with these attributes. It raises
        ``MessageError`` for a damaged message.
    built_in : bool
        The log holds no definition; a well-known one of that name is used.
    layout : tuple of str
        What a CDR message is made of, in order: path and type of every number and string, and of
        every list of them, with its length if that is fixed. A list of structures is followed by
        what one of them is made of. Empty for other encodings.
    """

    fields: Mapping[str, str]
    decoder: Callable[[], Decoder]
    built_in: bool = False
    layout: tuple[str, ...] = ()

    def has(self, *paths: str) -> bool:
        """Whether all these fields are there."""
        return all(path in self.fields for path in paths)


def message_type(channel: Channel) -> MessageType:
    """Fields and decoder of the messages of a channel.

    Raises
    ------
    SchemaError
        The encoding is unknown or the definition is damaged.
    """
    if channel.encoding == "protobuf" or channel.schema_encoding == "protobuf":
        return _protobuf_type(channel)
    if channel.encoding in ("cdr", "ros1"):
        return _ros_type(channel)
    raise SchemaError(f"messages encoded as {channel.encoding or 'nothing'!r} cannot be read")


# ROS 1 and ROS 2

_STAMPED = "std_msgs/Header header\n"
_WELL_KNOWN = {
    "audio_utils_msgs/msg/AudioFrame": _STAMPED
    + "string format\nuint32 channel_count\nuint32 sampling_frequency\n"
    "uint32 frame_sample_count\nuint8[] data\n",
    "audio_common_msgs/msg/AudioData": "uint8[] data\n",
    "audio_common_msgs/msg/AudioDataStamped": _STAMPED + "audio_common_msgs/AudioData audio\n",
    "audio_common_msgs/msg/AudioInfo": "uint8 channels\nuint32 sample_rate\n"
    "string sample_format\nuint32 bitrate\nstring coding_format\n",
    "audio_msgs/msg/Audio": _STAMPED
    + "uint64 seq_num\nuint32 frames\nuint32 channels\nint32 sample_rate\nstring encoding\n"
    "uint8 is_bigendian\nuint8 layout\nuint32 step\nuint8[] data\n",
    "foxglove_msgs/msg/RawAudio": "builtin_interfaces/Time timestamp\nuint8[] data\n"
    "string format\nuint32 sample_rate\nuint32 number_of_channels\n",
    "foxglove_msgs/msg/LaserScan": "builtin_interfaces/Time timestamp\nstring frame_id\n"
    "geometry_msgs/Pose pose\nfloat64 start_angle\nfloat64 end_angle\nfloat64[] ranges\n"
    "float64[] intensities\n",
    "foxglove_msgs/msg/FrameTransform": "builtin_interfaces/Time timestamp\n"
    "string parent_frame_id\nstring child_frame_id\ngeometry_msgs/Vector3 translation\n"
    "geometry_msgs/Quaternion rotation\n",
    "foxglove_msgs/msg/FrameTransforms": "foxglove_msgs/FrameTransform[] transforms\n",
}
"""Definitions that ROS itself does not ship, for logs that leave theirs out."""
_WELL_KNOWN["audio_utils/msg/AudioFrame"] = _WELL_KNOWN["audio_utils_msgs/msg/AudioFrame"]


def _ros_name(name: str) -> str:
    """``pkg/Type`` as ``pkg/msg/Type``."""
    parts = name.replace("::", "/").split("/")
    return f"{parts[0]}/msg/{parts[-1]}" if len(parts) in (2, 3) else name


def _ros_type(channel: Channel) -> MessageType:
    name = _ros_name(channel.schema_name)
    ros1 = channel.encoding == "ros1"
    definitions, built_in = _ros_definitions(channel, name), not channel.schema_data.strip()
    _complete(definitions, name, ros1=ros1)
    fields = dict(_ros_fields(definitions, name, "", 0))

    def decoder() -> Decoder:
        from rosbags.serde import SerdeError
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.EMPTY)
        store.register({n: d for n, d in definitions.items() if n not in store.fielddefs})
        decode = store.deserialize_ros1 if ros1 else store.deserialize_cdr

        def decoded(data: memoryview) -> Any:
            try:
                return decode(data if ros1 else _unpacked(data), name)
            except (SerdeError, ValueError, IndexError, MemoryError) as error:
                raise MessageError(str(error)) from None

        return decoded

    layout = () if ros1 else tuple(_layout(definitions, name, "", 0))
    return MessageType(fields, decoder, built_in, layout)


def _unpacked(data: memoryview) -> memoryview:
    """A CDR message, which rosbag2 can compress by itself; the log does not say so."""
    if data[:4] != _ZSTD_MAGIC:
        return data
    import zstandard

    try:
        packed = zstandard.ZstdDecompressor()
        return memoryview(packed.decompress(data, max_output_size=MAX_MESSAGE_BYTES))
    except zstandard.ZstdError as error:
        raise MessageError(str(error)) from None


def _ros_definitions(channel: Channel, name: str) -> dict[str, Any]:
    """Types by name, as the log defines them."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    text = channel.schema_data.decode("utf-8", errors="replace")
    if not text.strip():
        return {}
    try:
        if channel.schema_encoding == "ros2idl":
            # The parser knows no preprocessor; what is included is in the text as well.
            text = "\n".join(line for line in text.splitlines() if not line.startswith("#"))
            # rosbag2 separates the files by a line of = signs and a line "IDL: pkg/msg/Type".
            parts = [part.partition("\n")[2] for part in ("\n" + text).split("=" * 80)]
            bodies = [p.partition("\n")[2] if p.startswith("IDL:") else p for p in parts]
            types: dict[str, Any] = {}
            for body in bodies:
                if body.strip():
                    types.update(get_types_from_idl(body))
            return types
        if channel.schema_encoding not in ("ros2msg", "ros1msg", ""):
            raise SchemaError(f"a definition in {channel.schema_encoding!r} cannot be read")
        return dict(get_types_from_msg(text, name))
    except SchemaError:
        raise
    except Exception as error:
        # The parser is someone else's, the text may be anything.
        raise SchemaError(f"the definition of {name} is damaged ({error})") from None


def _complete(definitions: dict[str, Any], name: str, *, ros1: bool) -> None:
    """Add built-in definitions of the types that are referred to but not defined."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    built_in = None
    waiting, visited = [name], {name}
    while waiting:
        wanted = waiting.pop()
        if wanted not in definitions:
            if built_in is None:
                built_in = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.LATEST).fielddefs
            if wanted in _WELL_KNOWN:
                definitions[wanted] = get_types_from_msg(_WELL_KNOWN[wanted], wanted)[wanted]
            elif wanted in built_in:
                definitions[wanted] = built_in[wanted]
            else:
                raise SchemaError(f"the definition of {wanted} is not in the log")
        for _, kind in definitions[wanted][1]:
            inner = _referred(kind)
            if inner is not None and inner not in visited:
                visited.add(inner)
                waiting.append(inner)


def _referred(kind: Any) -> str | None:
    """The type that a field refers to, itself or as element of a list."""
    from rosbags.interfaces import Nodetype

    if kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        kind = kind[1][0]
    return str(kind[1]) if kind[0] == Nodetype.NAME else None


def _ros_fields(
    definitions: Mapping[str, Any], name: str, prefix: str, depth: int
) -> Iterator[tuple[str, str]]:
    from rosbags.interfaces import Nodetype

    for field, kind in definitions[name][1]:
        path = f"{prefix}{field}"
        listed = kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE)
        inner = _referred(kind)
        if inner is None:
            leaf = kind[1][0][1][0] if listed else kind[1][0]
            yield path, f"{leaf}[]" if listed else str(leaf)
        else:
            yield path, f"{inner}[]" if listed else inner
            if depth < MAX_DEPTH:
                yield from _ros_fields(definitions, inner, f"{path}.", depth + 1)


def _layout(definitions: Mapping[str, Any], name: str, prefix: str, depth: int) -> Iterator[str]:
    from rosbags.interfaces import Nodetype

    for field, kind in definitions[name][1]:
        path, suffix = f"{prefix}{field}", ""
        if kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            suffix = f"[{kind[1][1]}]" if kind[0] == Nodetype.ARRAY else "[]"
        inner = _referred(kind)
        if inner is None:
            leaf = kind[1][0][1] if suffix else kind[1]
            yield f"{path} {leaf[0]}{suffix}"
            continue
        if suffix:
            yield f"{path} {suffix}"
        if depth < MAX_DEPTH:
            yield from _layout(definitions, inner, f"{path}.", depth + 1)


# Protocol Buffers


def _protobuf_type(channel: Channel) -> MessageType:
    if channel.schema_encoding != "protobuf" or channel.encoding != "protobuf":
        raise SchemaError("protobuf messages without a protobuf definition")
    descriptor = _protobuf_descriptor(channel)
    fields = dict(_protobuf_fields(descriptor, "", 0))

    def decoder() -> Decoder:
        from google.protobuf.message import DecodeError
        from google.protobuf.message_factory import GetMessageClass

        parse = GetMessageClass(descriptor).FromString

        def decoded(data: memoryview) -> Any:
            try:
                return parse(bytes(data))
            except (DecodeError, ValueError) as error:
                raise MessageError(str(error)) from None

        return decoded

    return MessageType(fields, decoder)


def _protobuf_descriptor(channel: Channel) -> Any:
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.duration_pb2 import DESCRIPTOR as DURATION
    from google.protobuf.timestamp_pb2 import DESCRIPTOR as TIMESTAMP

    try:
        waiting = {
            file.name: file for file in FileDescriptorSet.FromString(channel.schema_data).file
        }
        pool = DescriptorPool()
        for well_known in (TIMESTAMP, DURATION):
            waiting.pop(well_known.name, None)
            pool.AddSerializedFile(well_known.serialized_pb)

        def add(name: str) -> None:
            file = waiting.pop(name, None)
            if file is not None:
                for dependency in file.dependency:
                    add(dependency)
                pool.AddSerializedFile(file.SerializeToString())

        while waiting:
            add(next(iter(waiting)))
        return pool.FindMessageTypeByName(channel.schema_name)
    except Exception as error:
        # protobuf raises TypeError, KeyError, DecodeError and others for a broken definition.
        raise SchemaError(f"the definition of {channel.schema_name} is damaged ({error})") from None


def _protobuf_fields(descriptor: Any, prefix: str, depth: int) -> Iterator[tuple[str, str]]:
    kinds = {1: "float64", 2: "float32", 9: "string", 12: "uint8[]", 13: "uint32", 7: "uint32"}
    for field in descriptor.fields:
        path = f"{prefix}{field.name}"
        listed = "[]" if field.is_repeated else ""
        inner = field.message_type
        if inner is None:
            yield path, kinds.get(field.type, "int") + listed
        else:
            yield path, inner.full_name + listed
            if depth < MAX_DEPTH:
                yield from _protobuf_fields(inner, f"{path}.", depth + 1)
