"""Logs cut off anywhere, beside the same logs ended properly at that time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from logwriter import LogWriter
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

from soundmap.config import Config
from soundmap.errors import SoundmapError
from soundmap.logs.log_files import log_files
from soundmap.logs.reader import McapLog
from soundmap.losses import LossLedger
from soundmap.outputs.progress import chosen_progress
from soundmap.replay import process


def ended_properly(src: Path, dst: Path, count: int) -> None:
    """The first ``count`` messages of a log, as a log of its own."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with src.open("rb") as stream, LogWriter(dst) as log:
        for record in StreamReader(stream).records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                if count == 0:
                    return
                count -= 1
                channel = channels[record.channel_id]
                schema = schemas[channel.schema_id]
                log.raw(
                    channel.topic,
                    (schema.name, schema.encoding, schema.data),
                    channel.message_encoding,
                    record.data,
                    record.log_time,
                    record.publish_time,
                )


def outcome(path: Path, map_path: Path | None, config: Config, **options: object) -> object:
    """Sources and trajectory of a log, or why there are none; and what was lost."""
    try:
        progress = chosen_progress(quiet=True)
        run = process(path, map_path, config, progress=progress, **options)  # type: ignore[arg-type]
    except SoundmapError as error:
        return type(error).__name__, str(error).partition(": ")[2]
    poses = np.column_stack([run.trajectory.time_ns, run.trajectory.pose])
    return run.sources, poses.tobytes()


def difference(
    src: Path, cut_bytes: int, map_path: Path | None, config: Config, **options: object
) -> str | None:
    """What is wrong with the results of a log cut after so many bytes; None if nothing is."""
    folders = [src.parent / "cut", src.parent / "proper"]
    for folder in folders:
        folder.mkdir(exist_ok=True)
    cut, proper = (folder / src.name for folder in folders)
    cut.write_bytes(src.read_bytes()[:cut_bytes])
    losses = LossLedger()
    try:
        found = sum(1 for _ in McapLog(cut, log_files(cut), losses).messages())
    except SoundmapError:
        return None
    if cut_bytes < src.stat().st_size and not losses.data_lost:
        return f"cut after {cut_bytes} bytes: nothing is said"
    ended_properly(src, proper, found)
    results = [outcome(path, map_path, config, **options) for path in (cut, proper)]
    if results[0] == results[1]:
        return None
    return f"cut after {cut_bytes} bytes, {found} messages: {results[0]} against {results[1]}"
