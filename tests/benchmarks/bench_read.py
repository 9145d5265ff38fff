"""How fast a log is read, beside plain iteration with mcap and with rosbags.

    python tests/benchmarks/bench_read.py --cache DIR [--minutes 0.5] [--repeats 3]

One log of the kind of `long_logs.py`, zstd. The others only hand out messages, undecoded and then
decoded; the program's two passes end with what the stages get: the survey with odometry, clocks
and checks of the microphones, and blocks of samples and laser scans at their times.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from long_logs import lap, long_log
from machine import machine
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from soundmap.config import loaded_config
from soundmap.logs.reader import McapLog
from soundmap.logs.robot_log import open_log
from soundmap.losses import LossLedger

METADATA = """rosbag2_bagfile_information:
  version: 5
  storage_identifier: mcap
  duration: {{nanoseconds: {duration}}}
  starting_time: {{nanoseconds_since_epoch: {start}}}
  message_count: {count}
  topics_with_message_count:
{topics}
  compression_format: ""
  compression_mode: ""
  relative_file_paths: [log.mcap]
  files: []
"""
TOPIC = """    - topic_metadata:
        {{name: {name}, type: {type}, serialization_format: cdr, offered_qos_profiles: ""}}
      message_count: {count}"""


def bag_folder(log: Path, folder: Path) -> Path:
    """The log as a rosbag2 folder, which rosbags wants."""
    (folder / "log.mcap").symlink_to(log.resolve())
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    topics = [
        TOPIC.format(
            name=channel.topic,
            type=summary.schemas[channel.schema_id].name,
            count=counts.get(channel.id, 0),
        )
        for channel in summary.channels.values()
    ]
    start, end = summary.statistics.message_start_time, summary.statistics.message_end_time
    text = METADATA.format(
        duration=end - start,
        start=start,
        count=summary.statistics.message_count,
        topics="\n".join(topics),
    )
    (folder / "metadata.yaml").write_text(text)
    return folder


def count(items) -> int:  # type: ignore[no-untyped-def]
    return sum(1 for _ in items)


def mcap_stream(log: Path) -> int:
    """Records by mcap's StreamReader, checksums not looked at."""
    with log.open("rb") as stream:
        return count(r for r in StreamReader(stream).records if type(r).__name__ == "Message")


def mcap_reader(log: Path) -> int:
    """Messages by mcap's indexed reader, in the order of log time."""
    with log.open("rb") as stream:
        return count(make_reader(stream).iter_messages())


def rosbags_raw(folder: Path) -> int:
    """Messages by rosbags, undecoded."""
    with Reader(folder) as reader:
        return count(reader.messages())


def rosbags_decoded(folder: Path, log: Path) -> int:
    """Messages by rosbags, decoded with the definitions of the log."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    for schema in summary.schemas.values():
        types = get_types_from_msg(schema.data.decode(), schema.name)
        store.register({name: own for name, own in types.items() if name not in store.fielddefs})
    with Reader(folder) as reader:
        return count(
            store.deserialize_cdr(data, connection.msgtype)
            for connection, _, data in reader.messages()
        )


def seconds(action: Callable[[], int], repeats: int) -> tuple[list[float], list[float], int]:
    """CPU and wall times of several calls, sorted, and what they counted."""
    cpu, wall, counted = [], [], 0
    for _ in range(repeats):
        began, began_cpu = time.perf_counter(), time.process_time()
        counted = action()
        cpu.append(time.process_time() - began_cpu)
        wall.append(time.perf_counter() - began)
    return sorted(cpu), sorted(wall), counted


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cache", type=Path, required=True, help="where the logs are kept")
    parser.add_argument("--minutes", type=float, default=0.5)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    log = long_log(options.cache, options.minutes)
    config = loaded_config([lap(options.cache) / "robot.toml"])
    opened = open_log(log, config)
    with tempfile.TemporaryDirectory() as temporary:
        folder = bag_folder(log, Path(temporary))
        forms: list[tuple[str, Callable[[], int]]] = [
            ("soundmap, messages", lambda: count(McapLog(log, (log,), LossLedger()).messages())),
            ("soundmap, first pass", lambda: len(open_log(log, config).odometry)),
            ("soundmap, second pass", lambda: count(opened.measurements())),
            ("mcap StreamReader", lambda: mcap_stream(log)),
            ("mcap reader in log order", lambda: mcap_reader(log)),
            ("rosbags, undecoded", lambda: rosbags_raw(folder)),
            ("rosbags, decoded", lambda: rosbags_decoded(folder, log)),
        ]
        print(machine("mcap", "rosbags", "zstandard"))
        print(f"{opened.duration_s:.0f} s of log, {log.stat().st_size / 1e6:.0f} MB, zstd\n")
        print("| form | counted | CPU s | wall s | CPU: x real time | ratio |")
        print("|---|---|---|---|---|---|")
        baseline = 0.0
        for name, action in forms:
            cpu, wall, counted = seconds(action, options.repeats)
            baseline = baseline or cpu[0]
            print(f"| {name} | {counted} | {cpu[0]:.2f} to {cpu[-1]:.2f} | {wall[0]:.2f} ", end="")
            print(f"| {opened.duration_s / cpu[0]:.0f} | {cpu[0] / baseline:.2f} |", flush=True)


if __name__ == "__main__":
    main()
