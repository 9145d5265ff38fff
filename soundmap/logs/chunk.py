"""The content of one chunk of an MCAP file, if it is sound."""

from __future__ import annotations

import struct
import zlib

MAX_CHUNK_BYTES = 256 * 2**20
"""A chunk that claims to expand to more than this is taken for damaged: 33 kB can claim 1 GiB."""

_CHUNK = struct.Struct("<QQQI")


def chunk_content(record: bytes, *, check: bool) -> bytes | memoryview:
    """Records of a chunk, decompressed, of the promised size and checksum.

    Parameters
    ----------
    record : bytes
        The chunk record.
    check : bool
        Whether to look at the checksum; nought in the file stands for none.

    Raises
    ------
    ValueError, struct.error, RuntimeError
        The chunk is damaged, or would expand to more than is credible. No more memory is taken
        than the chunk says it needs.
    """
    _, _, size, checksum = _CHUNK.unpack_from(record)
    position = _CHUNK.size
    (name_length,) = struct.unpack_from("<I", record, position)
    position += 4
    compression = record[position : position + name_length].decode()
    position += name_length
    (length,) = struct.unpack_from("<Q", record, position)
    compressed = memoryview(record)[position + 8 : position + 8 + length]
    if len(compressed) != length:
        raise ValueError("it is cut short")
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"it claims {size / 2**20:.0f} MiB, more than is credible")
    data = _decompressed(compressed, compression, size)
    if len(data) != size:
        raise ValueError(f"{size} bytes promised, {len(data)} found")
    if check and checksum and zlib.crc32(data) != checksum:
        raise ValueError("wrong checksum")
    return data


def _decompressed(data: memoryview, compression: str, size: int) -> bytes | memoryview:
    if compression == "" or size == 0:
        return data
    if compression == "zstd":
        import zstandard

        try:
            promised = zstandard.frame_content_size(data)
            if promised not in (-1, size):
                raise ValueError(f"{size} bytes promised, {promised} packed")
            return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from None
    if compression == "lz4":
        import lz4.frame

        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))
    raise ValueError(f"compressed with {compression!r}, which is unknown here")
