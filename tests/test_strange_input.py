"""Logs and settings that nobody has in mind: a right result, or one clear word on what is wrong."""

import copy
import json
import os

import numpy as np
import pytest
import small_logs
from handmade import made_run
from logwriter import LogWriter, transform
from small_logs import SECOND, START_NS, TYPES, Event
from typer.testing import CliRunner

from soundmap.cli import app
from soundmap.config import loaded_config
from soundmap.errors import ConfigError, LogError, NothingUsableError
from soundmap.logs.robot_log import open_log
from soundmap.outputs.illustrator import Illustrator
from soundmap.outputs.new_folder import new_folder
from soundmap.outputs.run_folder import write_run

CIRCLE = "[array]\nkind = 'circle'\nmicrophones = 6\nradius_m = 0.1\n"


@pytest.fixture
def drive():
    """The first seconds of the drive, to be changed at will."""
    return [copy.deepcopy(e) for e in small_logs.events() if e.time_ns < START_NS + 2 * SECOND]


def settings(folder, text=CIRCLE):
    (folder / "robot.toml").write_text(text)
    return loaded_config([folder / "robot.toml"])


def opened(folder, events):
    events = sorted(events, key=lambda event: event.time_ns)
    return open_log(small_logs.write(folder / "log.mcap", events), settings(folder))


def lost(log):
    return [loss.what for loss in log.losses if loss.data_lost]


# Mounts


def test_transforms_that_contradict_each_other_are_named(tmp_path, drive):
    extra = transform("laser", "base_link", (1.0, 0.0, 0.0))
    drive[0].values["transforms"].append(extra)
    assert lost(opened(tmp_path, drive)) == [
        "transform from 'base_link' to 'laser' contradicts others"
    ]


def test_a_loop_of_transforms_that_fit_together_is_fine(tmp_path, drive):
    extra = transform("laser", "base_link", (-0.2, 0.0, -0.3))
    drive[0].values["transforms"].append(extra)
    assert lost(opened(tmp_path, drive)) == []


def test_a_mount_that_is_told_anew_is_named_with_its_time(tmp_path, drive):
    again = {"transforms": [transform("base_link", "mic_array", (0.0, 0.3, 0.6))]}
    log = opened(tmp_path, [*drive, Event(START_NS + SECOND, "/tf_static", again)])
    (loss,) = log.losses
    assert loss.what == "mount of 'mic_array' in 'base_link' is told anew, and otherwise"
    assert (loss.count, loss.first_s, loss.data_lost) == (1, 1.0, True)
    assert log.array.mount.translation_m.tolist() == [0.0, 0.3, 0.6]


def test_a_mount_that_is_no_number_is_named_with_the_error_it_leads_to(tmp_path, drive):
    drive[0].values["transforms"][1] = transform("base_link", "mic_array", (np.nan, 0.0, 0.6))
    with pytest.raises(ConfigError, match="'mic_array' is not finite"):
        opened(tmp_path, drive)


def test_a_sensor_that_is_not_on_the_robot_is_refused(tmp_path, drive):
    drive[0].values["transforms"][1] = transform("base_link", "mic_array", (1e9, 0.0, 0.6))
    with pytest.raises(ConfigError, match=r"'mic_array' is 1e\+09 m away"):
        opened(tmp_path, drive)


# Time


@pytest.mark.parametrize("logged_ns", [0, START_NS])
def test_a_log_whose_times_of_logging_say_nothing_is_read_by_its_stamps(tmp_path, drive, logged_ns):
    with LogWriter(tmp_path / "log.mcap", chunk_size=20_000) as writer:
        for event in drive:
            writer.ros2(event.topic, TYPES[event.topic], event.values, logged_ns)
    log = open_log(tmp_path / "log.mcap", settings(tmp_path))
    assert len(log.losses) == 0
    assert len(list(log.lasers())) == sum(event.topic == "/scan" for event in drive)
    assert sum(len(block.samples) for block in log.audio()) == 99 * 320


def test_a_sensor_that_says_one_thing_and_no_more_ends_early(tmp_path, drive):
    first = next(event for event in drive if event.topic == "/scan")
    log = opened(tmp_path, [e for e in drive if e.topic != "/scan"] + [first])
    assert lost(log) == ["ends before the other sensors do"]


@pytest.mark.parametrize("chunking", [True, False])
@pytest.mark.parametrize("change", ["cut short", "overwritten", "removed"])
def test_a_log_that_becomes_another_while_it_is_read_is_refused(tmp_path, drive, chunking, change):
    path = small_logs.write(tmp_path / "log.mcap", drive, use_chunking=chunking)
    log = open_log(path, settings(tmp_path))
    size = path.stat().st_size
    if change == "cut short":
        os.truncate(path, size // 3)
    elif change == "overwritten":
        with path.open("r+b") as file:
            file.seek(size // 3)
            file.write(bytes(size // 3))
    else:
        path.unlink()
    with pytest.raises(LogError, match="changed or removed while it was read"):
        list(log.measurements())


def test_an_error_tells_what_was_lost_before_it(tmp_path, drive):
    for event in drive:
        if event.topic == "/mics":
            event.values["sampling_frequency"] = 0
    with pytest.raises(
        NothingUsableError, match=r"Lost before that: 99 x damaged audio message \(/mics\)"
    ):
        opened(tmp_path, drive)


# Settings


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[array]\npositions_m = [[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0.5]]\n", "on one line"),
        ("[array]\npositions_m = [[1, 2, 0], [1, 2, 0], [1, 2, 0]]\n", "in one place"),
        ("[array]\nkind = 'circle'\nradius_m = 155\n", "array.radius_m"),
        (CIRCLE + "mount = [1e9, 0, 0, 0]\n", "array.mount"),
        (CIRCLE + "[scan]\nbearings = 1000000000\n", "scan.bearings"),
        (CIRCLE + "[scan]\nwindow_s = 1e6\n", "scan.window_s"),
        (CIRCLE + "[fuse]\ncell_m = 1e-6\n", "fuse.cell_m"),
        (CIRCLE + "[map]\nkey_distance_m = 1e-9\n", "map.key_distance_m"),
    ],
)
def test_settings_that_no_machine_or_array_could_follow_are_refused(tmp_path, text, says):
    with pytest.raises(ConfigError, match=says):
        settings(tmp_path, text)


# Names


def test_names_from_a_log_cannot_steer_the_terminal(tmp_path, drive):
    with LogWriter(tmp_path / "log.mcap") as writer:
        for event in drive:
            writer.ros2("/a\x1b[2J" + event.topic, TYPES[event.topic], event.values, event.time_ns)
    result = CliRunner().invoke(app, ["info", str(tmp_path / "log.mcap")])
    assert result.exit_code == 0
    assert "\x1b[2J" not in result.stdout
    assert "/a\\x1b[2J/" in result.stdout
    told = CliRunner().invoke(app, ["info", str(tmp_path / "log.mcap"), "--json"])
    assert json.loads(told.stdout)["topics"][0]["name"].startswith("/a\x1b[2J/")


def test_a_name_that_is_no_text_costs_nothing(tmp_path):
    from dataclasses import replace

    run = replace(made_run(), log=tmp_path / os.fsdecode(b"caf\xe9.mcap"))
    with new_folder(tmp_path / "run", force=False) as folder:
        write_run(run, folder, Illustrator())
    assert "caf\\udce9" in (tmp_path / "run" / "report.html").read_text(encoding="utf-8")


def test_a_word_without_end_is_cut_short_in_an_error(tmp_path, drive):
    for event in drive:
        if event.topic == "/scan":
            event.values["header"]["frame_id"] = "L" * 100_000
    small_logs.write(tmp_path / "log.mcap", drive)
    settings(tmp_path)
    given = ["process", tmp_path / "log.mcap", "--config", tmp_path / "robot.toml"]
    given += ["--out", tmp_path / "out"]
    result = CliRunner().invoke(app, [str(argument) for argument in given])
    assert result.exit_code == 2
    assert len(result.stderr) < 2000


def test_memory_that_runs_out_is_no_traceback(tmp_path, monkeypatch):
    import soundmap.replay

    def process(*_, **__):
        raise MemoryError("Unable to allocate 393. TiB")

    monkeypatch.setattr(soundmap.replay, "process", process)
    result = CliRunner().invoke(app, ["process", "run.mcap", "--out", str(tmp_path / "out")])
    assert result.exit_code == 1
    assert "memory ran out (Unable to allocate 393. TiB)" in result.stderr
    assert list(tmp_path.iterdir()) == []
