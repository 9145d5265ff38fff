"""Several logs at a time; each process runs this script anew, with the pipeline replaced."""

import json
import queue
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
import small_logs
import worlds

from soundmap.jobs import _Board, _Reporter
from soundmap.map_file import map_files

SCRIPT = """
import os, signal, sys, time
sys.path.insert(0, {tests!r})
import soundmap.outputs.pictures
import soundmap.replay
from handmade import made_run
from soundmap.errors import LogError

def process(log, map_path, config, *, start_pose, cache, heard, progress):
    if log.stem in ("slow", "slower"):
        (log.parent / f"working-{{os.getpid()}}").touch()
        time.sleep(60)
    if log.stem == "broken":
        raise LogError(f"{{log}}: not an MCAP file.")
    if log.stem == "killed":
        time.sleep(0.5)
        os.kill(os.getpid(), signal.SIGKILL)
    with progress.stage("localize", 20.0) as stage:
        stage.advance_to(3.0)
    print(log.stem, os.environ["NUMBA_NUM_THREADS"], flush=True)
    return made_run(log, config=config)

soundmap.replay.process = process
soundmap.outputs.pictures.picture_bytes = lambda *_: b""
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it
    from soundmap.cli import main
    main()
"""


@pytest.fixture
def command(tmp_path) -> list[str]:
    script = tmp_path / "script" / "main.py"
    script.parent.mkdir()
    script.write_text(SCRIPT.format(tests=str(Path(__file__).parent)))
    return [sys.executable, str(script), "process", "--map", "m.yaml", "--jobs", "2"]


def run(command, *logs, folder):
    (folder / "here").mkdir()
    return subprocess.run(
        [*command, *logs], cwd=folder / "here", capture_output=True, text=True, check=False
    )


def test_every_log_gets_its_folder_and_its_share_of_the_cores(command, tmp_path):
    done = run([*command, "--json"], "a.mcap", "broken.mcap", "b.mcap", folder=tmp_path)
    assert done.returncode == 3
    assert "broken.mcap: not an MCAP file." in done.stderr
    assert "Traceback" not in done.stderr
    assert sorted(path.name for path in (tmp_path / "here").iterdir()) == ["a", "b"]
    lines = done.stdout.splitlines()
    assert len({line.split()[1] for line in lines if line[:1] in "ab"}) == 1
    told = json.loads("\n".join(line for line in lines if line[:1] not in "ab"))
    assert [report.get("folder") for report in told["runs"]] == ["a", None, "b"]


def test_a_process_that_is_ended_from_outside_is_told_of(command, tmp_path):
    done = run(command, "killed.mcap", "a.mcap", folder=tmp_path)
    assert done.returncode == 1
    assert "killed.mcap: the process" in done.stderr
    assert "fewer --jobs" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_stops_all_processes_and_leaves_nothing_behind(command, tmp_path, number, code):
    with subprocess.Popen(
        [*command, "--out", "out", "slow.mcap", "slower.mcap", "a.mcap"],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
    ) as running:
        deadline = time.monotonic() + 60
        while len(list(tmp_path.glob("working-*"))) < 2 and time.monotonic() < deadline:
            time.sleep(0.05)
        running.send_signal(number)
        _, errors = running.communicate(timeout=30)
    assert running.returncode == code
    assert "Traceback" not in errors
    assert not list(tmp_path.glob("out/*"))


def test_progress_of_several_logs_is_shown_by_their_names():
    shown = []

    class Shown:
        @contextmanager
        def stage(self, name, total=None):
            shown.append(f"{name} begins, {total}")
            yield SimpleNamespace(advance_to=lambda done: shown.append(f"{name} at {done}"))
            shown.append(f"{name} ends")

    events = queue.Queue()
    first, second = _Reporter(0, events), _Reporter(1, events)
    jobs = [SimpleNamespace(log=Path(name)) for name in ("a.mcap", "b.mcap")]
    events.put((-1, "process", 1234))
    with first.stage("scan", 20.0) as stage, second.stage("read"):
        stage.advance_to(1.0)
        stage.advance_to(1.5)  # too soon after the last
    with _Board(jobs, Shown()) as board:
        board.show(events)
        assert board.processes == {1234}
        with second.stage("left open"):
            board.show(events)
            events.queue.clear()
    assert shown == [
        "a.mcap: scan begins, 20.0",
        "b.mcap: read begins, None",
        "a.mcap: scan at 1.0",
        "b.mcap: read ends",
        "a.mcap: scan ends",
        "b.mcap: left open begins, None",
        "b.mcap: left open ends",
    ]


def test_two_jobs_write_what_one_after_the_other_write(tmp_path):
    small_logs.write(tmp_path / "a.mcap")
    small_logs.write(tmp_path / "b.mcap", small_logs.events()[:-400])
    (tmp_path / "robot.toml").write_text(small_logs.ARRAY)
    for name, content in map_files(worlds.room()).items():
        (tmp_path / name).write_bytes(content)
    start = ",".join(map(str, small_logs.START))
    for jobs in ("1", "2"):
        command = ["process", "a.mcap", "b.mcap", "--jobs", jobs, "--out", f"by{jobs}"]
        command += ["--map", "map.yaml", "--start-pose", start, "--config", "robot.toml"]
        command += ["--figures", "none", "--no-cache", "--quiet"]
        code = "if __name__ == '__main__': from soundmap.cli import main; main()"
        subprocess.run([sys.executable, "-c", code, *command], cwd=tmp_path, check=True)
    alone, together = (contents(tmp_path / f"by{jobs}") for jobs in "12")
    assert {"a/sources.csv", "b/trajectory.tum", "b/audio_scans.npz"} <= set(alone)
    assert alone["a/sources.csv"].count(b"\n") > 1
    assert alone == together


def contents(folder: Path) -> dict[str, bytes]:
    """What all files of some runs hold, but for how long it took and when it was."""
    files = {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.suffix != ".html"
    }
    for name in [name for name in files if name.endswith("report.json")]:
        report = json.loads(files[name])
        del report["timings_s"], report["speed"]
        files[name] = json.dumps(report).encode()
    return files
