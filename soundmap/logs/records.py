"""What the reader of a log hands on: messages, and where they come from."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple


class Channel(NamedTuple):
    """Where messages of one topic come from and how they are encoded.

    Attributes
    ----------
    topic, encoding : str
        Encoding of the messages: "cdr", "ros1", "protobuf" ...
    schema_name, schema_encoding : str
        Type of the messages and the language of its definition: "ros2msg", "protobuf" ...
    schema_data : bytes
        The definition itself; may be empty.
    """

    topic: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema_data: bytes


class Message(NamedTuple):
    """One message as recorded; times in ns since epoch."""

    channel: Channel
    log_time_ns: int
    publish_time_ns: int
    data: memoryview


class Batch(NamedTuple):
    """Some messages that lie together, in the order of log time.

    ``first_ns`` and ``last_ns`` are the span of the messages of all channels; ``messages`` holds
    those that are wanted.
    """

    first_ns: int
    last_ns: int
    messages: list[Message]


class KnownChunk(NamedTuple):
    """What a chunk holds, from an earlier pass; no channels if it is damaged."""

    channels: frozenset[Channel]
    first_ns: int
    last_ns: int


Wanted = Callable[[Channel], bool]
