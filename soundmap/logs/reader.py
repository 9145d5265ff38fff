"""Messages of an MCAP log, in order, whatever state the file is in.

The records are walked one after another, so that neither index nor summary nor footer is needed.
Chunks are checked (size, checksum) before anything in them is believed; a damaged one is counted
and left out. Memory holds two chunks at a time, however long the log.
"""

from __future__ import annotations

import hashlib
import struct
from bisect import bisect_left
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
from soundmap.logs.chunk import MAX_CHUNK_BYTES
from soundmap.logs.chunk_ahead import ChunkAhead
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
        for file in files:
            _check_magic(file)
        # A log that is still being written is read up to where it ends now, in every pass.
        self.sizes = tuple(file.stat().st_size for file in files)
        self.known_chunks: dict[tuple[int, int], KnownChunk] = {}
        self.known_channels: dict[int, dict[int, Channel]] = {}
        self._surveyed = False

    @property
    def size_bytes(self) -> int:
        """Size of all files."""
        return sum(self.sizes)

    def fingerprint(self) -> str:
        """SHA-256 over the sizes of the files and samples of their content; cheap for any size."""
        digest = hashlib.sha256()
        for file, size in zip(self.files, self.sizes, strict=True):
            digest.update(struct.pack("<Q", size))
            step = max((size - 2**20) // 7, 2**20)
            with file.open("rb") as stream:
                for offset in [*range(0, size, step), max(size - 2**20, 0)]:
                    stream.seek(offset)
                    digest.update(stream.read(min(2**20, size - offset)))
        return digest.hexdigest()

    def messages(self, wanted: Wanted = lambda _: True) -> Iterator[Message]:
        """Messages of the wanted channels in the order of their log time.

        Order is restored inside a chunk and across neighbouring chunks. The order of a topic is
        the same in every pass, whatever else is wanted. The first pass should want everything that
        later passes will want.
        """
        for number, file in enumerate(self.files):
            yield from _in_order(_FileWalk(self, number, file, wanted).batches())
        self._surveyed = True

    def count(self, what: str, where: str, effect: str, *, count: int = 1) -> None:
        """Count damage, unless an earlier pass has."""
        if not self._surveyed:
            self.losses.add(what, where, effect=effect, count=count)


class _FileWalk:
    """One pass over the records of one file."""

    def __init__(self, log: McapLog, number: int, file: Path, wanted: Wanted) -> None:
        self.log, self.number, self.file, self.wanted = log, number, file, wanted
        self.size = log.sizes[number]
        self.schemas: dict[int, Schema] = {}
        # The record of a channel may lie in a chunk that this pass skips.
        self.channels = dict(log.known_channels.get(number, {}))
        self.selected: dict[int, Channel | None] = {}
        self.summary = FileSummary()
        self.ahead = ChunkAhead(file, self.size, self._to_check)
        self.chunked = False
        self.last_ns = 0
        self.messages = 0

    def batches(self) -> Iterator[Batch]:
        """Messages chunk by chunk."""
        loose, loose_ns, loose_bytes = list[Message](), list[int](), 0
        with (
            self.file.open("rb", buffering=2**14) as stream,
            ChunkAhead(self.file, self.size, self._to_check) as self.ahead,
        ):
            self.summary = file_summary(stream, self.size)
            for opcode, offset, length in self._records(stream):
                if opcode == Opcode.CHUNK:
                    self.chunked = True
                    if loose_ns:
                        yield _batch(loose, loose_ns)
                        loose, loose_ns, loose_bytes = [], [], 0
                    if batch := self._chunk(stream, offset, length):
                        self.last_ns = batch.last_ns
                        yield batch
                elif opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
                    if length > MAX_CHUNK_BYTES:
                        self.log.count("record too long", self.file.name, "left out")
                        continue
                    before = len(loose_ns)
                    self._record(opcode, memoryview(stream.read(length)), loose, loose_ns)
                    loose_bytes += length
                    self.last_ns = loose_ns[-1] if len(loose_ns) > before else self.last_ns
                    if loose_ns and loose_bytes > BATCH_BYTES:
                        yield _batch(loose, loose_ns)
                        loose, loose_ns, loose_bytes = [], [], 0
            if loose_ns:
                yield _batch(loose, loose_ns)
        self.log.known_channels[self.number] = self.channels
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

    def _record(
        self, opcode: int, data: memoryview, messages: list[Message], times_ns: list[int]
    ) -> None:
        """Take in a schema or channel, or add a message: its time, and itself if it is wanted."""
        if opcode == Opcode.MESSAGE:
            if len(data) < _MESSAGE.size:
                self.log.count("message too short", self.file.name, "left out")
                return
            channel_id, _, log_time, publish_time = _MESSAGE.unpack_from(data)
            self.messages += 1
            if not self._is_time(log_time):
                return
            # Where there are chunks, a message outside may be something else in disguise.
            if self.chunked and not (
                is_near(log_time, self.last_ns) and is_near(publish_time, self.last_ns)
            ):
                self.log.count("message between chunks makes no sense", self.file.name, "left out")
                return
            times_ns.append(log_time)
            channel = self._selected(channel_id)
            if channel is not None:
                content = data[_MESSAGE.size :]
                messages.append(Message(channel, log_time, publish_time, content))
            return
        try:
            source = ReadDataStream(BytesIO(data))
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(source)
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                self._add_channel(ChannelRecord.read(source))
        except RECORD_DAMAGE:
            self.log.count("damaged schema or channel record", self.file.name, "left out")

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

    def _to_check(self, offset: int) -> bool | None:
        """Whether to look at the checksum of a chunk; None if there is nothing wanted in it.

        Checksums need no second look in later passes: a damaged chunk holds no channels.
        """
        known = self.log.known_chunks.get((self.number, offset))
        if known is None:
            return True
        return False if any(self.wanted(channel) for channel in known.channels) else None

    def _chunk(self, stream: IO[bytes], offset: int, length: int) -> Batch | None:
        """The wanted messages of a chunk; None if it is damaged or empty."""
        place = (self.number, offset)
        known = self.log.known_chunks.get(place)
        if known is not None and self._to_check(offset) is None:
            return Batch(known.first_ns, known.last_ns, []) if known.channels else None
        try:
            if length > MAX_CHUNK_BYTES:
                raise ValueError(f"it is {length / 2**20:.0f} MiB long, more than is credible")
            data = self.ahead.content(stream, offset, length)
        except RECORD_DAMAGE as error:
            self.log.count("damaged chunk", self.file.name, f"left out ({_reason(error)})")
            self.log.known_chunks[place] = KnownChunk(frozenset(), 0, 0)
            return None
        messages, times_ns, seen = self._chunk_messages(memoryview(data))
        if not times_ns or not seen:
            self.log.known_chunks[place] = KnownChunk(frozenset(), 0, 0)
            return None
        batch = _batch(messages, times_ns)
        self.log.known_chunks[place] = KnownChunk(frozenset(seen), batch.first_ns, batch.last_ns)
        return batch

    def _chunk_messages(self, data: memoryview) -> tuple[list[Message], list[int], set[Channel]]:
        """The wanted messages, the times of all, and the channels of all."""
        messages, times_ns, ids = list[Message](), list[int](), set[int]()
        position, end = 0, len(data)
        read_head, head_size = RECORD_HEAD.unpack_from, RECORD_HEAD.size
        read_message = _MESSAGE.unpack_from
        while position + head_size <= end:
            opcode, length = read_head(data, position)
            start = position + head_size
            position = start + length
            if position > end:
                self.log.count("record reaches beyond its chunk", self.file.name, "left out")
                break
            if opcode != 5 or length < 22:
                self._record(opcode, data[start:position], messages, times_ns)
                continue
            channel_id, _, log_time, publish_time = read_message(data, start)
            ids.add(channel_id)
            self.messages += 1
            if not self._is_time(log_time):
                continue
            times_ns.append(log_time)
            channel = self._selected(channel_id)
            if channel is not None:
                messages.append(
                    Message(channel, log_time, publish_time, data[start + 22 : position])
                )
        return messages, times_ns, {self.channels[i] for i in ids if i in self.channels}


def _reason(error: BaseException) -> str:
    return str(error) or type(error).__name__


def _batch(messages: list[Message], times_ns: list[int]) -> Batch:
    return Batch(min(times_ns), max(times_ns), sorted(messages, key=itemgetter(1)))


def _in_order(batches: Iterator[Batch]) -> Iterator[Message]:
    """Merge batches over neighbours: what is not older than the latest but one is held back.

    What goes out when depends on the times of all messages, not only of those wanted, so that the
    order of a topic is the same in every pass.
    """
    held: list[Message] = []
    latest_ns, settled_ns = 0, 0  # of all batches, and of all but the last
    for batch in batches:
        if held and held[-1].log_time_ns > batch.first_ns:
            held = sorted([*held, *batch.messages], key=itemgetter(1))
        else:
            held = [*held, *batch.messages]
        ready = bisect_left(held, max(batch.first_ns, settled_ns), key=itemgetter(1))
        yield from held[:ready]
        held = held[ready:]
        settled_ns, latest_ns = latest_ns, max(latest_ns, batch.last_ns)
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
