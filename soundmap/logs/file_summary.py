"""What the end of an intact MCAP file says of it: a fallback where its data section is damaged."""

from __future__ import annotations

import struct
import zlib
from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from io import BytesIO
from typing import IO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Schema, Statistics

from soundmap.logs.chunk import MAX_CHUNK_BYTES

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEAD = struct.Struct("<BQ")
RECORD_DAMAGE = (
    McapError, ValueError, struct.error, OSError, KeyError, RuntimeError, MemoryError, EOFError,
)  # fmt: skip
"""What reading a damaged record may raise."""

_TAIL_BYTES = RECORD_HEAD.size + 20 + len(MAGIC)
_SEARCHED_BYTES = 2**24
_DATA_END = RECORD_HEAD.pack(Opcode.DATA_END, 4)


@dataclass
class FileSummary:
    """The summary section; empty if there is none, or if it is damaged.

    Attributes
    ----------
    schemas, channels : dict
        By number.
    chunk_offsets : list of int
        Where chunks begin, rising.
    messages : int
        How many there are in the file; 0 if that is not told.
    damaged : bool
        Whether there should be a summary but cannot be read.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunk_offsets: list[int] = field(default_factory=list)
    messages: int = 0
    damaged: bool = False

    def next_chunk(self, position: int) -> int | None:
        """Offset of the first chunk after a position, None if there is none."""
        place = bisect_right(self.chunk_offsets, position)
        return self.chunk_offsets[place] if place < len(self.chunk_offsets) else None

    def has_chunk(self, position: int) -> bool:
        """Whether a chunk begins at a position, by the index."""
        place = bisect_left(self.chunk_offsets, position)
        return place < len(self.chunk_offsets) and self.chunk_offsets[place] == position


def file_summary(stream: IO[bytes], size: int) -> FileSummary:
    """The summary of an open file of ``size`` bytes."""
    if size < _TAIL_BYTES + len(MAGIC):
        return FileSummary()
    stream.seek(size - _TAIL_BYTES)
    tail = stream.read(_TAIL_BYTES)
    opcode, length = RECORD_HEAD.unpack_from(tail)
    if opcode != Opcode.FOOTER or length != 20 or not tail.endswith(MAGIC):
        return FileSummary(damaged=True)
    start = Footer.read(ReadDataStream(BytesIO(tail[RECORD_HEAD.size :]))).summary_start
    if start == 0:
        return FileSummary()
    if found := _at(stream, start, size, tail):
        return found
    # Something before the summary was cut out or put in: it begins after the data, all the same.
    first = max(size - _SEARCHED_BYTES, len(MAGIC))
    stream.seek(first)
    end = stream.read(size - first).rfind(_DATA_END)
    found = _at(stream, first + end + len(_DATA_END) + 4, size, tail) if end >= 0 else None
    return replace(found, chunk_offsets=[]) if found else FileSummary(damaged=True)


def _at(stream: IO[bytes], start: int, size: int, tail: bytes) -> FileSummary | None:
    """The summary that begins at an offset; None if there is none, or its checksum is wrong."""
    if not len(MAGIC) <= start < size - _TAIL_BYTES or size - start > MAX_CHUNK_BYTES:
        return None
    stream.seek(start)
    data = stream.read(size - _TAIL_BYTES - start)
    # The checksum covers the footer, too, as far as itself.
    checksum = zlib.crc32(tail[: RECORD_HEAD.size + 16], zlib.crc32(data))
    (promised,) = struct.unpack_from("<I", tail, RECORD_HEAD.size + 16)
    try:
        return _content(memoryview(data)) if promised in (0, checksum) else None
    except RECORD_DAMAGE:
        return None


def _content(data: memoryview) -> FileSummary:
    found = FileSummary()
    for opcode, source in _records(data):
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(source)
            found.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(source)
            found.channels[channel.id] = channel
        elif opcode == Opcode.CHUNK_INDEX:
            found.chunk_offsets.append(ChunkIndex.read(source).chunk_start_offset)
        elif opcode == Opcode.STATISTICS:
            found.messages = Statistics.read(source).message_count
    found.chunk_offsets.sort()
    return found


def _records(data: memoryview) -> Iterator[tuple[int, ReadDataStream]]:
    position = 0
    while position + RECORD_HEAD.size <= len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, position)
        position += RECORD_HEAD.size
        yield opcode, ReadDataStream(BytesIO(data[position : position + length]))
        position += length
