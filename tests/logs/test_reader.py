"""Files in every state: the official conformance files, and damage done on purpose."""

import csv
import struct
from pathlib import Path

import mutations
import numpy as np
import pytest
import zstandard
from logwriter import START_NS, LogWriter
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType

from soundmap.errors import LogError
from soundmap.logs.log_files import log_files
from soundmap.logs.reader import McapLog
from soundmap.logs.records import KnownChunk
from soundmap.losses import LossLedger

SHARED = Path(__file__).parents[2] / ".." / "shared" / "data" / "mcap"
needs_shared = pytest.mark.skipif(
    not SHARED.is_dir(), reason="the conformance files (../shared/data/mcap) are not here"
)
BYTES = ("bytes", "", b"")
MISSING = "message that the file's own summary counts is missing"


def read(path):
    losses = LossLedger()
    log = McapLog(path, log_files(path), losses)
    return list(log.messages()), losses, log


def write(path, count=200, size=500, times=None, **options):
    options.setdefault("chunk_size", 10_000)
    with LogWriter(path, **options) as log:
        for i in range(count):
            time = START_NS + (i if times is None else times[i])
            # Bytes that do not compress, so that chunks stay as large as they are.
            payload = struct.pack("<I", i) + np.random.default_rng(i).bytes(size)
            log.raw("/a" if i % 2 else "/b", BYTES, "raw", payload, time)
    return path


def numbers(messages):
    return [struct.unpack_from("<I", m.data)[0] for m in messages]


@needs_shared
def test_all_416_conformance_files_give_the_messages_of_the_manifest():
    with (SHARED / "MANIFEST.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 416
    for row in rows:
        messages, losses, _ = read(SHARED / "conformance" / row["file"])
        assert len(messages) == int(row["messages"]), row["file"]
        assert len(losses) == 0, row["file"]


@needs_shared
def test_all_rosbag2_recordings_give_the_messages_that_the_official_reader_finds():
    files = sorted((SHARED / "rosbag2").glob("*.mcap"))
    assert len(files) == 20
    for file in files:
        with file.open("rb") as stream:
            expected = [r for r in StreamReader(stream).records if isinstance(r, Message)]
        messages, losses, _ = read(file)
        assert sorted(bytes(m.data) for m in messages) == sorted(r.data for r in expected)
        assert len(losses) == 0


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunking", [True, False])
@pytest.mark.parametrize("extras", [True, False])
def test_compression_chunks_and_index_do_not_matter(tmp_path, compression, chunking, extras):
    path = write(
        tmp_path / "log.mcap",
        compression=compression,
        use_chunking=chunking,
        index_types=IndexType.ALL if extras else IndexType.NONE,
        use_statistics=extras,
        use_summary_offsets=extras,
        repeat_channels=extras,
        repeat_schemas=extras,
        enable_crcs=extras,
    )
    messages, losses, _ = read(path)
    assert numbers(messages) == list(range(200))
    assert len(losses) == 0


def test_order_is_restored_inside_chunks_and_across_neighbours(tmp_path):
    # Every message is logged up to 15 places late or early; a chunk holds about 20.
    times = [i + (7 * i) % 15 for i in range(400)]
    path = write(tmp_path / "log.mcap", 400, times=times)
    messages, _, _ = read(path)
    logged = [m.log_time_ns for m in messages]
    assert logged == sorted(logged)
    assert sorted(numbers(messages)) == list(range(400))


@pytest.mark.parametrize("chunking", [True, False])
@pytest.mark.parametrize("disorder", [3, 30, 400])
def test_a_topic_has_the_same_order_in_every_pass_however_disordered(tmp_path, chunking, disorder):
    rng = np.random.default_rng(disorder)
    with LogWriter(tmp_path / "log.mcap", chunk_size=1000, use_chunking=chunking) as log:
        for i in range(600):
            time = START_NS + 10 * (i + int(rng.integers(-disorder, disorder + 1)))
            payload = struct.pack("<I", i) + bytes(int(rng.integers(40)))
            log.raw(f"/{'abc'[rng.integers(3)]}", BYTES, "raw", payload, time)
    messages, _, log = read(tmp_path / "log.mcap")
    assert len(messages) == 600
    for topic in ("/a", "/b", "/c"):
        of_topic = [message for message in messages if message.channel.topic == topic]
        again = list(log.messages(lambda channel, topic=topic: channel.topic == topic))
        assert numbers(again) == numbers(of_topic)


def test_a_channel_told_in_a_chunk_without_its_messages_is_known_in_later_passes(tmp_path):
    with LogWriter(tmp_path / "log.mcap", chunk_size=1000, repeat_channels=False) as log:
        log.raw("/late", BYTES, "raw", struct.pack("<I", 0), START_NS)
        for i in range(100):
            log.raw("/early", BYTES, "raw", bytes(100), START_NS + 1 + i)
        for i in range(50):
            log.raw("/late", BYTES, "raw", struct.pack("<I", 1 + i), START_NS + 200 + i)
    _, _, log = read(tmp_path / "log.mcap")
    log.known_chunks[0, min(offset for _, offset in log.known_chunks)] = KnownChunk(
        frozenset(), 0, 0
    )
    assert len(list(log.messages(lambda channel: channel.topic == "/late"))) == 50


@pytest.mark.parametrize("chunking", [True, False])
def test_a_log_that_grows_is_read_as_it_was_when_it_was_opened(tmp_path, chunking):
    content = write(tmp_path / "log.mcap", use_chunking=chunking).read_bytes()
    growing, half = tmp_path / "growing.mcap", len(content) // 2
    growing.write_bytes(content[:half])
    losses = LossLedger()
    log = McapLog(growing, log_files(growing), losses)
    fingerprint = log.fingerprint()
    messages = log.messages()
    first = [next(messages)]
    with growing.open("ab") as file:
        file.write(content[half:])
    first += messages
    assert 80 < len(first) < 110
    assert numbers(log.messages()) == numbers(first)
    assert log.fingerprint() == fingerprint
    assert [loss.what for loss in losses] == ["log ends early"]


@pytest.mark.parametrize("chunking", [True, False])
def test_a_log_cut_anywhere_gives_what_is_whole_and_says_so(tmp_path, chunking):
    path = write(tmp_path / "log.mcap", use_chunking=chunking)
    content = path.read_bytes()
    for share in (0.2, 0.5, 0.83):
        cut = tmp_path / f"cut{share}.mcap"
        cut.write_bytes(content[: int(share * len(content))])
        messages, losses, _ = read(cut)
        got = numbers(messages)
        assert got == list(range(len(got)))
        assert len(got) > (share - 0.15) * 200
        assert [loss.what for loss in losses] == ["log ends early"]


def test_without_footer_and_summary_nothing_is_missing(tmp_path):
    path = write(tmp_path / "log.mcap")
    content = path.read_bytes()
    for lost in (8, 30, 200):
        path.write_bytes(content[:-lost])
        assert len(read(path)[0]) == 200


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_flipped_bit_costs_its_chunk_and_is_counted_once(tmp_path, compression):
    path = write(tmp_path / "log.mcap", compression=compression, enable_crcs=True, size=2000)
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 0x10
    path.write_bytes(content)
    messages, losses, log = read(path)
    assert 150 < len(messages) < 200
    missing = 200 - len(messages)
    assert [(loss.what, loss.count) for loss in losses] == [
        ("damaged chunk", 1),
        (MISSING, missing),
    ]
    assert len(list(log.messages())) == len(messages)
    assert [loss.count for loss in losses] == [1, missing]


def test_a_broken_record_length_costs_no_more_than_the_way_to_the_next_chunk(tmp_path):
    path = write(tmp_path / "log.mcap", compression=CompressionType.NONE)
    content = bytearray(path.read_bytes())
    first = content.index(b"\x06", 8 + 9)
    while struct.unpack_from("<Q", content, first + 1)[0] > len(content):
        first = content.index(b"\x06", first + 1)
    content[first + 7] = 0xFF
    path.write_bytes(content)
    messages, losses, _ = read(path)
    assert len(messages) > 150
    assert [loss.what for loss in losses] == ["unreadable record", MISSING]


@pytest.mark.parametrize("chunking", [True, False])
def test_without_an_index_reading_goes_on_at_the_next_sound_record(tmp_path, chunking):
    path = write(tmp_path / "log.mcap", use_chunking=chunking)
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 4096] = bytes(4096)
    path.write_bytes(content[:-100])
    messages, losses, _ = read(path)
    assert len(messages) >= 160
    assert numbers(messages)[-1] == 199
    assert losses.data_lost


def test_a_chunk_that_was_cut_out_is_missed_if_the_summary_counts_its_messages(tmp_path):
    path = write(tmp_path / "log.mcap")
    records = mutations.records_of(path.read_bytes())
    del records[next(i for i, record in enumerate(records) if record[0] == 6)]
    path.write_bytes(mutations.joined(records))
    messages, losses, _ = read(path)
    missing = 200 - len(messages)
    assert missing > 0
    assert [(loss.what, loss.count) for loss in losses] == [(MISSING, missing)]


def test_a_chunk_compressed_in_an_unknown_way_is_left_out_and_named(tmp_path):
    path = write(tmp_path / "log.mcap")
    records = mutations.records_of(path.read_bytes())
    place = next(i for i, record in enumerate(records) if record[0] == 6)
    records[place] = records[place].replace(b"zstd", b"zpaq", 1)
    path.write_bytes(mutations.joined(records))
    messages, losses, _ = read(path)
    missing = 200 - len(messages)
    assert 0 < missing < 100
    assert [(loss.what, loss.count) for loss in losses] == [
        ("damaged chunk", 1),
        (MISSING, missing),
    ]
    assert "'zpaq'" in next(iter(losses)).effect


@pytest.mark.parametrize("chunking", [True, False])
def test_records_of_kinds_still_to_come_are_passed_over(tmp_path, chunking):
    path = write(tmp_path / "log.mcap", use_chunking=chunking)
    records = mutations.records_of(path.read_bytes())
    end = next(i for i, record in enumerate(records) if record[0] == 15)
    for place in range(end, 0, -1):
        records.insert(place, struct.pack("<BQ", 0x7F, 40) + bytes(40))
        records.insert(place, struct.pack("<BQ", 0xFE, 0))
    # Without the summary, whose offsets are no longer true.
    content = mutations.joined(records[: records.index(records[3 * end])])
    path.write_bytes(content)
    messages, losses, _ = read(path)
    assert numbers(messages) == list(range(200))
    assert not {"unreadable record", "damaged chunk"} & {loss.what for loss in losses}


@pytest.mark.parametrize("claimed", ["as packed", "small"])
def test_a_chunk_that_would_expand_to_a_gigabyte_is_refused_in_little_memory(tmp_path, claimed):
    import resource

    import zstandard

    bomb = zstandard.ZstdCompressor(level=1).compressobj(size=2**30)
    packed = b"".join([*(bomb.compress(bytes(2**24)) for _ in range(64)), bomb.flush()])
    size = 2**30 if claimed == "as packed" else 1000
    chunk = struct.pack("<QQQI", 0, 0, size, 0) + struct.pack("<I", 4) + b"zstd"
    chunk += struct.pack("<Q", len(packed)) + packed
    content = write(tmp_path / "log.mcap").read_bytes()
    header_end = 8 + 9 + struct.unpack_from("<Q", content, 9)[0]
    record = struct.pack("<BQ", 6, len(chunk)) + chunk
    (tmp_path / "log.mcap").write_bytes(content[:header_end] + record + content[header_end:])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    messages, losses, _ = read(tmp_path / "log.mcap")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000  # kB
    assert len(messages) == 200
    assert [loss.what for loss in losses] == ["damaged chunk"]


def test_later_passes_read_only_the_topics_asked_for(tmp_path):
    _, _, log = read(write(tmp_path / "log.mcap"))
    only = list(log.messages(lambda channel: channel.topic == "/a"))
    assert numbers(only) == list(range(1, 200, 2))


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "empty"),
        (b"hello, this is text\n", "not an MCAP file"),
        (b"#ROSBAG V2.0\n", "ROS 1 bag"),
        (b"SQLite format 3\x00", "database"),
        (b"\x28\xb5\x2f\xfd" + bytes(20), "zstd -d"),
    ],
)
def test_what_is_not_mcap_is_refused_with_a_word_on_what_it_is(tmp_path, content, says):
    path = tmp_path / "log.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match=says):
        read(path)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(LogError, match="no such file"):
        read(tmp_path / "none.mcap")


# Folders


def bag(folder, names, **more):
    folder.mkdir(exist_ok=True)
    lines = ["rosbag2_bagfile_information:", "  version: 5", "  storage_identifier: mcap"]
    lines += [f"  {key}: {value}" for key, value in more.items()]
    lines += ["  relative_file_paths:", *(f"    - {name}" for name in names)]
    (folder / "metadata.yaml").write_text("\n".join(lines) + "\n")


def test_the_splits_of_a_bag_are_read_in_the_order_of_its_metadata(tmp_path):
    folder = tmp_path / "bag"
    bag(folder, ["bag_1.mcap", "bag_0.mcap"])
    write(folder / "bag_0.mcap", 50, times=range(1000, 1050))
    write(folder / "bag_1.mcap", 60)
    messages, _, _ = read(folder)
    assert numbers(messages) == [*range(60), *range(50)]


@pytest.mark.parametrize("name", ["../out.mcap", "/etc/passwd", "link.mcap"])
def test_a_bag_cannot_lead_outside_its_folder(tmp_path, name):
    write(tmp_path / "out.mcap")
    bag(tmp_path / "bag", [name])
    (tmp_path / "bag" / "link.mcap").symlink_to(tmp_path / "out.mcap")
    with pytest.raises(LogError, match="outside"):
        read(tmp_path / "bag")


def test_a_bag_of_packed_files_is_refused_with_what_to_run_and_read_once_that_is_done(tmp_path):
    folder = tmp_path / "bag"
    bag(folder, ["bag_0.mcap.zstd"], compression_format="zstd", compression_mode="FILE")
    content = write(tmp_path / "bag_0.mcap").read_bytes()
    (folder / "bag_0.mcap.zstd").write_bytes(zstandard.ZstdCompressor().compress(content))
    with pytest.raises(LogError, match=r"zstd -d .*bag/\*\.zstd"):
        read(folder)
    (folder / "bag_0.mcap").write_bytes(content)
    assert len(read(folder)[0]) == 200
    with pytest.raises(LogError, match="zstd -d"):
        read(folder / "bag_0.mcap.zstd")


def test_folders_that_are_no_bags_are_refused_with_what_to_do(tmp_path):
    with pytest.raises(LogError, match=r"without \.mcap files"):
        read(tmp_path)
    write(tmp_path / "one.mcap")
    with pytest.raises(LogError, match="ros2 bag reindex"):
        read(tmp_path)
    (tmp_path / "metadata.yaml").write_text("nothing: [here")
    with pytest.raises(LogError, match="cannot be read"):
        read(tmp_path)
    (tmp_path / "metadata.yaml").write_text("nothing: here")
    with pytest.raises(LogError, match="not a rosbag2 description"):
        read(tmp_path)
    bag(tmp_path, ["gone.mcap"])
    with pytest.raises(LogError, match="missing"):
        read(tmp_path)


def test_the_fingerprint_follows_the_content(tmp_path):
    first = read(write(tmp_path / "a.mcap"))[2].fingerprint()
    assert read(write(tmp_path / "b.mcap"))[2].fingerprint() == first
    assert read(write(tmp_path / "c.mcap", 201))[2].fingerprint() != first
