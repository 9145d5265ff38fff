"""Damage to MCAP files, drawn from a seed: of bytes, of records, of what lies inside chunks."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable

import lz4.frame
import numpy as np
import zstandard

Random = np.random.Generator
Records = list[bytes]

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")
CHUNK = 6
LENGTHS = (0, 1, 7, 21, 22, 255, 2**16, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1)
SIZES = (0, 1, 100, 2**16, 2**27, 2**28, 2**28 + 1, 2**31, 2**40, 2**63, 2**64 - 1)


def records_of(content: bytes) -> Records:
    """The records of a whole file, heads included, without the magic at both ends."""
    records, position, end = [], len(MAGIC), len(content) - len(MAGIC)
    while position < end:
        _, length = HEAD.unpack_from(content, position)
        after = position + HEAD.size + length
        records.append(content[position:after])
        position = after
    return records


def joined(records: Records) -> bytes:
    return MAGIC + b"".join(records) + MAGIC


# Bytes


def flipped_bits(rng: Random, content: bytes) -> bytes:
    damaged = bytearray(content)
    for place in rng.integers(0, len(damaged), rng.integers(1, 17)):
        damaged[place] ^= 1 << int(rng.integers(8))
    return bytes(damaged)


def overwritten(rng: Random, content: bytes) -> bytes:
    """A sector lost: noughts or noise in its place."""
    size = int(rng.integers(1, 4096))
    place = int(rng.integers(0, max(len(content) - size, 1)))
    instead = bytes(size) if rng.random() < 0.5 else rng.bytes(size)
    return content[:place] + instead + content[place + size :]


def cut(rng: Random, content: bytes) -> bytes:
    return content[: int(rng.integers(9, len(content)))]


def moved_bytes(rng: Random, content: bytes) -> bytes:
    """A stretch of bytes taken out, put in again elsewhere, or in twice."""
    size = int(rng.integers(1, 6000))
    place, other = (int(p) for p in rng.integers(len(MAGIC), max(len(content) - size, 9), 2))
    stretch = content[place : place + size]
    rest = content[:place] + content[place + size :]
    kind = rng.integers(3)
    if kind == 0:
        return rest
    whole = rest if kind == 1 else content
    return whole[:other] + stretch + whole[other:]


# Records


def rearranged(rng: Random, content: bytes) -> bytes:
    """Records dropped, repeated, or in another place."""
    records = records_of(content)
    for _ in range(rng.integers(1, 4)):
        a, b = (int(i) for i in rng.integers(0, len(records), 2))
        kind = rng.integers(3)
        taken = records[a]
        if kind != 1:
            del records[a]
        if kind != 0:
            records.insert(b, taken)
    return joined(records)


def lying_record(rng: Random, content: bytes) -> bytes:
    """A record that is not as long as it says, or not of the kind it says."""
    records = records_of(content)
    i = int(rng.integers(len(records)))
    opcode, length = HEAD.unpack_from(records[i])
    if rng.random() < 0.3:
        opcode = int(rng.choice([0, 1, 2, 3, 4, 5, 6, 7, 8, 11, 15, 16, 127, 128, 255]))
    elif rng.random() < 0.4:
        length = max(length + int(rng.integers(-40, 40)), 0)
    else:
        length = int(rng.choice(np.array(LENGTHS, dtype=np.uint64)))
    records[i] = HEAD.pack(opcode, length) + records[i][HEAD.size :]
    return joined(records)


def lying_chunk(rng: Random, content: bytes) -> bytes:
    """A chunk whose own account of its size, compression or checksum is wrong."""
    records = records_of(content)
    places = [i for i, record in enumerate(records) if record[0] == CHUNK]
    if not places:
        return lying_record(rng, content)
    i = int(rng.choice(places))
    body = bytearray(records[i][HEAD.size :])
    (name,) = struct.unpack_from("<I", body, 28)
    size = np.uint64(rng.choice(np.array(SIZES, dtype=np.uint64)))
    kind = rng.integers(4)
    if kind == 0:
        struct.pack_into("<Q", body, 16, int(size))
    elif kind == 1:
        struct.pack_into("<Q", body, 32 + name, int(size))
    elif kind == 2:
        struct.pack_into("<I", body, 28, int(size) & 0xFFFFFFFF)
    else:
        body[32 : 32 + name] = rng.choice([b"zstd", b"lz4", b"none", b"", b"\xff\xfe"])
        struct.pack_into("<I", body, 28, len(body) and int(rng.integers(0, 6)))
    records[i] = HEAD.pack(CHUNK, len(body)) + bytes(body)
    return joined(records)


# Inside chunks


def damaged_inside(rng: Random, content: bytes) -> bytes:
    """Damage done before the chunk was packed: sizes and checksums agree with it."""
    records = records_of(content)
    places = [i for i, record in enumerate(records) if record[0] == CHUNK]
    if not places:
        return flipped_bits(rng, content)
    for i in rng.choice(places, min(len(places), 4), replace=False):
        body = records[i][HEAD.size :]
        (name,) = struct.unpack_from("<I", body, 28)
        compression = body[32 : 32 + name].decode()
        inner = _unpacked(body[40 + name :], compression)
        damaged = INNER[rng.integers(len(INNER))](rng, MAGIC + inner + MAGIC)[8:-8]
        packed = _packed(damaged, compression)
        head = body[:16] + struct.pack("<QI", len(damaged), zlib.crc32(damaged))
        body = head + body[28 : 32 + name] + struct.pack("<Q", len(packed)) + packed
        records[i] = HEAD.pack(CHUNK, len(body)) + body
    return joined(records)


def _unpacked(data: bytes, compression: str) -> bytes:
    if compression == "zstd":
        return zstandard.ZstdDecompressor().decompress(data)
    return lz4.frame.decompress(data) if compression == "lz4" else data


def _packed(data: bytes, compression: str) -> bytes:
    if compression == "zstd":
        return zstandard.ZstdCompressor(level=1).compress(data)
    return lz4.frame.compress(data) if compression == "lz4" else data


def lying_content(rng: Random, content: bytes) -> bytes:
    """Numbers in messages, schemas and channels replaced by extreme ones."""
    damaged = bytearray(content)
    for place in rng.integers(8, len(content) - 12, rng.integers(1, 30)):
        value = int(rng.choice(np.array(LENGTHS, dtype=np.uint64))) & 0xFFFFFFFF
        struct.pack_into("<I", damaged, int(place) // 4 * 4, value)
    return bytes(damaged)


Mutation = Callable[[Random, bytes], bytes]
INNER: tuple[Mutation, ...] = (
    flipped_bits,
    overwritten,
    moved_bytes,
    rearranged,
    lying_record,
    lying_content,
)
OUTER: tuple[Mutation, ...] = (
    flipped_bits,
    overwritten,
    cut,
    moved_bytes,
    rearranged,
    lying_record,
    lying_chunk,
)
"""Damage that checksums show, if the file has any."""


def mutated(seed: int, content: bytes, *, inside: bool) -> tuple[bytes, str]:
    """A damaged file and what was done to it."""
    rng = np.random.default_rng([20261124, seed])
    if inside:
        return damaged_inside(rng, content), damaged_inside.__name__
    done = [OUTER[rng.integers(len(OUTER))] for _ in range(1 if rng.random() < 0.7 else 2)]
    for mutation in done:
        try:
            content = mutation(rng, content)
        except (struct.error, ValueError, IndexError):  # too broken already to be taken apart
            content = flipped_bits(rng, content)
    return content, "+".join(mutation.__name__ for mutation in done)
