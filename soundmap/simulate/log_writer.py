"""Log: messages of several topics, merged in order of arrival and written as an MCAP file."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

from mcap.writer import CompressionType, Writer

from soundmap.simulate.messages import DEFINITIONS, raw_audio_schema

CHUNK_BYTES = 786_432


@dataclass(frozen=True)
class Message:
    """One message on its way into the log.

    Attributes
    ----------
    log_ns : int
        Arrival [ns since epoch].
    publish_ns : int
        Its stamp [ns since epoch].
    data : bytes
        As encoded.
    """

    log_ns: int
    publish_ns: int
    data: bytes


@dataclass(frozen=True)
class Topic:
    """A topic and its messages in order of arrival.

    Attributes
    ----------
    name : str
    schema : str
        Name of the message type.
    messages : iterable of Message
        Consumed while the log is written.
    latched : bool
        Whether late subscribers get the last message, as for /tf_static.
    """

    name: str
    schema: str
    messages: Iterable[Message]
    latched: bool = False


def write_log(path: Path, topics: Iterable[Topic]) -> int:
    """Write a log as ``ros2 bag record -s mcap`` does: in order of arrival, in zstd chunks.

    Returns
    -------
    int
        How many messages were written.
    """
    written = 0
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="soundmap simulate")
        schemas: dict[str, int] = {}
        streams = []
        for topic in topics:
            channel = _registered(writer, topic, schemas)
            streams.append(_numbered(channel, topic.messages))
        for entry in heapq.merge(*streams, key=attrgetter("message.log_ns")):
            message = entry.message
            writer.add_message(
                entry.channel, message.log_ns, message.data, message.publish_ns, entry.sequence
            )
            written += 1
        writer.finish()  # type: ignore[no-untyped-call]
    return written


@dataclass(frozen=True)
class _Entry:
    channel: int
    sequence: int
    message: Message


def _numbered(channel: int, messages: Iterable[Message]) -> Iterator[_Entry]:
    for sequence, message in enumerate(messages):
        yield _Entry(channel, sequence, message)


def _registered(writer: Writer, topic: Topic, schemas: dict[str, int]) -> int:
    """Number of the topic's channel; its schema is registered once."""
    protobuf = topic.schema == "foxglove.RawAudio"
    if topic.schema not in schemas:
        schemas[topic.schema] = writer.register_schema(
            name=topic.schema,
            encoding="protobuf" if protobuf else "ros2msg",
            data=raw_audio_schema() if protobuf else DEFINITIONS[topic.schema].encode(),
        )
    durability = "transient_local" if topic.latched else "volatile"
    profile = (
        f"- history: keep_last\n  depth: 10\n  reliability: reliable\n  durability: {durability}\n"
    )
    return writer.register_channel(
        topic=topic.name,
        message_encoding="protobuf" if protobuf else "cdr",
        schema_id=schemas[topic.schema],
        metadata={} if protobuf else {"offered_qos_profiles": profile},
    )
