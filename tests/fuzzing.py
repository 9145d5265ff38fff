"""What a damaged log may do to its reader, and what it may not."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import mutations
import small_logs
import worlds
from mcap.writer import CompressionType, IndexType
from typer.testing import CliRunner

from soundmap.cli import app
from soundmap.config import Config
from soundmap.errors import SoundmapError
from soundmap.logs.log_files import log_files
from soundmap.logs.reader import McapLog
from soundmap.logs.robot_log import open_log
from soundmap.losses import LossLedger
from soundmap.map_file import map_files

SECONDS, PROCESSED_SECONDS = 0.8, 3.0
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


class Damage(NamedTuple):
    """Which log a seed damages, and where."""

    seed: int
    kind: str
    inside: bool

    @classmethod
    def of(cls, seed: int) -> Damage:
        return cls(seed, list(KINDS)[seed % len(KINDS)], seed // len(KINDS) % 3 == 2)

    def done_to(self, content: dict[str, bytes]) -> tuple[bytes, str]:
        """The damaged log, and what was done to it."""
        return mutations.mutated(self.seed, content[self.kind], inside=self.inside)

    @property
    def shows(self) -> bool:
        """Whether checksums can show it."""
        return not self.inside and self.kind not in UNPROTECTED

    def counts(self, done: str) -> bool:
        """Whether what is missing can be missed: not a whole chunk that nothing counts."""
        gone = {"rearranged", "lying_record"} & set(done.split("+"))
        return self.kind != "no summary" or not gone


def written(folder: Path, seconds: float) -> dict[str, bytes]:
    """The beginning of the drive in every way of writing; files are named after them."""
    end_ns = small_logs.START_NS + int(seconds * 1e9)
    drive = [event for event in small_logs.events() if event.time_ns < end_ns]
    return {
        kind: small_logs.write(folder / f"{kind}.mcap", drive, **options).read_bytes()
        for kind, options in KINDS.items()
    }


class Fuzzing:
    """Logs to be damaged, one for each way of writing, and what they hold while they are sound."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.content = written(folder, SECONDS)
        self.sound: dict[str, Read] = {}
        for kind in KINDS:
            found = read(folder / f"{kind}.mcap")
            assert found is not None
            assert found.usable
            assert not found.losses
            self.sound[kind] = found

    def complaints(self, seed: int) -> list[str]:
        """What is wrong with how the damaged log of that seed is read; faults raise."""
        damage = Damage.of(seed)
        content, done = damage.done_to(self.content)
        path = self.folder / f"damaged-{seed}.mcap"
        path.write_bytes(content)
        found = read(path)
        path.unlink()
        if found is None or not damage.shows:
            return []
        sound, name = self.sound[damage.kind], f"seed {seed}, {damage.kind}, {done}"
        wrong = []
        if foreign := found.messages.keys() - sound.messages.keys():
            wrong.append(f"{name}: {len(foreign)} messages that are not in the sound log")
        missing = (sound.messages - found.messages).total()
        countable = damage.counts(done)
        if missing and countable and not found.data_lost:
            wrong.append(f"{name}: {missing} messages are missing, and nothing is said")
        if found.usable and found.sensors != sound.sensors and countable and not found.data_lost:
            wrong.append(f"{name}: the sensors differ, and nothing is said: {found.losses}")
        return wrong


class FuzzedRuns:
    """The same with the whole of ``soundmap process``, from the command line to its files."""

    RESULTS = ("sources.csv", "trajectory.tum", "power_map.npz", "audio_scans.npz")

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.content = written(folder, PROCESSED_SECONDS)
        for name, content in map_files(worlds.room()).items():
            (folder / name).write_bytes(content)
        (folder / "robot.toml").write_text(small_logs.ARRAY)
        self.sound = {kind: self._results(folder / f"{kind}.mcap")[0] for kind in KINDS}

    def _results(self, log: Path) -> tuple[dict[str, bytes], bool]:
        """Files of a run, and whether it says that data was lost; no file if it is refused."""
        out = self.folder / "out"
        command: list[object] = ["process", log, "--out", out, "--force", "--json"]
        command += ["--map", self.folder / "map.yaml", "--config", self.folder / "robot.toml"]
        command += ["--start-pose", "1,1,0", "--figures", "none", "--no-cache"]
        result = CliRunner().invoke(app, [str(argument) for argument in command])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        if result.exit_code == 0:
            lost = any(loss["data_lost"] for loss in json.loads(result.stdout)["losses"])
            return {name: (out / name).read_bytes() for name in self.RESULTS}, lost
        said = result.stderr.splitlines()
        assert result.exit_code in (1, 2, 3, 4), result.exit_code
        assert len(said) == 1, said
        assert said[0].startswith("soundmap: error: "), said
        assert result.stdout == ""
        return {}, True

    def complaints(self, seed: int) -> list[str]:
        """What is wrong with the run on the damaged log of that seed; faults raise."""
        damage = Damage.of(seed)
        content, done = damage.done_to(self.content)
        path = self.folder / f"damaged-{seed}.mcap"
        path.write_bytes(content)
        found, lost = self._results(path)
        path.unlink()
        if lost or found == self.sound[damage.kind] or not (damage.shows and damage.counts(done)):
            return []
        return [f"seed {seed}, {damage.kind}, {done}: other results, and nothing is said"]
