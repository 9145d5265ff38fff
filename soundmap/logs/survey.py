"""One pass over a log: which topics there are, and everything about them that is small.

Samples and ranges stay in the file. What is kept of a message is its stamp, its size, its place in
the stream; of odometry and transforms, which are small, everything.
"""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from soundmap.logs.audio_messages import (
    AudioEncoding,
    AudioFormatError,
    AudioPacket,
    info_encoding,
)
from soundmap.logs.decoders import Decoders
from soundmap.logs.laser_messages import LaserSweep, longest_return
from soundmap.logs.messages import KINDS, Form, Kind, form_of
from soundmap.logs.odometry import OdometryRecord
from soundmap.logs.reader import McapLog
from soundmap.logs.records import Channel, Message
from soundmap.logs.schemas import Decoder, MessageError, SchemaError
from soundmap.logs.stamps import DAMAGED
from soundmap.logs.transforms import Transform, TransformRecord
from soundmap.losses import LossLedger

_ATTRIBUTE_FAULTS = (MessageError, AttributeError, TypeError, ValueError, OverflowError, IndexError)

MAX_PROBES, PROBE_BYTES = 256, 2**16


@dataclass
class AudioRecord:
    """What is kept of an audio topic: one entry a message, damaged ones included.

    ``probes`` holds the beginning of the data of some messages, by their number; up to the time of
    logging ``judged_ns``, samples that are no numbers have been counted.
    """

    form: Form
    stamp_ns: array[int] = field(default_factory=lambda: array("q"))
    log_time_ns: array[int] = field(default_factory=lambda: array("q"))
    size: array[int] = field(default_factory=lambda: array("q"))
    declared_frames: array[int] = field(default_factory=lambda: array("q"))
    first_frame: array[int] = field(default_factory=lambda: array("q"))
    encoding: array[int] = field(default_factory=lambda: array("i"))
    encodings: list[AudioEncoding | None] = field(default_factory=list)
    frame_ids: Counter[str] = field(default_factory=Counter)
    probes: dict[int, bytes] = field(default_factory=dict)
    probe_step: int = 1
    judged_ns: int = 0

    def add(self, packet: AudioPacket, log_time_ns: int) -> None:
        """Take in a message."""
        self._probe(packet.data)
        if packet.encoding not in self.encodings:
            self.encodings.append(packet.encoding)
        self.frame_ids[packet.frame_id] += 1
        self._append(
            packet.stamp_ns,
            log_time_ns,
            len(packet.data),
            -1 if packet.declared_frames is None else packet.declared_frames,
            -1 if packet.first_frame is None else packet.first_frame,
            self.encodings.index(packet.encoding),
        )

    def _probe(self, data: Any) -> None:
        """Keep the beginning of a few messages, evenly over the log however long it gets."""
        number = len(self.size)
        if number % self.probe_step == 0:
            self.probes[number] = bytes(memoryview(data)[:PROBE_BYTES])
            if len(self.probes) > MAX_PROBES:
                self.probe_step *= 2
                self.probes = {n: d for n, d in self.probes.items() if n % self.probe_step == 0}

    def add_damaged(self, log_time_ns: int) -> None:
        """Take note of a message that cannot be used."""
        self._append(DAMAGED, log_time_ns, 0, -1, -1, -1)

    def _append(
        self, stamp: int, log_time: int, size: int, declared: int, first: int, encoding: int
    ) -> None:
        self.stamp_ns.append(stamp)
        self.log_time_ns.append(log_time)
        self.size.append(size)
        self.declared_frames.append(declared)
        self.first_frame.append(first)
        self.encoding.append(encoding)


@dataclass
class LaserRecord:
    """What is kept of a laser topic: one entry a message, damaged ones included.

    ``surplus`` is how many ranges there are beyond what the angles tell; ``empty_ns`` when scans
    without any return were logged.
    """

    topic: str
    losses: LossLedger
    stamp_ns: array[int] = field(default_factory=lambda: array("q"))
    log_time_ns: array[int] = field(default_factory=lambda: array("q"))
    surplus: array[int] = field(default_factory=lambda: array("q"))
    empty_ns: array[int] = field(default_factory=lambda: array("q"))
    frame_ids: Counter[str] = field(default_factory=Counter)
    first: LaserSweep | None = None
    beams: int = 0
    longest_m: float = 0.0
    any_return: bool = False

    def add(self, sweep: LaserSweep, log_time_ns: int) -> None:
        """Take in a message."""
        if not len(sweep.ranges):
            what = "laser scan without ranges"
            self.losses.add(what, self.topic, effect="left out", time_ns=log_time_ns)
            self.add_damaged(log_time_ns)
            return
        if self.first is None:
            self.first, self.beams = sweep._replace(ranges=()), len(sweep.ranges)
        longest_m = longest_return(sweep)
        if math.isnan(longest_m):
            self.empty_ns.append(log_time_ns)
        else:
            unlimited = not math.isfinite(sweep.range_max_m) or sweep.range_max_m <= 0.0
            if unlimited or not self.any_return:
                self.longest_m = max(self.longest_m, longest_m)
            self.any_return = True
        self.frame_ids[sweep.frame_id] += 1
        self.stamp_ns.append(sweep.stamp_ns)
        self.log_time_ns.append(log_time_ns)
        self.surplus.append(min(len(sweep.ranges) - sweep.beams_told, 2**30))

    def add_damaged(self, log_time_ns: int) -> None:
        """Take note of a message that cannot be used."""
        self.stamp_ns.append(DAMAGED)
        self.log_time_ns.append(log_time_ns)
        self.surplus.append(0)


@dataclass
class Topic:
    """One topic of the log.

    ``problem`` says why messages cannot be read, if so; ``record`` depends on the kind;
    ``logged_ns`` is kept only if that was asked for.
    """

    name: str
    schema: str
    encoding: str
    form: Form = Form.OTHER
    messages: int = 0
    problem: str = ""
    built_in: bool = False
    first_ns: int = 0
    last_ns: int = 0
    logged_ns: array[int] = field(default_factory=lambda: array("q"))
    record: AudioRecord | LaserRecord | OdometryRecord | None = None
    info: AudioEncoding | None = None

    @property
    def kind(self) -> Kind:
        """What the topic carries."""
        return KINDS[self.form]

    def count(self, log_time_ns: int) -> None:
        """Count a message."""
        if not self.messages:
            self.first_ns = self.last_ns = log_time_ns
        elif log_time_ns > self.last_ns:
            self.last_ns = log_time_ns
        elif log_time_ns < self.first_ns:
            self.first_ns = log_time_ns
        self.messages += 1


class Survey:
    """What one pass over a log has found.

    Attributes
    ----------
    topics : dict
        By name.
    transforms : TransformRecord
    start_ns, end_ns : int
        Log time of the first and last message.
    messages : int
    """

    def __init__(self, log: McapLog, *, need_audio: bool = True, keep_times: bool = False) -> None:
        self.topics: dict[str, Topic] = {}
        self.transforms = TransformRecord()
        self.decoders = Decoders()
        self.losses = log.losses
        self.start_ns = self.end_ns = self.messages = 0
        self._need_audio, self._keep_times = need_audio, keep_times
        takers: dict[Channel, Callable[[Message], None]] = {}
        for message in log.messages():
            taker = takers.get(message.channel)
            if taker is None:
                taker = takers[message.channel] = self._taker(message.channel)
            taker(message)
            self.messages += 1
        self._remark_on_built_in_types()
        times = [(t.first_ns, t.last_ns) for t in self.topics.values() if t.messages]
        if times:
            self.start_ns, self.end_ns = min(t[0] for t in times), max(t[1] for t in times)
        self.losses.start_ns = self.start_ns

    def _remark_on_built_in_types(self) -> None:
        bare = [t.name for t in self.topics.values() if t.built_in and t.kind is not Kind.OTHER]
        self.losses.remark(
            "type without a definition in the log",
            ", ".join(sorted(bare)),
            count=len(bare),
            effect="the well-known definition of that name is used",
        )

    def forget_messages(self) -> None:
        """Let go of what was kept of single messages; what there is of topics stays.

        For when it is settled how to read them.
        """
        for topic in self.topics.values():
            if isinstance(topic.record, AudioRecord):
                topic.record = AudioRecord(topic.form, judged_ns=topic.record.judged_ns)
            elif topic.record is not None:
                topic.record = None
        self.transforms = TransformRecord()

    def of_kind(self, kind: Kind) -> list[Topic]:
        """Topics of a kind, in alphabetical order."""
        return sorted((t for t in self.topics.values() if t.kind is kind), key=lambda t: t.name)

    def _taker(self, channel: Channel) -> Callable[[Message], None]:
        """What to do with the messages of a channel."""
        topic = self.topics.setdefault(
            channel.topic, Topic(channel.topic, channel.schema_name, channel.encoding)
        )
        take: Callable[[Any, int], None] | None = None
        read: Decoder | None = None
        try:
            kind = self.decoders.type_of(channel)
            form = form_of(kind)
            if topic.form is Form.OTHER:
                topic.form, topic.built_in = form, kind.built_in
            if form is topic.form:
                take = self._take(topic)
                read = self.decoders.reader(channel) if take else None
        except SchemaError as error:
            topic.problem = str(error).splitlines()[0]

        def taker(message: Message) -> None:
            time = message.log_time_ns
            topic.count(time)
            if self._keep_times:
                topic.logged_ns.append(time)
            if take is None or read is None:
                self._skip(topic, time)
                return
            try:
                take(read(message.data), time)
            except _ATTRIBUTE_FAULTS:
                what = f"damaged {topic.kind} message"
                self.losses.add(what, topic.name, effect="left out", time_ns=time)
                self._skip(topic, time)

        return taker

    @staticmethod
    def _skip(topic: Topic, time: int) -> None:
        if isinstance(topic.record, AudioRecord | LaserRecord):
            topic.record.add_damaged(time)

    def _take(self, topic: Topic) -> Callable[[Any, int], None] | None:
        if topic.kind is Kind.AUDIO:
            if not self._need_audio:
                return None
            if not isinstance(topic.record, AudioRecord):
                topic.record = AudioRecord(topic.form)
            return topic.record.add
        if topic.kind is Kind.LASER:
            if not isinstance(topic.record, LaserRecord):
                topic.record = LaserRecord(topic.name, self.losses)
            return topic.record.add
        if topic.kind is Kind.ODOMETRY:
            if not isinstance(topic.record, OdometryRecord):
                topic.record = OdometryRecord()
            return topic.record.add
        if topic.kind is Kind.TRANSFORMS:
            return self._transform_taker(topic)
        if topic.kind is Kind.AUDIO_INFO:
            return lambda decoded, _: self._take_info(topic, decoded)
        return None

    def _transform_taker(self, topic: Topic) -> Callable[[Any, int], None]:
        static = topic.name.rstrip("/").endswith("static")

        def take(transforms: list[Transform], time: int) -> None:
            self.transforms.add(topic.name, transforms, time, static=static)

        return take

    @staticmethod
    def _take_info(topic: Topic, decoded: Any) -> None:
        try:
            topic.info = topic.info or info_encoding(decoded)
        except AudioFormatError as error:
            topic.problem = str(error)
