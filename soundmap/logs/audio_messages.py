"""Samples of all microphones out of one audio message, whatever its layout."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soundmap.logs.messages import Form, frame_name, ros_stamp_ns, timestamp_ns
from soundmap.logs.schemas import MessageError

STAMP_IS_START = {
    Form.AUDIO_FRAME: False,
    Form.RAW_AUDIO: True,
    Form.AUDIO_DATA_STAMPED: True,
    Form.AUDIO_DATA: False,
    Form.COUNTED_AUDIO: True,
}
"""Whether a stamp is that of the first sample. Bare audio data has none: the time at which it was
logged comes after the block's end."""


class AudioFormatError(ValueError):
    """The samples are encoded in a way that is not known here."""


@dataclass(frozen=True)
class SampleFormat:
    """How one sample is written.

    Attributes
    ----------
    kind : str
        "i" signed, "u" unsigned, "f" floating point.
    bits : int
        Significant bits.
    width : int
        Bytes a sample takes.
    big_endian : bool
    """

    kind: str
    bits: int
    width: int
    big_endian: bool

    @property
    def full_scale(self) -> float:
        """Value of :meth:`decoded` samples at full scale."""
        return 1.0 if self.kind == "f" else float(2 ** (self.bits - 1))

    def decoded(self, data: NDArray[np.uint8]) -> NDArray[Any]:
        """Samples in the order recorded, signed, in native byte order; shape (n,).

        24-bit and unsigned samples come as the next larger signed integers.
        """
        order = ">" if self.big_endian else "<"
        if self.width == 3:
            parts = data.reshape(-1, 3)
            wide = np.zeros((len(parts), 4), dtype=np.uint8)
            # In the upper three bytes of a word the sign comes by itself.
            wide[:, :3] = parts[:, ::-1] if not self.big_endian else parts
            samples = (wide.reshape(-1).view(">i4").astype(np.int32)) >> 8
            return _centred(samples & 0xFFFFFF, 24, np.int32) if self.kind == "u" else samples
        samples = data.view(f"{order}{self.kind}{self.width}")
        samples = samples.astype(samples.dtype.newbyteorder("="), copy=False)
        if self.bits == 24:
            if self.kind == "u":
                return _centred(samples & 0xFFFFFF, 24, np.int32)
            # The spare byte may hold anything.
            return (samples << 8) >> 8
        if self.kind == "u":
            wider = {1: np.int16, 2: np.int32, 4: np.int64}[self.width]
            return _centred(samples, self.bits, wider)
        return samples


def _centred(samples: NDArray[Any], bits: int, kind: Any) -> NDArray[Any]:
    return samples.astype(kind) - kind(2 ** (bits - 1))


_FRAME_NAME = re.compile(r"(signed|unsigned)_(padded_)?(8|16|24|32)")
_GSTREAMER_NAME = re.compile(r"([SUF])(8|16|24|32|64)(?:_(32))?(LE|BE)?")
_PCM_NAME = re.compile(r"pcm[-_]s(8|16|24|32)(le|be)?")


def sample_format(name: str, *, big_endian: bool = False) -> SampleFormat:
    """The format of that name as audio drivers, GStreamer or Foxglove call it.

    Raises
    ------
    AudioFormatError
        The name is unknown, or stands for compressed audio.

    Examples
    --------
    >>> sample_format("signed_16") == sample_format("S16LE") == sample_format("pcm-s16")
    True
    >>> sample_format("S24_32LE").width
    4
    """
    if name in ("float", "double"):
        bits = 32 if name == "float" else 64
        return SampleFormat("f", bits, bits // 8, big_endian)
    if match := _FRAME_NAME.fullmatch(name):
        bits = int(match[3])
        kind = "i" if match[1] == "signed" else "u"
        return SampleFormat(kind, bits, 4 if match[2] else bits // 8, big_endian)
    if match := _GSTREAMER_NAME.fullmatch(name.upper()):
        bits = int(match[2])
        kind = {"S": "i", "U": "u", "F": "f"}[match[1]]
        if (kind == "f") == (bits in (32, 64)) or (kind != "f" and bits == 32):
            width = 4 if match[3] else bits // 8
            return SampleFormat(kind, bits, width, match[4] == "BE" if match[4] else big_endian)
    if match := _PCM_NAME.fullmatch(name.lower()):
        bits = int(match[1])
        return SampleFormat("i", bits, bits // 8, match[2] == "be" if match[2] else big_endian)
    raise AudioFormatError(
        f"samples in format {name!r} cannot be read: expected uncompressed ones such as "
        "signed_16, S16LE, S24LE, S32LE, F32LE, float or pcm-s16. Record uncompressed audio"
    )


class AudioEncoding(NamedTuple):
    """Format, channels and rate as the message, or the info beside it, tells them."""

    format: str
    channels: int
    rate_hz: float
    big_endian: bool = False
    planar: bool = False

    def sample_format(self) -> SampleFormat:
        """How one sample is written."""
        return sample_format(self.format, big_endian=self.big_endian)


class AudioPacket(NamedTuple):
    """One audio message.

    ``stamp_ns`` is 0 if there is none, ``encoding`` None if an audio info tells it,
    ``declared_frames`` and ``first_frame`` None if the message does not count.
    """

    stamp_ns: int
    frame_id: str
    encoding: AudioEncoding | None
    declared_frames: int | None
    first_frame: int | None
    data: Any


def block_samples(data: Any, encoding: AudioEncoding, sample: SampleFormat) -> NDArray[Any]:
    """Samples of a packet, shape (frames, channels), native byte order."""
    values = sample.decoded(np.frombuffer(data, dtype=np.uint8))
    if encoding.planar:
        return values.reshape(encoding.channels, -1).T
    return values.reshape(-1, encoding.channels)


def _checked(encoding: AudioEncoding) -> AudioEncoding:
    if not (0 < encoding.channels <= 4096 and 0 < encoding.rate_hz < 1e8):
        raise MessageError("audio block claims an impossible number of channels or rate")
    return encoding


def frame_packet(
    stamp_ns: int, frame_id: str, encoding: AudioEncoding, frames: int, data: Any
) -> AudioPacket:
    """A packet by what an ``AudioFrame`` tells of it.

    Raises
    ------
    MessageError
        The encoding makes no sense.
    """
    return AudioPacket(stamp_ns, frame_id, _checked(encoding), frames, None, data)


def _audio_frame(message: Any) -> AudioPacket:
    encoding = AudioEncoding(
        message.format, int(message.channel_count), float(message.sampling_frequency)
    )
    return frame_packet(
        ros_stamp_ns(message.header.stamp),
        frame_name(message.header.frame_id),
        encoding,
        int(message.frame_sample_count),
        message.data,
    )


def _raw_audio(message: Any) -> AudioPacket:
    encoding = AudioEncoding(
        message.format, int(message.number_of_channels), float(message.sample_rate)
    )
    frame = frame_name(str(getattr(message, "frame_id", "")))
    stamp = timestamp_ns(message.timestamp)
    return AudioPacket(stamp, frame, _checked(encoding), None, None, message.data)


def _counted_audio(message: Any) -> AudioPacket:
    encoding = AudioEncoding(
        message.encoding,
        int(message.channels),
        float(message.sample_rate),
        bool(message.is_bigendian),
        int(message.layout) == 1,
    )
    header = message.header
    counter = int(message.seq_num) if hasattr(message, "seq_num") else None
    if counter is not None and counter > 2**62:
        raise MessageError("audio block claims an impossible count of samples")
    return AudioPacket(
        ros_stamp_ns(header.stamp),
        frame_name(header.frame_id),
        _checked(encoding),
        int(message.frames),
        counter,
        message.data,
    )


def _audio_data_stamped(message: Any) -> AudioPacket:
    header = message.header
    stamp, frame = ros_stamp_ns(header.stamp), frame_name(header.frame_id)
    return AudioPacket(stamp, frame, None, None, None, message.audio.data)


def _audio_data(message: Any) -> AudioPacket:
    return AudioPacket(0, "", None, None, None, message.data)


PACKET_READERS: dict[Form, Callable[[Any], AudioPacket]] = {
    Form.AUDIO_FRAME: _audio_frame,
    Form.RAW_AUDIO: _raw_audio,
    Form.COUNTED_AUDIO: _counted_audio,
    Form.AUDIO_DATA_STAMPED: _audio_data_stamped,
    Form.AUDIO_DATA: _audio_data,
}
"""What turns a decoded message of each layout into a packet."""


def info_encoding(message: Any) -> AudioEncoding:
    """The encoding that an audio info message tells.

    Raises
    ------
    AudioFormatError
        The audio is compressed.
    """
    coding = str(message.coding_format).lower()
    if coding not in ("wave", "wav", "pcm", "raw", ""):
        raise AudioFormatError(
            f"audio coded as {message.coding_format!r} cannot be read: expected 'WAVE'. Record "
            "uncompressed audio"
        )
    return AudioEncoding(
        str(message.sample_format), int(message.channels), float(message.sample_rate)
    )
