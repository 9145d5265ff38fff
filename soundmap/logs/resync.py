"""Where an MCAP file can be read again after a record whose length is not to be believed."""

from __future__ import annotations

import struct
from typing import IO

import numpy as np

from soundmap.logs.chunk import MAX_CHUNK_BYTES

NEAR_NS = 86_400_000_000_000
"""Messages of one log are taken to be logged within a day of one another."""

_WINDOW = 2**20
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
_CHUNK_HEAD = struct.Struct("<BQQQQII")
_MESSAGE, _CHUNK = 5, 6


def next_record(
    stream: IO[bytes], position: int, size: int, near_ns: int, *, only_chunks: bool
) -> int | None:
    """Offset of the first message or chunk at or after a position.

    Such a record shows itself by its kind, a length that fits into the file, and a time near that
    of messages before it. Within a random gigabyte there is less than one false one in a thousand.

    Parameters
    ----------
    stream : binary file
    position : int
        Where to begin.
    size : int
        Of the file.
    near_ns : int
        Time of logging of the last message before [ns since epoch].
    only_chunks : bool
        Pass over messages: where there are chunks, those outside may lie in a damaged one.

    Returns
    -------
    int or None
        None if nothing more is found.
    """
    head = max(_MESSAGE_HEAD.size, _CHUNK_HEAD.size)
    while position + _MESSAGE_HEAD.size <= size:
        stream.seek(position)
        data = stream.read(_WINDOW + head)
        values = np.frombuffer(data, dtype=np.uint8)
        values = np.concatenate([values, np.ones(head, dtype=np.uint8)])
        count = min(len(data), _WINDOW)
        # The upper half of a length is nought.
        maybe = values[:count] == _CHUNK
        if not only_chunks:
            maybe |= values[:count] == _MESSAGE
        for byte in range(5, 9):
            maybe &= values[byte : byte + count] == 0
        for offset in np.flatnonzero(maybe).tolist():
            if _is_record(data, offset, size - position, near_ns):
                return position + offset
        position += count
    return None


def _is_record(data: bytes, offset: int, room: int, near_ns: int) -> bool:
    if offset + _MESSAGE_HEAD.size > len(data):
        return False
    kind, length, _, _, time_ns, published_ns = _MESSAGE_HEAD.unpack_from(data, offset)
    if length > min(room - offset - 9, MAX_CHUNK_BYTES):
        return False
    if kind == _MESSAGE:
        return length >= 22 and is_near(time_ns, near_ns) and is_near(published_ns, near_ns)
    if length < 40 or offset + _CHUNK_HEAD.size > len(data):
        return False
    _, _, start_ns, end_ns, _, _, name = _CHUNK_HEAD.unpack_from(data, offset)
    return (
        name <= 4 and start_ns <= end_ns and is_near(start_ns, near_ns) and is_near(end_ns, near_ns)
    )


def is_near(time_ns: int, near_ns: int) -> bool:
    """Whether two times may belong to one log."""
    return bool(abs(time_ns - near_ns) < NEAR_NS)
