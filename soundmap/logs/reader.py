"""Messages of an MCAP log, in order, whatever state the file is in.

The records are walked one after another, so that neither index nor summary nor footer is needed.
Chunks are checked (size, checksum) before anything in them is believed; a damaged one is counted
and left out. Memory holds two chunks at a time, however long the log.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from operator import itemgetter
from pathlib import Path
from typing import IO, Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import Schema

from soundmap.errors import LogError
from soundmap.logs.chunk import MAX_CHUNK_BYTES, chunk_content
from soundmap.logs.file_summary import (
    MAGIC,
    RECORD_DAMAGE,
    RECORD_HEAD,
    FileSummary,
    file_summary,
)
from soundmap.logs.resync import is_near, next_record
from soundmap.losses import LossLedger

BATCH_BYTES = 2**20
"""Messages outside chunks are put in order in batches of this size."""

LAST_TIME_NS = 2**62
"""The year 2116; what was logged later was not."""

_MESSAGE = struct.Struct("<HIQQ")


@dataclass(frozen=True)
class Channel:
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
    schema_data: bytes = field(repr=False)


class Message(NamedTuple):
    """One message as recorded; times in ns since epoch."""

    channel: Channel
    log_time_ns: int
    publish_time_ns: int
    data: memoryview


Wanted = Callable[[Channel], bool]


class McapLog:
    """A log of one or several MCAP files.

    The first complete pass of :meth:`messages` finds out which chunks are damaged and which topics
    each chunk holds; later passes skip what they do not need, and count nothing twice.

    Parameters
    ----------
    path : Path
        As the user named it: an ``.mcap`` file or a rosbag2 folder.
    files : tuple of Path
        The MCAP files in order.
    losses : LossLedger
        Where damage is counted.

    Raises
    ------
    LogError
        A file cannot be opened, or is not MCAP.
    """

    def __init__(self, path: Path, files: tuple[Path, ...], losses: LossLedger) -> None:
        self.path = path
        self.files = files
        self.losses = losses
        self._chunk_topics: dict[tuple[int, int], frozenset[Channel]] = {}
        self._surveyed = False
        for file in files:
            _check_magic(file)

    @property
    def size_bytes(self) -> int:
        """Size of all files."""
        return sum(file.stat().st_size for file in self.files)

    def fingerprint(self) -> str:
        """SHA-256 over the sizes of the files and samples of their content; cheap for any size."""
        digest = hashlib.sha256()
        for file in self.files:
            size = file.stat().st_size
            digest.update(struct.pack("<Q", size))
            step = max((size - 2**20) // 7, 2**20)
            with file.open("rb") as stream:
                for offset in range(0, size, step):
                    stream.seek(offset)
                    digest.update(stream.read(2**20))
                stream.seek(max(size - 2**20, 0))
                digest.update(stream.read(2**20))
        return digest.hexdigest()

    def messages(self, wanted: Wanted = lambda _: True) -> Iterator[Message]:
        """Messages of the wanted channels in the order of their log time.

        Order is restored inside a chunk and across neighbouring chunks. The order is the same in
        every pass. The first pass should want everything that later passes will want.
        """
        for number, file in enumerate(self.files):
            yield from _in_order(_FileWalk(self, number, file, wanted).batches())
        self._surveyed = True

    def count(self, what: str, where: str, effect: str, *, count: int = 1) -> None:
        """Count damage, unless an earlier pass has."""
        if not self._surveyed:
            self.losses.add(what, where, effect=effect, count=count)

    def chunk_topics(self, place: tuple[int, int]) -> frozenset[Channel] | None:
        """Channels in the chunk at (file, offset); empty if damaged, None if not seen yet."""
        return self._chunk_topics.get(place)

    def remember_chunk(self, place: tuple[int, int], channels: frozenset[Channel]) -> None:
        """Note what a chunk holds, for later passes."""
        self._chunk_topics[place] = channels


class _FileWalk:
    """One pass over the records of one file."""

    def __init__(self, log: McapLog, number: int, file: Path, wanted: Wanted) -> None:
        self.log, self.number, self.file, self.wanted = log, number, file, wanted
        self.size = file.stat().st_size
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.selected: dict[int, Channel | None] = {}
        self.summary = FileSummary()
        self.chunked = False
        self.last_ns = 0
        self.messages = 0

    def batches(self) -> Iterator[list[Message]]:
        """Messages chunk by chunk, each list in the order of log time."""
        with self.file.open("rb", buffering=2**18) as stream:
            self.summary = file_summary(stream, self.size)
            stream.seek(len(MAGIC))
            loose: list[Message] = []
            loose_bytes = 0
            for opcode, offset, length in self._records(stream):
                if opcode == Opcode.CHUNK:
                    self.chunked = True
                    if loose:
                        yield sorted(loose, key=itemgetter(1))
                        loose, loose_bytes = [], 0
                    if batch := self._chunk(stream, offset, length):
                        self.last_ns = batch[-1].log_time_ns
                        yield batch
                elif opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
                    if length > MAX_CHUNK_BYTES:
                        self.log.count("record too long", self.file.name, "left out")
                        continue
                    message = self._record(opcode, memoryview(stream.read(length)))
                    if message is not None:
                        loose.append(message)
                        self.last_ns = message.log_time_ns
                        loose_bytes += length
                    if loose_bytes > BATCH_BYTES:
                        yield sorted(loose, key=itemgetter(1))
                        loose, loose_bytes = [], 0
            if loose:
                yield sorted(loose, key=itemgetter(1))
        self.log.count(
            "message that the file's own summary counts is missing",
            self.file.name,
            "lost",
            count=self.summary.messages - self.messages,
        )

    def _records(self, stream: IO[bytes]) -> Iterator[tuple[int, int, int]]:
        """Opcode, offset and length of the content of every whole record of the data section.

        The stream stands at the content when a record is handed out; it may be left anywhere.
        """
        position = len(MAGIC)
        while True:
            stream.seek(position)
            head = stream.read(RECORD_HEAD.size)
            opcode, length = RECORD_HEAD.unpack(head) if len(head) == RECORD_HEAD.size else (0, 0)
            end = position + RECORD_HEAD.size + length
            onward = self.summary.next_chunk(position)
            is_end = opcode in (Opcode.DATA_END, Opcode.FOOTER)
            if onward is None and is_end:
                if self.summary.damaged:
                    self.log.count(
                        "damaged end of the file", self.file.name, "its own summary is not used"
                    )
                return
            # A record that reaches over the next chunk of the index lies, and so does an early end,
            # and what stands in place of a chunk.
            lies = opcode == 0 or is_end or end > (onward or self.size)
            if not lies and (opcode == Opcode.CHUNK or not self.summary.has_chunk(position)):
                yield opcode, position + RECORD_HEAD.size, length
                position = end
                continue
            onward = onward or next_record(
                stream, position + 1, self.size, self.last_ns, only_chunks=self.chunked
            )
            if onward is None:
                self._ends_early(position)
                return
            self.log.count("unreadable record", self.file.name, "went on at the next sound one")
            position = onward

    def _ends_early(self, position: int) -> None:
        megabytes = f"{position / 1e6:.1f} of {self.size / 1e6:.1f} MB"
        self.log.count("log ends early", self.file.name, f"read {megabytes}, all that is whole")

    def _record(self, opcode: int, data: memoryview) -> Message | None:
        """Take in a schema or channel; hand out a message if it is wanted."""
        if opcode == Opcode.MESSAGE:
            if len(data) < _MESSAGE.size:
                self.log.count("message too short", self.file.name, "left out")
                return None
            channel_id, _, log_time, publish_time = _MESSAGE.unpack_from(data)
            self.messages += 1
            channel = self._selected(channel_id)
            if channel is None or not self._is_time(log_time):
                return None
            # Where there are chunks, a message outside may be something else in disguise.
            if self.chunked and not (
                is_near(log_time, self.last_ns) and is_near(publish_time, self.last_ns)
            ):
                self.log.count("message between chunks makes no sense", self.file.name, "left out")
                return None
            return Message(channel, log_time, publish_time, data[_MESSAGE.size :])
        try:
            source = ReadDataStream(BytesIO(data))
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(source)
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                self._add_channel(ChannelRecord.read(source))
        except RECORD_DAMAGE:
            self.log.count("damaged schema or channel record", self.file.name, "left out")
        return None

    def _is_time(self, log_time: int) -> bool:
        if log_time <= LAST_TIME_NS:
            return True
        self.log.count("message logged at an impossible time", self.file.name, "left out")
        return False

    def _add_channel(self, record: ChannelRecord) -> None:
        schema = self.schemas.get(record.schema_id) or self.summary.schemas.get(record.schema_id)
        channel = Channel(
            record.topic,
            record.message_encoding,
            schema.name if schema else "",
            schema.encoding if schema else "",
            schema.data if schema else b"",
        )
        if self.channels.get(record.id) != channel:
            self.channels[record.id] = channel
            self.selected.pop(record.id, None)

    def _selected(self, channel_id: int) -> Channel | None:
        """The channel, if its messages are wanted."""
        if channel_id not in self.selected:
            self._known(channel_id)
            channel = self.channels.get(channel_id)
            if channel is None:
                self.log.count("message without a channel", self.file.name, "left out")
                return None
            self.selected[channel_id] = channel if self.wanted(channel) else None
        return self.selected[channel_id]

    def _known(self, channel_id: int) -> None:
        """Fall back on the summary for a channel whose own record was in a damaged chunk."""
        if channel_id not in self.channels and channel_id in self.summary.channels:
            self._add_channel(self.summary.channels[channel_id])

    def _chunk(self, stream: IO[bytes], offset: int, length: int) -> list[Message]:
        """The wanted messages of a chunk in the order of log time."""
        place = (self.number, offset)
        held = self.log.chunk_topics(place)
        if held is not None and not any(self.wanted(channel) for channel in held):
            return []
        try:
            if length > MAX_CHUNK_BYTES:
                raise ValueError(f"it is {length / 2**20:.0f} MiB long, more than is credible")
            # Checksums need no second look in later passes: a damaged chunk holds no topics.
            data = chunk_content(stream.read(length), check=held is None)
        except RECORD_DAMAGE as error:
            self.log.count("damaged chunk", self.file.name, f"left out ({_reason(error)})")
            self.log.remember_chunk(place, frozenset())
            return []
        messages, seen = self._chunk_messages(memoryview(data))
        self.log.remember_chunk(place, frozenset(seen))
        messages.sort(key=itemgetter(1))
        return messages

    def _chunk_messages(self, data: memoryview) -> tuple[list[Message], set[Channel]]:
        messages: list[Message] = []
        ids: set[int] = set()
        position, end = 0, len(data)
        read_head, read_message, head_size = (
            RECORD_HEAD.unpack_from,
            _MESSAGE.unpack_from,
            RECORD_HEAD.size,
        )
        while position + head_size <= end:
            opcode, length = read_head(data, position)
            start = position + head_size
            position = start + length
            if position > end:
                self.log.count("record reaches beyond its chunk", self.file.name, "left out")
                break
            if opcode != 5 or length < 22:
                self._record(opcode, data[start:position])
                continue
            channel_id, _, log_time, publish_time = read_message(data, start)
            ids.add(channel_id)
            self.messages += 1
            channel = self._selected(channel_id)
            if channel is not None and self._is_time(log_time):
                messages.append(
                    Message(channel, log_time, publish_time, data[start + 22 : position])
                )
        return messages, {self.channels[i] for i in ids if i in self.channels}


def _reason(error: BaseException) -> str:
    return str(error) or type(error).__name__


def _in_order(batches: Iterator[list[Message]]) -> Iterator[Message]:
    """Merge batches, each in order, over neighbours: one batch is held back."""
    held: list[Message] = []
    for batch in batches:
        if held and held[-1].log_time_ns > batch[0].log_time_ns:
            # Overlapping neighbours. What was held before goes out up to where the new one begins,
            # and of the rest no more is held than the new batch is long in time.
            merged = sorted([*held, *batch], key=itemgetter(1))
            ready = len(merged) - len(batch)
            yield from merged[:ready]
            held = merged[ready:]
        else:
            yield from held
            held = batch
    yield from held


def _check_magic(file: Path) -> None:
    """Refuse what is not MCAP, with a word on what it is."""
    try:
        with file.open("rb") as stream:
            start = stream.read(16)
    except OSError as error:
        raise LogError(f"{file}: cannot be opened ({error.strerror}). Check the path.") from None
    if start.startswith(MAGIC):
        return
    if not start:
        raise LogError(f"{file}: the file is empty. Was the recording stopped before it began?")
    known: dict[bytes, Any] = {
        b"\x28\xb5\x2f\xfd": "compressed as a whole; unpack it first: zstd -d FILE",
        b"\x04\x22\x4d\x18": "compressed as a whole; unpack it first: lz4 -d FILE",
        b"#ROSBAG V2.0": "a ROS 1 bag; convert it first: mcap convert FILE OUT.mcap",
        b"SQLite format 3": "a rosbag2 database; convert it first: mcap convert FILE OUT.mcap",
    }
    what = next((text for magic, text in known.items() if start.startswith(magic)), None)
    raise LogError(f"{file}: not an MCAP file, but {what or 'something else'}.")
