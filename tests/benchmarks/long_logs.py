"""Logs of any length: one simulated lap, driven over and over.

A robot drives round the block of ``configs/scenes/corridor.toml`` and comes to rest where it
started, facing the same way. So the lap can be repeated: stamps move on by its duration, and
odometry by its own idea of where the lap ended, which is not quite where it began. Sound, walls
and errors are those of the simulator; only that they repeat after a lap is unlike the world.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from soundmap.geometry import composed, inverted
from soundmap.simulate.simulation import simulated_run

SCENE = Path(__file__).parents[2] / "configs" / "scenes" / "corridor.toml"
LAP_M = "[[3.0, 1.1], [7.0, 1.0], [7.0, 7.0], [1.0, 7.0], [1.0, 1.1], [3.0, 1.1]]"
STORE = get_typestore(Stores.ROS2_HUMBLE)
_STAMP = struct.Struct("<iI")

Rewriter = Callable[[bytes, int, np.ndarray], bytes]


def lap(cache: Path) -> Path:
    """Folder with the log of one lap, its map and its robot file; simulated unless it is there."""
    folder = cache / "lap"
    if not folder.exists():
        cache.mkdir(parents=True, exist_ok=True)
        text, changed = re.subn(
            r"^way_points_m = .*$", f"way_points_m = {LAP_M}", SCENE.read_text(), flags=re.M
        )
        if changed != 1:
            raise SystemExit(f"{SCENE}: should have one line 'way_points_m = ...'")
        scene = cache / "lap.toml"
        scene.write_text(text)
        simulated_run(scene, folder, run="run1", force=False, progress=lambda _: None)
    return folder


def long_log(cache: Path, minutes: float, *, compression: str = "zstd") -> Path:
    """A log of at least so many minutes, made unless it is there."""
    source = lap(cache) / "run1.mcap"
    path = cache / f"{minutes:g}min-{compression}.mcap"
    if not path.exists():
        part = path.with_suffix(".part")
        _repeat(source, part, minutes * 60.0, compression)
        part.rename(path)
    return path


def _repeat(source: Path, path: Path, seconds: float, compression: str) -> None:
    with source.open("rb") as stream:
        messages = list(make_reader(stream).iter_messages(log_time_order=True))
    first_ns, last_ns = messages[0][2].log_time, messages[-1][2].log_time
    period_ns = -(-(last_ns - first_ns) // 100_000_000) * 100_000_000
    poses = [
        _pose(STORE.deserialize_cdr(message.data, schema.name).pose.pose)
        for schema, _, message in messages
        if schema.name == "nav_msgs/msg/Odometry"
    ]
    end = composed(poses[-1], inverted(poses[0]))
    with path.open("wb") as file:
        writer = Writer(
            file, chunk_size=768 * 1024, compression=CompressionType[compression.upper()]
        )
        writer.start(profile="ros2", library="soundmap benchmark")
        ids: dict[str, int] = {}
        for schema, channel, _ in messages:
            if channel.topic not in ids:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_id
                )
        origin = np.zeros(3)
        for turn in range(int(np.ceil(seconds * 1e9 / period_ns))):
            shift = turn * period_ns
            for schema, channel, message in messages:
                if turn and channel.topic == "/tf_static":
                    continue
                rewrite = REWRITERS.get(schema.name, _header_moved)
                writer.add_message(
                    ids[channel.topic],
                    message.log_time + shift,
                    rewrite(message.data, shift, origin) if turn else message.data,
                    message.publish_time + shift,
                )
            origin = composed(origin, end)
        writer.finish()


def _header_moved(data: bytes, shift_ns: int, _: np.ndarray) -> bytes:
    """A little-endian CDR message whose first field is a header."""
    seconds, nanoseconds = _STAMP.unpack_from(data, 4)
    moved = divmod(seconds * 1_000_000_000 + nanoseconds + shift_ns, 1_000_000_000)
    return data[:4] + _STAMP.pack(*moved) + data[12:]


def _odometry_moved(data: bytes, shift_ns: int, origin: np.ndarray) -> bytes:
    data = _header_moved(data, shift_ns, origin)
    message = STORE.deserialize_cdr(data, "nav_msgs/msg/Odometry")
    _move(message.pose.pose.position, message.pose.pose.orientation, origin)
    return bytes(STORE.serialize_cdr(message, "nav_msgs/msg/Odometry"))


def _transforms_moved(data: bytes, shift_ns: int, origin: np.ndarray) -> bytes:
    message = STORE.deserialize_cdr(data, "tf2_msgs/msg/TFMessage")
    for edge in message.transforms:
        total = edge.header.stamp.sec * 1_000_000_000 + edge.header.stamp.nanosec + shift_ns
        edge.header.stamp.sec, edge.header.stamp.nanosec = divmod(total, 1_000_000_000)
        if edge.header.frame_id == "odom":
            _move(edge.transform.translation, edge.transform.rotation, origin)
    return bytes(STORE.serialize_cdr(message, "tf2_msgs/msg/TFMessage"))


def _move(position: Any, rotation: Any, origin: np.ndarray) -> None:
    pose = composed(origin, _pose(SimpleNamespace(position=position, orientation=rotation)))
    position.x, position.y = float(pose[0]), float(pose[1])
    rotation.z, rotation.w = float(np.sin(pose[2] / 2.0)), float(np.cos(pose[2] / 2.0))


def _pose(pose: Any) -> np.ndarray:
    heading = 2.0 * np.arctan2(pose.orientation.z, pose.orientation.w)
    return np.array([pose.position.x, pose.position.y, heading])


REWRITERS: dict[str, Rewriter] = {
    "nav_msgs/msg/Odometry": _odometry_moved,
    "tf2_msgs/msg/TFMessage": _transforms_moved,
}
