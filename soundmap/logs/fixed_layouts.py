"""Messages of the layouts that most logs hold, read at their places.

The general decoder makes an object of every part of a message. In these layouts all that is wanted
stands at a place that follows from the lengths of a few strings, in CDR with the low byte first.
Whatever is not exactly so, the other byte order or a length that does not add up, is left to the
general decoder, which knows what to say of it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from soundmap.logs.audio_messages import AudioEncoding, AudioPacket, frame_packet
from soundmap.logs.laser_messages import LaserSweep, laser_sweep
from soundmap.logs.messages import Form, frame_name
from soundmap.logs.odometry import OdometryReading
from soundmap.logs.transforms import Transform

FixedReader = Callable[[memoryview], Any]
"""Makes of a message with the low byte first what the reader of its form makes; None, or
struct.error, ValueError or IndexError, if that is left to the general decoder."""

ENCAPSULATION = 4
"""Bytes before the message itself: from here on, numbers are aligned to their size."""
MOST_SURPLUS = 3
"""Bytes with which a message may be filled up at its end."""

_STAMPED = ("header.stamp.sec int32", "header.stamp.nanosec uint32", "header.frame_id string")


def _numbers(prefix: str, names: str, kind: str = "float64") -> tuple[str, ...]:
    return tuple(f"{prefix}{name} {kind}" for name in names.split())


_STAMP, _LENGTH = struct.Struct("<iI"), struct.Struct("<I")
_AUDIO = struct.Struct("<IIII")
_SCAN = struct.Struct("<fffffffI")
_POSE, _TWIST = struct.Struct("<7d"), struct.Struct("<6d")
_COVARIANCE_BYTES = 36 * 8
_RANGE = np.dtype("<f4")


def is_little_endian(data: memoryview) -> bool:
    """Whether a message is CDR with the low byte first."""
    return len(data) > ENCAPSULATION and data[0] == 0 and data[1] == 1


def _is_all(data: memoryview, end: int) -> bool:
    """Whether a message that ends there is the whole of the data."""
    return 0 <= len(data) - end <= MOST_SURPLUS


def _aligned(place: int, size: int) -> int:
    return place + (ENCAPSULATION - place) % size


def _string(data: memoryview, place: int) -> tuple[str, int]:
    """The string that comes next, and where it ends."""
    place = _aligned(place, 4)
    (length,) = _LENGTH.unpack_from(data, place)
    end = place + _LENGTH.size + length
    if length < 1 or end > len(data) or data[end - 1] != 0:
        raise ValueError("not a string")
    return bytes(data[place + _LENGTH.size : end - 1]).decode(), end


def _header(data: memoryview, place: int) -> tuple[int, str, int]:
    """Stamp [ns] and frame of the header that comes next, and where it ends."""
    place = _aligned(place, 4)
    seconds, nanoseconds = _STAMP.unpack_from(data, place)
    frame_id, end = _string(data, place + _STAMP.size)
    return seconds * 1_000_000_000 + nanoseconds, frame_name(frame_id), end


def _audio_frame(data: memoryview) -> AudioPacket | None:
    stamp_ns, frame_id, place = _header(data, ENCAPSULATION)
    encoding, place = _string(data, place)
    place = _aligned(place, 4)
    channels, rate_hz, frames, size = _AUDIO.unpack_from(data, place)
    start = place + _AUDIO.size
    if not _is_all(data, start + size):
        return None
    return frame_packet(
        stamp_ns,
        frame_id,
        AudioEncoding(encoding, channels, float(rate_hz)),
        frames,
        data[start : start + size],
    )


def _laser_scan(data: memoryview) -> LaserSweep | None:
    stamp_ns, frame_id, place = _header(data, ENCAPSULATION)
    place = _aligned(place, 4)
    first, last, step, interval, _, least, greatest, count = _SCAN.unpack_from(data, place)
    start = place + _SCAN.size
    (intensities,) = _LENGTH.unpack_from(data, start + 4 * count)
    if not _is_all(data, start + 4 * (count + 1 + intensities)):
        return None
    numbers = (first, last, step, interval, least, greatest)
    return laser_sweep(stamp_ns, frame_id, numbers, np.frombuffer(data, _RANGE, count, start))


def _odometry(data: memoryview) -> OdometryReading | None:
    stamp_ns, parent, place = _header(data, ENCAPSULATION)
    child, place = _string(data, place)
    place = _aligned(place, 8)
    pose = _POSE.unpack_from(data, place)
    place += _POSE.size + _COVARIANCE_BYTES
    x, y, z, _, _, turn = _TWIST.unpack_from(data, place)
    if not _is_all(data, place + _TWIST.size + _COVARIANCE_BYTES):
        return None
    return OdometryReading(stamp_ns, parent, frame_name(child), (*pose, x, y, z, turn))


def _transforms(data: memoryview) -> list[Transform] | None:
    (count,) = _LENGTH.unpack_from(data, ENCAPSULATION)
    found, place = [], ENCAPSULATION + _LENGTH.size
    for _ in range(count):
        stamp_ns, parent, place = _header(data, place)
        child, place = _string(data, place)
        place = _aligned(place, 8)
        pose = _POSE.unpack_from(data, place)
        place += _POSE.size
        found.append((parent, frame_name(child), stamp_ns, pose))
    return found if _is_all(data, place) else None


FIXED_LAYOUTS: dict[Form, tuple[tuple[str, ...], FixedReader]] = {
    Form.AUDIO_FRAME: (
        (
            *_STAMPED,
            "format string",
            *_numbers("", "channel_count sampling_frequency frame_sample_count", "uint32"),
            "data uint8[]",
        ),
        _audio_frame,
    ),
    Form.LASER_SCAN: (
        (
            *_STAMPED,
            *_numbers("", "angle_min angle_max angle_increment time_increment", "float32"),
            *_numbers("", "scan_time range_min range_max", "float32"),
            "ranges float32[]",
            "intensities float32[]",
        ),
        _laser_scan,
    ),
    Form.ODOMETRY: (
        (
            *_STAMPED,
            "child_frame_id string",
            *_numbers("pose.pose.position.", "x y z"),
            *_numbers("pose.pose.orientation.", "x y z w"),
            "pose.covariance float64[36]",
            *_numbers("twist.twist.linear.", "x y z"),
            *_numbers("twist.twist.angular.", "x y z"),
            "twist.covariance float64[36]",
        ),
        _odometry,
    ),
    Form.STAMPED_TRANSFORMS: (
        (
            "transforms []",
            *(f"transforms.{path}" for path in _STAMPED),
            "transforms.child_frame_id string",
            *_numbers("transforms.transform.translation.", "x y z"),
            *_numbers("transforms.transform.rotation.", "x y z w"),
        ),
        _transforms,
    ),
}
"""Layouts as `MessageType.layout` has them, and what reads them."""
