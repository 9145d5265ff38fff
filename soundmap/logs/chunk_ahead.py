"""Chunks of a file, read and decompressed by a thread while those before are looked into.

Only work is done ahead, nothing decided: a chunk is used if the walk over the records arrives at
the same place, and forgotten if it does not.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import IO, NamedTuple

from mcap.opcode import Opcode

from soundmap.logs.chunk import MAX_CHUNK_BYTES, chunk_content
from soundmap.logs.file_summary import RECORD_DAMAGE, RECORD_HEAD

AHEAD = 2
"""Chunks that are held ready."""
RECORDS_BETWEEN = 256
"""Between two chunks come the indexes of the first, one a channel; what else may come is not known
here."""


class _Ready(NamedTuple):
    """Content of the chunk at an offset, or what is wrong with it."""

    offset: int
    content: bytes | memoryview | Exception


class ChunkAhead:
    """Contents of chunks in the order of the file.

    Parameters
    ----------
    file : Path
    size : int
        Bytes of the file to be looked at; it may be growing.
    to_check : callable
        Whether the checksum of the chunk at an offset is to be looked at; None if the chunk is not
        wanted.
    """

    def __init__(self, file: Path, size: int, to_check: Callable[[int], bool | None]) -> None:
        self._file, self._size, self._to_check = file, size, to_check
        self._pool: ThreadPoolExecutor | None = None
        self._stream: IO[bytes] | None = None
        self._position = 0
        self._ready: deque[Future[_Ready | None]] = deque()

    def __enter__(self) -> ChunkAhead:
        self._pool = ThreadPoolExecutor(1, "chunks")
        self._stream = self._file.open("rb", buffering=2**12)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
        if self._stream is not None:
            self._stream.close()

    def content(self, stream: IO[bytes], offset: int, length: int) -> bytes | memoryview:
        """Content of the chunk record at an offset, which ``stream`` stands at.

        Raises
        ------
        ValueError, struct.error, RuntimeError, ...
            It is damaged: see `chunk_content`.
        """
        ready = self._ready.popleft().result() if self._ready else None
        if ready is not None and ready.offset == offset:
            self._go_on()
            if isinstance(ready.content, Exception):
                raise ready.content
            return ready.content
        # The walk is not where it was expected: begin anew behind this chunk.
        while self._ready:
            self._ready.popleft().result()
        self._position = offset + length
        self._go_on()
        return chunk_content(stream.read(length), check=bool(self._to_check(offset)))

    def _go_on(self) -> None:
        while self._pool is not None and len(self._ready) < AHEAD:
            self._ready.append(self._pool.submit(self._next))

    def _next(self) -> _Ready | None:
        """The next wanted chunk; None if there is none, or something unforeseen comes first."""
        if self._stream is None:
            return None
        for _ in range(RECORDS_BETWEEN):
            self._stream.seek(self._position)
            head = self._stream.read(RECORD_HEAD.size)
            if len(head) < RECORD_HEAD.size:
                return None
            opcode, length = RECORD_HEAD.unpack(head)
            offset = self._position + RECORD_HEAD.size
            end = offset + length
            if end > self._size or opcode not in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
                return None
            self._position = end
            if opcode == Opcode.MESSAGE_INDEX or length > MAX_CHUNK_BYTES:
                continue
            check = self._to_check(offset)
            if check is not None:
                try:
                    return _Ready(offset, chunk_content(self._stream.read(length), check=check))
                except RECORD_DAMAGE as error:
                    return _Ready(offset, error)
        return None
