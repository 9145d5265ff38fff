"""Files that someone has made to do harm: each is refused in a few words, in little memory."""

import json
import os
import pickle
import zipfile

import numpy as np
import pytest
from handmade import made_run
from logwriter import LogWriter

from soundmap.config import loaded_config
from soundmap.errors import ConfigError, LogError, MapError, OutputError
from soundmap.logs.log_files import log_files
from soundmap.map_file import read_map
from soundmap.outputs.illustrator import Illustrator
from soundmap.outputs.new_folder import new_folder
from soundmap.outputs.run_folder import write_run
from soundmap.outputs.stored_run import read_power_map, read_report, read_run

DEEP = "[" * 2000
LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [*{a}, *{a}, *{a}, *{a}, *{a}, *{a}, *{a}, *{a}, *{a}]\n"
    for a, b in zip("abcdefghij", "bcdefghijk", strict=True)
)


class Harm:
    def __reduce__(self):
        return print, ("a pickle was loaded",)


@pytest.fixture
def run_folder(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    write_run(made_run(), folder, Illustrator())
    return folder


def test_no_pickle_is_ever_loaded(run_folder, capsys):
    np.savez(run_folder / "power_map.npz", power=np.array([Harm()], dtype=object))
    with pytest.raises(LogError, match="cannot be read as a power map"):
        read_power_map(run_folder)
    (run_folder / "power_map.npz").write_bytes(pickle.dumps(Harm()))
    with pytest.raises(LogError, match="cannot be read as a power map"):
        read_power_map(run_folder)
    assert capsys.readouterr().out == ""


def test_an_archive_that_would_fill_the_memory_is_refused(run_folder, monkeypatch):
    monkeypatch.setattr("soundmap.outputs.stored_run.MAX_ARCHIVE_BYTES", 2**24)
    file = run_folder / "audio_scans.npz"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("power.npy", bytes(2**25))
    assert file.stat().st_size < 2**16
    with pytest.raises(LogError, match="would expand to 32 MiB"):
        read_run(run_folder)


def test_nesting_without_end_is_refused(tmp_path, run_folder):
    (tmp_path / "deep.toml").write_text(f"a = {DEEP}")
    with pytest.raises(ConfigError, match="not valid TOML"):
        loaded_config([tmp_path / "deep.toml"])
    (tmp_path / "map.yaml").write_text(f"image: {DEEP}")
    with pytest.raises(MapError, match="not a YAML file"):
        read_map(tmp_path / "map.yaml")
    (tmp_path / "metadata.yaml").write_text(f"rosbag2_bagfile_information: {DEEP}")
    with pytest.raises(LogError, match="cannot be read"):
        log_files(tmp_path)
    (run_folder / "report.json").write_text(DEEP)
    with pytest.raises(LogError, match="cannot be read"):
        read_report(run_folder)
    with pytest.raises(OutputError, match="not replaced"), new_folder(run_folder, force=True):
        pass


def test_aliases_that_multiply_are_not_written_out(tmp_path):
    (tmp_path / "map.yaml").write_text(LAUGHS + "image: *k\nresolution: *k\norigin: *k\n")
    with pytest.raises(MapError) as refusal:
        read_map(tmp_path / "map.yaml")
    assert len(str(refusal.value)) < 1000
    (tmp_path / "metadata.yaml").write_text(
        LAUGHS + "rosbag2_bagfile_information:\n  storage_identifier: *k\n"
    )
    with pytest.raises(LogError) as refused:
        log_files(tmp_path)
    assert len(str(refused.value)) < 1000


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("occupied_thresh", "high"),
        ("free_thresh", 7),
        ("free_thresh", 0.7),
        ("image", [1, 2]),
        ("negate", "no"),
        ("mode", ["trinary"]),
        ("resolution", True),
        ("resolution", 1e-300),
        ("origin", [0, 0, 90]),
        ("origin", [1e300, 0, 0]),
    ],
)
def test_a_description_of_a_map_with_nonsense_is_refused_by_name(tmp_path, key, value):
    good = {"image": "map.pgm", "resolution": 0.05, "origin": [0, 0, 0]}
    (tmp_path / "map.yaml").write_text(json.dumps(good | {key: value}))
    with pytest.raises(MapError, match=key):
        read_map(tmp_path / "map.yaml")


def test_no_other_program_is_called_for_an_image(tmp_path):
    (tmp_path / "map.pgm").write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n")
    (tmp_path / "map.yaml").write_text("image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n")
    with pytest.raises(MapError, match="not an image"):
        read_map(tmp_path / "map.yaml")


def test_pipes_are_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "map.yaml").write_text("image: pipe\nresolution: 0.05\norigin: [0, 0, 0]\n")
    for name in ("map.yaml", "pipe"):
        with pytest.raises(MapError, match="pipe: not a file"):
            read_map(tmp_path / name)
    with pytest.raises(LogError, match="neither a file nor a folder"):
        log_files(tmp_path / "pipe")


def test_a_path_that_the_system_refuses_is_told_with_its_reason(tmp_path):
    with pytest.raises(LogError, match=r"cannot be opened \(File name too long\)"):
        log_files(tmp_path / ("n" * 300))


@pytest.mark.parametrize("name", ["../out.mcap", "/etc/hostname", "out.mcap.zstd/../../out.mcap"])
def test_a_bag_reads_nothing_outside_its_folder(tmp_path, name):
    with LogWriter(tmp_path / "out.mcap"):
        pass
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text(
        json.dumps({"rosbag2_bagfile_information": {"relative_file_paths": [name]}})
    )
    with pytest.raises(LogError, match="outside"):
        log_files(bag)
