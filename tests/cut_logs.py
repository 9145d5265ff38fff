"""Logs cut off anywhere, beside the same logs ended properly at that time."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

from logwriter import LogWriter
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

from soundmap.config import Config
from soundmap.errors import SoundmapError
from soundmap.logs.log_files import log_files
from soundmap.logs.reader import McapLog
from soundmap.losses import LossLedger
from soundmap.outputs.illustrator import Illustrator
from soundmap.outputs.new_folder import new_folder
from soundmap.outputs.picture_format import PictureFormat
from soundmap.outputs.progress import chosen_progress
from soundmap.outputs.run_folder import write_run
from soundmap.replay import process


def whole_messages(path: Path) -> int:
    """How many messages the official reader gets out of a log before it gives up."""
    count = 0
    with path.open("rb") as stream:
        try:
            for record in StreamReader(stream).records:
                count += isinstance(record, Message)
        except (McapError, struct.error):
            return count
    return count


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


RESULTS = ("sources.csv", "trajectory.tum", "audio_scans.npz")


def outcome(
    path: Path, map_path: Path | None, config: Config, **options: object
) -> dict[str, bytes] | str:
    """What is found in a log, written beside it, or why there is nothing."""
    try:
        progress = chosen_progress(quiet=True)
        run = process(path, map_path, config, progress=progress, **options)  # type: ignore[arg-type]
    except SoundmapError as error:
        # A log that ended on purpose has lost nothing, and its name is another.
        told = str(error).partition(": ")[2].partition(" Lost before that: ")[0]
        return f"{type(error).__name__}: {told}"
    with new_folder(path.parent / "out", force=True) as folder:
        write_run(run, folder, Illustrator(PictureFormat.NONE))
    return {name: (path.parent / "out" / name).read_bytes() for name in RESULTS}


def differing(a: dict[str, bytes] | str, b: dict[str, bytes] | str) -> str:
    """In what two outcomes differ."""
    if isinstance(a, str) or isinstance(b, str):
        words = [outcome if isinstance(outcome, str) else "results" for outcome in (a, b)]
        return f"{words[0]} against {words[1]}"
    return ", ".join(name for name in RESULTS if a[name] != b[name])


class Compared(NamedTuple):
    """A cut log beside the one that was ended properly there.

    ``wrong`` is what is wrong with its results, None if nothing is; ``usable`` whether there are
    any.
    """

    wrong: str | None
    usable: bool = False


def compared(
    src: Path, cut_bytes: int, map_path: Path | None, config: Config, **options: object
) -> Compared:
    """What becomes of a log cut after so many bytes."""
    folders = [src.parent / "cut", src.parent / "proper"]
    for folder in folders:
        folder.mkdir(exist_ok=True)
    cut, proper = (folder / src.name for folder in folders)
    cut.write_bytes(src.read_bytes()[:cut_bytes])
    losses = LossLedger()
    try:
        found = sum(1 for _ in McapLog(cut, log_files(cut), losses).messages())
    except SoundmapError:
        return Compared(None)
    whole = whole_messages(cut)
    if found != whole:
        return Compared(f"cut after {cut_bytes} bytes: {found} messages read of {whole} whole ones")
    if cut_bytes < src.stat().st_size and not losses.data_lost:
        return Compared(f"cut after {cut_bytes} bytes: nothing is said")
    ended_properly(src, proper, whole)
    results = [outcome(path, map_path, config, **options) for path in (cut, proper)]
    wrong = f"cut after {cut_bytes} bytes, {whole} messages: {differing(*results)}"
    return Compared(wrong if results[0] != results[1] else None, not isinstance(results[0], str))
