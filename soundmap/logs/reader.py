"""Messages of an MCAP log, in order, whatever state its files are in.

Memory holds two chunks at a time, however long the log.
"""

from __future__ import annotations

import hashlib
import struct
from bisect import bisect_left
from collections.abc import Iterable, Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

from soundmap.errors import LogError
from soundmap.logs.file_summary import MAGIC
from soundmap.logs.file_walk import FileWalk
from soundmap.logs.records import Batch, Channel, KnownChunk, Message, Wanted
from soundmap.losses import LossLedger


class McapLog:
    """A log of one or several MCAP files.

    The first complete pass of :meth:`messages` finds out which chunks are damaged and which topics
    each chunk holds; later passes skip what they do not need, and count nothing twice.

    Parameters
    ----------
    path : Path
        As the user named it: an ``.mcap`` file or a rosbag2 folder.
    files : tuple of Path
        The MCAP files in order.
    losses : LossLedger
        Where damage is counted.

    Raises
    ------
    LogError
        A file cannot be opened, or is not MCAP.
    """

    def __init__(self, path: Path, files: tuple[Path, ...], losses: LossLedger) -> None:
        self.path = path
        self.files = files
        self.losses = losses
        for file in files:
            _check_magic(file)
        # A log that is still being written is read up to where it ends now, in every pass.
        states = [file.stat() for file in files]
        self.sizes = tuple(state.st_size for state in states)
        self._changed_ns = tuple(state.st_mtime_ns for state in states)
        self.known_chunks: dict[tuple[int, int], KnownChunk] = {}
        self.known_channels: dict[int, dict[int, Channel]] = {}
        self._channel_sets: dict[frozenset[Channel], frozenset[Channel]] = {}
        self._surveyed = False

    @property
    def size_bytes(self) -> int:
        """Size of all files."""
        return sum(self.sizes)

    def fingerprint(self) -> str:
        """SHA-256 over the sizes of the files and samples of their content; cheap for any size."""
        digest = hashlib.sha256()
        for file, size in zip(self.files, self.sizes, strict=True):
            digest.update(struct.pack("<Q", size))
            step = max((size - 2**20) // 7, 2**20)
            with file.open("rb") as stream:
                for offset in [*range(0, size, step), max(size - 2**20, 0)]:
                    stream.seek(offset)
                    digest.update(stream.read(min(2**20, size - offset)))
        return digest.hexdigest()

    def messages(self, wanted: Wanted = lambda _: True) -> Iterator[Message]:
        """Messages of the wanted channels in the order of their log time.

        Order is restored inside a chunk and across neighbouring chunks. The order of a topic is
        the same in every pass, whatever else is wanted. The first pass should want everything that
        later passes will want.
        """
        for number, file in enumerate(self.files):
            try:
                yield from _in_order(FileWalk(self, number, file, wanted).batches())
            except (OSError, struct.error) as error:
                self._refuse_changes()
                raise LogError(f"{file}: cannot be read on ({error}). Is the disk sound?") from None
        self._refuse_changes()
        self._surveyed = True

    def _refuse_changes(self) -> None:
        """A log may grow while it is read, but not become another: passes would not fit together.

        Raises
        ------
        LogError
            It has.
        """
        for file, size, changed_ns in zip(self.files, self.sizes, self._changed_ns, strict=True):
            try:
                state = file.stat()
            except OSError:
                state = None
            grown = state is not None and state.st_size > size
            if not grown and (
                state is None or (state.st_size, state.st_mtime_ns) != (size, changed_ns)
            ):
                raise LogError(
                    f"{file}: has been changed or removed while it was read. Try again once nobody "
                    "writes to it."
                )

    def remember_chunk(
        self, place: tuple[int, int], channels: Iterable[Channel], first_ns: int, last_ns: int
    ) -> None:
        """Keep what a chunk holds; chunks with the same channels share the set of them."""
        own = frozenset(channels)
        shared = self._channel_sets.setdefault(own, own)
        self.known_chunks[place] = KnownChunk(shared, first_ns, last_ns)

    def count(self, what: str, where: str, effect: str, *, count: int = 1) -> None:
        """Count damage, unless an earlier pass has."""
        if not self._surveyed:
            self.losses.add(what, where, effect=effect, count=count)


def _in_order(batches: Iterator[Batch]) -> Iterator[Message]:
    """Merge batches over neighbours: what is not older than the latest but one is held back.

    What goes out when depends on the times of all messages, not only of those wanted, so that the
    order of a topic is the same in every pass.
    """
    held: list[Message] = []
    latest_ns, settled_ns = 0, 0  # of all batches, and of all but the last
    for batch in batches:
        if held and held[-1].log_time_ns > batch.first_ns:
            held = sorted([*held, *batch.messages], key=itemgetter(1))
        else:
            held = [*held, *batch.messages]
        ready = bisect_left(held, max(batch.first_ns, settled_ns), key=itemgetter(1))
        yield from held[:ready]
        held = held[ready:]
        settled_ns, latest_ns = latest_ns, max(latest_ns, batch.last_ns)
    yield from held


def _check_magic(file: Path) -> None:
    """Refuse what is not MCAP, with a word on what it is."""
    try:
        with file.open("rb") as stream:
            start = stream.read(16)
    except OSError as error:
        raise LogError(f"{file}: cannot be opened ({error.strerror}). Check the path.") from None
    if start.startswith(MAGIC):
        return
    if not start:
        raise LogError(f"{file}: the file is empty. Was the recording stopped before it began?")
    known: dict[bytes, Any] = {
        b"\x28\xb5\x2f\xfd": "compressed as a whole; unpack it first: zstd -d FILE",
        b"\x04\x22\x4d\x18": "compressed as a whole; unpack it first: lz4 -d FILE",
        b"#ROSBAG V2.0": "a ROS 1 bag; convert it first: mcap convert FILE OUT.mcap",
        b"SQLite format 3": "a rosbag2 database; convert it first: mcap convert FILE OUT.mcap",
    }
    what = next((text for magic, text in known.items() if start.startswith(magic)), None)
    raise LogError(f"{file}: not an MCAP file, but {what or 'something else'}.")
