"""What a damaged log may do to its reader, and what it may not."""

from __future__ import annotations

import hashlib
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import mutations
import small_logs
from mcap.writer import CompressionType, IndexType

from soundmap.config import Config
from soundmap.errors import SoundmapError
from soundmap.logs.log_files import log_files
from soundmap.logs.reader import McapLog
from soundmap.logs.robot_log import open_log
from soundmap.losses import LossLedger

SECONDS = 0.8
CONFIG = Config.model_validate(
    {"array": {"kind": "circle", "microphones": small_logs.MICROPHONES, "radius_m": 0.1}}
)
NO_SUMMARY = {
    "index_types": IndexType.NONE,
    "use_statistics": False,
    "use_summary_offsets": False,
    "repeat_channels": False,
    "repeat_schemas": False,
}
KINDS: dict[str, dict[str, Any]] = {
    "zstd": {},
    "lz4": {"compression": CompressionType.LZ4},
    "plain": {"compression": CompressionType.NONE},
    "no summary": NO_SUMMARY,
    "no chunks": {"use_chunking": False},
    "no checksums": {"enable_crcs": False},
}
"""Ways in which logs are written, by name."""

UNPROTECTED = ("no chunks", "no checksums")
"""Nobody can tell damage within a message of these."""


class Read(NamedTuple):
    """What was read from a log.

    ``messages`` and ``sensors`` are digests of the messages and of what the sensors measured;
    ``sensors`` is an error's text if nothing is usable.
    """

    messages: Counter[tuple[str, int, bytes]]
    sensors: str
    usable: bool
    losses: tuple[str, ...]
    data_lost: bool


def read(path: Path) -> Read | None:
    """All of a log; None if it is refused as a whole."""
    losses = LossLedger()
    try:
        log = McapLog(path, log_files(path), losses)
        messages = Counter(
            (m.channel.topic, m.log_time_ns, hashlib.blake2b(m.data, digest_size=8).digest())
            for m in log.messages()
        )
    except SoundmapError:
        return None
    try:
        robot = open_log(path, CONFIG)
        sensors = hashlib.sha256(robot.odometry.time_ns.tobytes() + robot.odometry.pose.tobytes())
        for scan in robot.lasers():
            sensors.update(f"scan {scan.time_ns}".encode() + scan.range_m.tobytes())
        for block in robot.audio():
            sensors.update(f"{block.time_ns} {block.continues}".encode() + block.samples.tobytes())
        what, lost = tuple(loss.what for loss in robot.losses), robot.losses.data_lost
        return Read(messages, sensors.hexdigest(), True, what, lost)
    except SoundmapError as error:
        what = tuple(loss.what for loss in losses)
        return Read(messages, str(error), False, what, losses.data_lost)


class Fuzzing:
    """Logs to be damaged, one for each way of writing, and what they hold while they are sound."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        end_ns = small_logs.START_NS + int(SECONDS * 1e9)
        drive = [event for event in small_logs.events() if event.time_ns < end_ns]
        self.content: dict[str, bytes] = {}
        self.sound: dict[str, Read] = {}
        for kind, options in KINDS.items():
            path = small_logs.write(folder / f"{kind}.mcap", drive, **options)
            self.content[kind] = path.read_bytes()
            found = read(path)
            assert found is not None
            assert found.usable
            assert not found.losses
            self.sound[kind] = found

    def complaints(self, seed: int) -> list[str]:
        """What is wrong with how the damaged log of that seed is read; faults raise."""
        kind = list(KINDS)[seed % len(KINDS)]
        inside = seed // len(KINDS) % 3 == 2
        content, done = mutations.mutated(seed, self.content[kind], inside=inside)
        path = self.folder / f"damaged-{seed}.mcap"
        path.write_bytes(content)
        found = read(path)
        path.unlink()
        if found is None or inside or kind in UNPROTECTED:
            return []
        sound, name = self.sound[kind], f"seed {seed}, {kind}, {done}"
        wrong = []
        if foreign := found.messages.keys() - sound.messages.keys():
            wrong.append(f"{name}: {len(foreign)} messages that are not in the sound log")
        # A whole chunk that is not there, and that nothing counts, cannot be missed.
        countable = kind != "no summary" or not {"rearranged", "lying_record"} & set(
            done.split("+")
        )
        missing = (sound.messages - found.messages).total()
        if missing and countable and not found.data_lost:
            wrong.append(f"{name}: {missing} messages are missing, and nothing is said")
        if found.usable and found.sensors != sound.sensors and countable and not found.data_lost:
            wrong.append(f"{name}: the sensors differ, and nothing is said: {found.losses}")
        return wrong
