import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from handmade import made_ratio, made_run, walled_room
from typer.testing import CliRunner

import soundmap.comparison
import soundmap.logs.summary
import soundmap.outputs.pictures
import soundmap.outputs.viewer
import soundmap.replay
from soundmap import __version__, start
from soundmap.cli import app
from soundmap.errors import LogError, NothingUsableError
from soundmap.outputs.illustrator import Illustrator
from soundmap.outputs.run_folder import write_run

ENVIRONMENT = {**os.environ, "NO_COLOR": "1", "COLUMNS": "80"}


def invoked(*arguments: object):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture
def _no_pictures(monkeypatch):
    """Pictures take a second a run and are tested elsewhere."""
    monkeypatch.setattr(soundmap.outputs.pictures, "picture_bytes", lambda *_: b"")


@pytest.fixture
def processed(monkeypatch, tmp_path, _no_pictures) -> list[dict]:
    """Replaces the pipeline by made results; gives what it was called with.

    A log named broken cannot be read, one named silent holds nothing, one named clean loses
    nothing.
    """
    monkeypatch.chdir(tmp_path)
    calls: list[dict] = []

    def process(log, map_path, config, *, start_pose, cache, heard, progress):
        calls.append({"log": log, "map": map_path, "config": config, "start": start_pose})
        with progress.stage("localize", 20.0) as stage:
            stage.advance_to(3.0)
        if log.stem == "broken":
            raise LogError(f"{log}: not an MCAP file [red].")
        if log.stem == "silent":
            raise NothingUsableError(f"{log}: no audio.")
        if log.stem == "stopped":
            raise KeyboardInterrupt
        run = made_run(log, config=config)
        return replace(run, losses=()) if log.stem == "clean" else run

    monkeypatch.setattr(soundmap.replay, "process", process)
    return calls


def test_a_log_is_processed_into_a_folder_with_its_name(processed, tmp_path):
    result = invoked("process", "logs/run1.mcap", "--map", "map.yaml")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "run1" / "report.json").is_file()
    assert "S1" in result.stdout
    assert result.stderr == ""
    assert processed[0]["start"] is None
    assert processed[0]["map"] == Path("map.yaml")


def test_several_logs_get_folders_of_their_own_inside_out(processed, tmp_path):
    result = invoked(
        "process", "a/run1.mcap", "a/bag", "--map", "m.yaml", "--out", "results", "--json"
    )
    assert result.exit_code == 0
    assert sorted(path.name for path in (tmp_path / "results").iterdir()) == ["bag", "run1"]
    runs = json.loads(result.stdout)["runs"]
    assert [run["folder"] for run in runs] == ["results/run1", "results/bag"]


def test_a_log_folder_here_is_not_written_into(processed, tmp_path):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").touch()
    assert invoked("process", "bag", "--map", "m.yaml").exit_code == 0
    assert (tmp_path / "bag-soundmap" / "report.json").is_file()
    assert [path.name for path in (tmp_path / "bag").iterdir()] == ["metadata.yaml"]


def test_logs_of_one_name_are_refused_before_the_work(processed):
    result = invoked("process", "a/run1.mcap", "b/run1.mcap", "--map", "m.yaml")
    assert result.exit_code == 2
    assert "more than one log would be written to run1" in result.stderr
    assert processed == []


def test_one_failing_log_does_not_stop_the_others_and_the_worst_code_is_returned(processed):
    result = invoked(
        "process", "run1.mcap", "broken.mcap", "silent.mcap", "clean.mcap", "--map", "m.yaml"
    )
    assert result.exit_code == 4
    assert [call["log"].stem for call in processed] == ["run1", "broken", "silent", "clean"]
    assert Path("run1").is_dir()
    assert Path("clean").is_dir()
    assert not Path("broken").exists()
    assert "broken.mcap: not an MCAP file [red]." in result.stderr


def test_json_of_several_logs_tells_the_failed_ones_too(processed):
    result = invoked("process", "run1.mcap", "broken.mcap", "--map", "m.yaml", "--json")
    assert result.exit_code == 3
    good, failed = json.loads(result.stdout)["runs"]
    assert good["folder"] == "run1"
    assert failed == {
        "log": "broken.mcap",
        "error": "broken.mcap: not an MCAP file [red].",
        "exit_code": 3,
    }


def test_json_of_one_log_is_its_report_and_nothing_else(processed):
    result = invoked("process", "run1.mcap", "--map", "m.yaml", "--json")
    printed = json.loads(result.stdout)
    assert printed.pop("folder") == "run1"
    assert printed == json.loads(Path("run1/report.json").read_text())
    assert result.stderr == ""


def test_an_error_leaves_the_standard_output_empty(processed):
    result = invoked("process", "silent.mcap", "--map", "m.yaml", "--json")
    assert result.exit_code == 4
    assert result.stdout == ""
    assert result.stderr == "soundmap: error: silent.mcap: no audio.\n"
    assert list(Path().iterdir()) == []


@pytest.mark.parametrize(("chosen", "ending"), [("svg", ".svg"), ("pdf", ".pdf"), ("png", ".png")])
def test_pictures_come_in_the_format_asked_for(processed, chosen, ending):
    assert invoked("process", "a.mcap", "--map", "m.yaml", "--figures", chosen).exit_code == 0
    pictures = {path.suffix for path in Path("a").iterdir() if path.stem == "power_map"}
    assert pictures == {ending, ".npz"}


def test_without_pictures_there_are_none(processed):
    assert invoked("process", "a.mcap", "--map", "m.yaml", "--figures", "none").exit_code == 0
    assert not list(Path("a").glob("*.png"))
    result = invoked("process", "b.mcap", "--map", "m.yaml", "--figures", "jpeg")
    assert result.exit_code == 2
    assert "'png', 'pdf', 'svg', 'none'" in result.stderr


def test_quiet_prints_nothing_when_all_is_well(processed):
    result = invoked("process", "run1.mcap", "--map", "m.yaml", "--quiet")
    assert result.exit_code == 0
    assert result.output == ""


def test_strict_writes_the_results_says_what_was_lost_and_exits_with_5(processed):
    result = invoked("process", "run1.mcap", "--map", "m.yaml", "--strict", "--quiet")
    assert result.exit_code == 5
    assert Path("run1/report.json").is_file()
    assert "odometry pose is not finite" in result.stderr
    assert "run1/" in result.stderr
    assert invoked("process", "clean.mcap", "--map", "m.yaml", "--strict").exit_code == 0


def test_a_failure_is_worse_than_a_loss(processed):
    logs = ("run1.mcap", "broken.mcap")
    assert invoked("process", *logs, "--map", "m.yaml", "--strict").exit_code == 3


def test_an_earlier_run_is_refused_before_the_work_and_replaced_with_force(processed):
    command = ("process", "run1.mcap", "--map", "m.yaml")
    assert invoked(*command).exit_code == 0
    Path("run1/note").touch()
    refused = invoked(*command)
    assert refused.exit_code == 1
    assert "--force" in refused.stderr
    assert len(processed) == 1
    assert Path("run1/note").exists()
    assert invoked(*command, "--force").exit_code == 0
    assert not Path("run1/note").exists()


def test_without_a_map_the_pipeline_is_asked_to_build_one(processed):
    assert invoked("process", "run1.mcap").exit_code == 0
    assert processed[0]["map"] is None


def test_a_start_pose_without_a_map_is_a_usage_error(processed):
    result = invoked("process", "run1.mcap", "--start-pose", "1,2,90")
    assert result.exit_code == 2
    assert "add --map MAP.yaml" in " ".join(result.stderr.split())
    assert processed == []


def test_a_start_pose_is_taken_in_degrees(processed):
    result = invoked("process", "run1.mcap", "--map", "m.yaml", "--start-pose", "-1.5,2,90")
    assert result.exit_code == 0
    assert processed[0]["start"] == pytest.approx((-1.5, 2.0, math.pi / 2))


@pytest.mark.parametrize("pose", ["1,2", "1,2,3,4", "here", "1,2,nan", "inf,0,0", ""])
def test_a_wrong_start_pose_is_refused_with_an_example(processed, pose):
    result = invoked("process", "run1.mcap", "--map", "m.yaml", "--start-pose", pose)
    assert result.exit_code == 2
    assert "--start-pose 1.2,-0.5,90" in " ".join(result.stderr.split())
    assert processed == []


def test_later_configurations_override_earlier_ones(processed, tmp_path):
    (tmp_path / "a.toml").write_text("[scan]\nlow_hz = 500.0\nhigh_hz = 4000.0\n")
    (tmp_path / "b.toml").write_text("[scan]\nlow_hz = 800.0\n")
    arguments = ("--config", "a.toml", "--config", "b.toml")
    assert invoked("process", "run1.mcap", "--map", "m.yaml", *arguments).exit_code == 0
    scan = processed[0]["config"].scan
    assert (scan.low_hz, scan.high_hz) == (800.0, 4000.0)


def test_a_wrong_configuration_is_a_usage_error(processed, tmp_path):
    (tmp_path / "a.toml").write_text("[scan]\nlow_herz = 500.0\n")
    result = invoked("process", "run1.mcap", "--map", "m.yaml", "--config", "a.toml")
    assert result.exit_code == 2
    assert "did you mean 'low_hz'?" in result.stderr
    assert processed == []


def test_control_c_leaves_nothing_and_exits_with_130(processed, tmp_path):
    result = invoked("process", "stopped.mcap", "--map", "m.yaml")
    assert result.exit_code == 130
    assert "stopped" in result.stderr
    assert "Traceback" not in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_an_unexpected_exception_keeps_its_traceback(processed, monkeypatch):
    def broken(*_args, **_keywords):
        raise ValueError("a bug")

    monkeypatch.setattr(soundmap.replay, "process", broken)
    result = invoked("process", "run1.mcap", "--map", "m.yaml")
    assert isinstance(result.exception, ValueError)


@pytest.fixture
def two_runs(monkeypatch, tmp_path, _no_pictures) -> Path:
    monkeypatch.chdir(tmp_path)
    for name in ("run1", "run3"):
        (tmp_path / name).mkdir()
        write_run(made_run(Path(f"{name}.mcap")), tmp_path / name, Illustrator())

    def compared(run, background, diff, detect):
        ratio, room = made_ratio(), walled_room()
        return soundmap.comparison.Comparison(ratio, room, run, background, notes=())

    monkeypatch.setattr(soundmap.comparison, "compared", compared)
    return tmp_path


def test_a_difference_gets_a_folder_named_after_both_runs(two_runs):
    result = invoked("diff", "run1/", "run3", "--json")
    assert result.exit_code == 0, result.output
    printed = json.loads(result.stdout)
    assert printed.pop("folder") == "run1-run3"
    assert printed == json.loads((two_runs / "run1-run3" / "report.json").read_text())
    assert (printed["run"], printed["background"]) == ("run1", "run3")


def test_a_difference_is_shown_or_not(two_runs):
    assert "26.0" in invoked("diff", "run1", "run3").stdout
    assert invoked("diff", "run1", "run3").exit_code == 1
    assert invoked("diff", "run1", "run3", "--force", "--quiet").output == ""


def test_a_difference_never_replaces_the_runs_it_compares(two_runs):
    result = invoked("diff", "run1", "run3", "--out", "run1", "--force")
    assert result.exit_code == 1
    assert "is being read" in result.stderr
    assert (two_runs / "run1" / "power_map.npz").is_file()


@pytest.mark.usefixtures("_no_pictures")
def test_two_runs_are_compared_by_the_real_thing(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name, gain in (("run1", 100.0), ("run3", 1.0)):
        run = made_run(Path(f"{name}.mcap"))
        power_map = replace(run.power_map, power_sum=run.power_map.power_sum * gain)
        (tmp_path / name).mkdir()
        write_run(replace(run, power_map=power_map), tmp_path / name, Illustrator())
    result = invoked("diff", "run1", "run3", "--json")
    assert result.exit_code == 0, result.output
    rows = json.loads(result.stdout)["sources"]
    assert rows
    assert all(row["ratio_db"] == pytest.approx(20.0) for row in rows)


def test_a_difference_with_no_run_folder_is_unreadable_input(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = invoked("diff", "run1", "run3")
    assert result.exit_code == 3
    assert "run1: no run folder" in result.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def watched(processed, monkeypatch) -> list[Path]:
    """A folder of a run, without its log; the files that the viewer is opened with."""
    opened: list[Path] = []
    assert invoked("process", "a.mcap", "--map", "m.yaml", "--figures", "none").exit_code == 0
    monkeypatch.setattr(soundmap.outputs.viewer, "show", opened.append)
    monkeypatch.setattr(soundmap.outputs.viewer, "has_display", lambda: True)
    return opened


def test_a_finished_run_is_watched_and_what_its_recording_lacks_is_told(watched):
    result = invoked("view", "a")
    assert result.exit_code == 0, result.output
    assert watched == [Path("a/run.rrd")]
    assert "a.mcap: the log is no longer there" in result.stderr
    assert result.stdout == ""


def test_a_recording_is_only_written_with_save(watched):
    result = invoked("view", "a", "--save")
    assert watched == []
    assert Path("a/run.rrd").is_file()
    assert result.stdout.startswith("a/run.rrd\n")
    assert "scp " in result.stdout


def test_without_a_display_the_way_to_look_elsewhere_is_told(watched, monkeypatch):
    monkeypatch.setattr(soundmap.outputs.viewer, "has_display", lambda: False)
    result = invoked("view", "a")
    assert result.exit_code == 0
    assert watched == []
    assert "there is no display here" in result.stdout
    assert "rerun run.rrd" in result.stdout


def test_what_is_no_run_folder_cannot_be_watched(tmp_path):
    result = invoked("view", tmp_path)
    assert result.exit_code == 3
    assert "no run folder" in result.stderr


def test_a_recording_is_made_with_the_run_when_asked_for(processed):
    assert invoked("process", "a.mcap", "--map", "m.yaml").exit_code == 0
    assert not Path("a/run.rrd").exists()
    result = invoked("process", "b.mcap", "--map", "m.yaml", "--rerun", "--json")
    assert result.exit_code == 0
    assert Path("b/run.rrd").is_file()
    assert json.loads(result.stdout)["timings_s"]["record"] > 0


def test_info_prints_json_or_text(monkeypatch):
    content = {
        "path": "run1.mcap",
        "size_bytes": 1_000_000,
        "duration_s": float("nan"),
        "topics": [],
        "audio": None,
        "lasers": [],
        "odometry": None,
        "base_frame": None,
        "mounts": {},
        "losses": [],
        "problems": ["no audio"],
        "ready_for": {"map": False},
    }
    summary = SimpleNamespace(as_dict=lambda: content)
    monkeypatch.setattr(soundmap.logs.summary, "log_summary", lambda _path, _config: summary)
    printed = json.loads(invoked("info", "run1.mcap", "--json").stdout)
    assert printed == content | {"duration_s": None}
    assert "- no audio" in invoked("info", "run1.mcap").stdout


def test_the_version_is_told():
    assert invoked("--version").stdout == f"soundmap {__version__}\n"


@pytest.mark.parametrize("command", ["process", "info", "diff", "evaluate", "view"])
def test_every_option_is_explained(command):
    text = invoked(command, "--help").stdout
    options = re.findall(r"^  (?:-\w, )?(--[\w-]+)(.*)$", text, flags=re.MULTILINE)
    assert len(options) >= 2
    for name, rest in options:
        assert len(rest.split()) >= 2, name


def soundmap_process(*arguments: str, **options) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from soundmap.cli import main; main()", *arguments]
    return subprocess.run(
        command, capture_output=True, text=True, env=ENVIRONMENT, check=False, **options
    )


def test_help_loads_none_of_the_slow_libraries():
    program = (
        "import sys; from soundmap.cli import app\n"
        "try: app(['--help'])\n"
        "except SystemExit: pass\n"
        "print([name for name in ('numpy', 'scipy', 'numba', 'matplotlib', 'rerun', 'pydantic',"
        " 'google.protobuf', 'rosbags') if name in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert result.stdout.splitlines()[-1] == "[]"


def test_a_reader_that_goes_away_is_no_traceback():
    command = f"'{sys.executable}' -c 'from soundmap.cli import main; main()' --help | true"
    result = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_stops_the_work_and_leaves_nothing_behind(tmp_path, number, code):
    program = (
        "import signal, time, soundmap.replay\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it\n"
        "def process(*args, **keywords): print('working', flush=True); time.sleep(60)\n"
        "soundmap.replay.process = process\n"
        "from soundmap.cli import main\n"
        "main()\n"
    )
    command = [sys.executable, "-c", program, "process", "run1.mcap", "--map", "m.yaml"]
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as running:
        assert running.stdout is not None
        assert running.stdout.readline() == "working\n"
        assert [path.name[:14] for path in tmp_path.iterdir()] == [".run1.partial-"]
        time.sleep(0.05)
        running.send_signal(number)
        _, errors = running.communicate(timeout=30)
    assert running.returncode == code
    assert "Traceback" not in errors
    assert list(tmp_path.iterdir()) == []


def test_a_missing_log_is_unreadable_input(tmp_path):
    room = tmp_path / "room"
    room.mkdir()
    write_run(made_run(), room, Illustrator())
    result = soundmap_process("process", "none.mcap", "--map", "room/map.yaml", cwd=tmp_path)
    assert result.returncode == 3
    assert result.stdout == ""
    assert "none.mcap" in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["room"]


def test_a_stop_while_the_program_is_loading_leaves_no_traceback(monkeypatch):
    class Loading:
        def __getattr__(self, name):
            raise KeyboardInterrupt

    monkeypatch.setitem(sys.modules, "soundmap.cli", Loading())
    with pytest.raises(SystemExit) as stopped:
        start.main()
    assert stopped.value.code == 130
