"""One pass over the records of one file of a log, whatever state it is in.

The records are walked one after another, so that neither index nor summary nor footer is needed.
Chunks are checked (size, checksum) before anything in them is believed; a damaged one is counted
and left out.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from operator import itemgetter
from pathlib import Path
from typing import IO, TYPE_CHECKING

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import Schema

from soundmap.logs.chunk import MAX_CHUNK_BYTES
from soundmap.logs.chunk_ahead import ChunkAhead
from soundmap.logs.file_summary import (
    MAGIC,
    RECORD_DAMAGE,
    RECORD_HEAD,
    FileSummary,
    file_summary,
)
from soundmap.logs.records import Batch, Channel, Message, Wanted
from soundmap.logs.resync import is_near, next_record

if TYPE_CHECKING:
    from soundmap.logs.reader import McapLog

BATCH_BYTES = 2**20
"""Messages outside chunks are put in order in batches of this size."""

LAST_TIME_NS = 2**62
"""The year 2116; what was logged later was not."""

_MESSAGE = struct.Struct("<HIQQ")
_MESSAGE_RECORD = struct.Struct("<BQHIQQ")
"""A record's head and that of the message in it."""
_IS_MESSAGE = int(Opcode.MESSAGE)  # compared a million times


class FileWalk:
    """One pass over the records of one file.

    Parameters
    ----------
    log : McapLog
        Counts damage, and remembers what one pass finds out for the next.
    number : int
        Of the file in the log.
    file : Path
    wanted : callable
        Whether the messages of a channel are wanted.
    """

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
            self.log.remember_chunk(place, (), 0, 0)
            return None
        messages, times_ns, seen = self._chunk_messages(memoryview(data))
        if not times_ns or not seen:
            self.log.remember_chunk(place, (), 0, 0)
            return None
        batch = _batch(messages, times_ns)
        self.log.remember_chunk(place, seen, batch.first_ns, batch.last_ns)
        return batch

    def _chunk_messages(self, data: memoryview) -> tuple[list[Message], list[int], set[Channel]]:
        """The wanted messages, the times of all, and the channels of all."""
        messages, times_ns, ids = list[Message](), list[int](), set[int]()
        position, end = 0, len(data)
        read_message, selected = _MESSAGE_RECORD.unpack_from, self.selected
        last_message = end - _MESSAGE_RECORD.size
        while position + RECORD_HEAD.size <= end:
            if position <= last_message:
                opcode, length, channel_id, _, log_ns, published_ns = read_message(data, position)
            else:
                opcode, length = RECORD_HEAD.unpack_from(data, position)
            start = position + RECORD_HEAD.size
            position = start + length
            if position > end:
                self.log.count("record reaches beyond its chunk", self.file.name, "left out")
                break
            if opcode != _IS_MESSAGE or length < _MESSAGE.size:
                self._record(opcode, data[start:position], messages, times_ns)
                continue
            ids.add(channel_id)
            self.messages += 1
            if log_ns > LAST_TIME_NS and not self._is_time(log_ns):
                continue
            times_ns.append(log_ns)
            channel = selected[channel_id] if channel_id in selected else self._selected(channel_id)
            if channel is not None:
                content = data[start + _MESSAGE.size : position]
                messages.append(Message(channel, log_ns, published_ns, content))
        return messages, times_ns, {self.channels[i] for i in ids if i in self.channels}


def _reason(error: BaseException) -> str:
    return str(error) or type(error).__name__


def _batch(messages: list[Message], times_ns: list[int]) -> Batch:
    return Batch(min(times_ns), max(times_ns), sorted(messages, key=itemgetter(1)))
