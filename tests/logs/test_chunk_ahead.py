from __future__ import annotations

import io

import pytest
from mcap.writer import CompressionType, Writer

from soundmap.logs.chunk_ahead import ChunkAhead
from soundmap.logs.reader import McapLog
from soundmap.losses import LossLedger


def log_file(path, compression=CompressionType.ZSTD, chunks=7):
    """A log of small chunks, each holding one message."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=100, compression=compression)
        writer.start()
        schema = writer.register_schema("kind", "ros2msg", b"int8 x")
        topics = [writer.register_channel(name, "cdr", schema) for name in ("/a", "/b")]
        for number in range(chunks):
            writer.add_message(topics[number % 2], number, bytes([number]) * 200, number)
        writer.finish()
    return path


def places(path):
    """Offset and length of the content of every chunk record."""
    data, found, position = path.read_bytes(), [], 8
    while position < len(data) - 8:
        length = int.from_bytes(data[position + 1 : position + 9], "little")
        if data[position] == 6:
            found.append((position + 9, length))
        position += 9 + length
    return found


def contents(path, wanted, to_check=lambda _: True):
    with ChunkAhead(path, path.stat().st_size, to_check) as ahead, path.open("rb") as stream:
        for offset, length in wanted:
            stream.seek(offset)
            yield bytes(ahead.content(stream, offset, length))


@pytest.mark.parametrize("compression", CompressionType)
def test_chunks_come_whole_in_whatever_order_they_are_asked_for(tmp_path, compression):
    path = log_file(tmp_path / "log.mcap", compression)
    every = places(path)
    assert len(every) == 7
    in_order = list(contents(path, every))
    assert [content[-1] for content in in_order] == list(range(7))
    order = [3, 0, 1, 2, 6, 6, 4, 5, 0]
    assert list(contents(path, [every[i] for i in order])) == [in_order[i] for i in order]


def test_chunks_that_are_not_wanted_are_not_read(tmp_path):
    path = log_file(tmp_path / "log.mcap")
    every = places(path)
    asked = []

    def to_check(offset):
        asked.append(offset)
        return True if offset in (every[0][0], every[4][0]) else None

    found = list(contents(path, [every[0], every[4]], to_check))
    assert [content[-1] for content in found] == [0, 4]
    assert {offset for offset, _ in every[:5]} <= set(asked)


def test_what_is_wrong_with_a_chunk_is_told_when_it_is_asked_for(tmp_path):
    path = log_file(tmp_path / "log.mcap", CompressionType.NONE)
    every = places(path)
    data = bytearray(path.read_bytes())
    data[every[2][0] + every[2][1] - 1] ^= 1
    path.write_bytes(data)
    found = contents(path, every)
    assert [next(found)[-1] for _ in range(2)] == [0, 1]
    with pytest.raises(ValueError, match="checksum"):
        next(found)
    ahead = ChunkAhead(path, len(data), lambda _: False)  # checksums are not looked at
    offset, length = every[2]
    assert len(ahead.content(io.BytesIO(bytes(data[offset:])), offset, length)) > 200


def test_a_pass_that_is_given_up_leaves_no_thread_behind(tmp_path):
    import threading

    log = McapLog(tmp_path, (log_file(tmp_path / "log.mcap", chunks=50),), LossLedger())
    before = threading.active_count()
    messages = log.messages()
    next(messages)
    assert threading.active_count() == before + 1
    messages.close()
    assert threading.active_count() == before
