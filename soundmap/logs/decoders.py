"""What turns the messages of each channel into what they tell, made once for each definition."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

from soundmap.logs.audio_messages import PACKET_READERS
from soundmap.logs.fixed_layouts import FIXED_LAYOUTS, FixedReader, is_little_endian
from soundmap.logs.laser_messages import SWEEP_READERS
from soundmap.logs.messages import Form, form_of
from soundmap.logs.odometry import odometry_reading
from soundmap.logs.records import Channel
from soundmap.logs.schemas import Decoder, MessageType, SchemaError, message_type
from soundmap.logs.transforms import TRANSFORM_READERS

_READERS: dict[Form, Callable[[Any], Any]] = {
    **PACKET_READERS,
    **SWEEP_READERS,
    **TRANSFORM_READERS,
    Form.ODOMETRY: odometry_reading,
}
"""What makes a packet, a sweep, transforms or an odometry reading of a decoded message."""


class Decoders:
    """Types and readers of all channels."""

    def __init__(self) -> None:
        self._types: dict[Any, MessageType | SchemaError] = {}
        self._readers: dict[Any, Decoder] = {}

    def type_of(self, channel: Channel) -> MessageType:
        """Fields of the channel's messages; SchemaError if they cannot be read."""
        key = _definition(channel)
        if key not in self._types:
            try:
                self._types[key] = message_type(channel)
            except SchemaError as error:
                self._types[key] = error
        found = self._types[key]
        if isinstance(found, SchemaError):
            raise found
        return found

    def reader(self, channel: Channel) -> Decoder:
        """What reads the channel's messages.

        It makes an `AudioPacket`, `LaserSweep`, list of `Transform` or `OdometryReading` of each,
        or decodes it if it is of another kind; it raises MessageError if that cannot be done, or
        whatever a value of a wrong type raises.

        Raises
        ------
        SchemaError
            They cannot be read.
        """
        key = _definition(channel)
        if key not in self._readers:
            self._readers[key] = _reader(self.type_of(channel), channel.schema_name)
        return self._readers[key]


def _definition(channel: Channel) -> Any:
    return channel.encoding, channel.schema_name, channel.schema_encoding, channel.schema_data


def _reader(kind: MessageType, name: str) -> Decoder:
    try:
        decode = kind.decoder()
    except Exception as error:
        # Code is generated from a definition that may be anything.
        raise SchemaError(f"no decoder for {name} ({error})") from None
    form = form_of(kind)
    read = _READERS.get(form)
    if read is None:
        return decode
    layout, fixed = FIXED_LAYOUTS.get(form, ((), None))
    if fixed is not None and layout == kind.layout:
        return _with_shortcut(fixed, lambda data: read(decode(data)))
    return lambda data: read(decode(data))


def _with_shortcut(fixed: FixedReader, general: Decoder) -> Decoder:
    def reader(data: memoryview) -> Any:
        try:
            reading = fixed(data) if is_little_endian(data) else None
        except (struct.error, ValueError, IndexError):
            reading = None
        return general(data) if reading is None else reading

    return reader
