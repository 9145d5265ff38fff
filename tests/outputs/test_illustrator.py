"""Pictures drawn by another process: the same ones, and nobody is left behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from handmade import made_ratio, made_run, walled_room

from soundmap.outputs import illustrator as module
from soundmap.outputs.illustrator import Illustrator, illustrator
from soundmap.outputs.picture_format import PictureFormat
from soundmap.outputs.pictures import difference_pictures, run_pictures

TESTS = Path(__file__).resolve().parents[1]
OPENING = {
    PictureFormat.PNG: b"\x89PNG",
    PictureFormat.PDF: b"%PDF",
    PictureFormat.SVG: b"<?xml",
}


@pytest.fixture
def processes(monkeypatch) -> list[subprocess.Popen[bytes]]:
    """Two cores, whatever the machine has, and the processes that were started."""
    started = []

    class Noted(subprocess.Popen):
        def __init__(self, *args, **keywords):
            super().__init__(*args, **keywords)
            started.append(self)

    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    monkeypatch.setattr(subprocess, "Popen", Noted)
    return started


def pictures():
    return difference_pictures(made_ratio(), room=walled_room(), title="run1 against run3")


def written(who: Illustrator, folder: Path) -> dict[str, bytes]:
    folder.mkdir()
    who.write(run_pictures(made_run()), folder)
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def is_alive(process_id: int) -> bool:
    """Whether a process runs; one that has ended and waits for its parent does not."""
    try:
        state = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


@pytest.mark.parametrize("form", list(OPENING))
def test_a_picture_comes_in_the_format_asked_for_with_something_for_a_browser(tmp_path, form):
    (shown,) = Illustrator(form).write(pictures(), tmp_path).values()
    (file,) = tmp_path.iterdir()
    assert file.name == f"power_ratio.{form}"
    assert file.read_bytes().startswith(OPENING[form])
    assert shown.startswith(OPENING[PictureFormat.PNG if form == PictureFormat.PDF else form])


@pytest.mark.parametrize("form", list(OPENING))
def test_another_process_draws_the_same_bytes_whether_begun_early_or_not(tmp_path, processes, form):
    here = written(Illustrator(form), tmp_path / "here")
    with illustrator(form) as who:
        early = run_pictures(made_run())
        who.begin({"audio_scans": early["audio_scans"]})
        assert written(who, tmp_path / "there") == here
        (process,) = processes
        assert process.poll() is None  # it has done it all
    assert process.poll() is not None


def test_what_the_other_process_fails_to_draw_is_drawn_here(tmp_path, processes):
    here = written(Illustrator(), tmp_path / "here")
    with illustrator(PictureFormat.PNG) as who:
        who.begin(run_pictures(made_run()))
        processes[0].kill()
        assert written(who, tmp_path / "there") == here


def test_what_nobody_can_draw_is_an_error_of_this_process(tmp_path, processes):
    with illustrator(PictureFormat.PNG) as who, pytest.raises(ZeroDivisionError):
        who.write({"nothing": undrawable}, tmp_path)
    assert list(tmp_path.iterdir()) == []


def undrawable():
    return 1 / 0


def test_without_pictures_or_a_second_core_there_is_no_other_process(
    tmp_path, processes, monkeypatch
):
    with illustrator(PictureFormat.NONE) as who:
        assert who.write({"nothing": undrawable}, tmp_path) == {}
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    with illustrator(PictureFormat.PNG) as who:
        who.write(pictures(), tmp_path)
    assert processes == []
    assert len(list(tmp_path.iterdir())) == 1


def test_where_no_process_can_be_started_pictures_are_drawn_here(tmp_path, monkeypatch):
    def refused(*_, **__):
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(subprocess, "Popen", refused)
    monkeypatch.setattr(module, "usable_cores", lambda: 2)
    with illustrator(PictureFormat.PNG) as who:
        who.write(pictures(), tmp_path)
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("stop", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_the_other_process_ends_with_the_work_however_that_ends(processes, stop):
    def stopped():
        with illustrator(PictureFormat.PNG) as who:
            who.begin(pictures())
            raise stop

    with pytest.raises(stop):
        stopped()
    assert processes[0].returncode is not None


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at Linux's processes")
@pytest.mark.parametrize("after_s", [0.0, 1.5])
def test_the_other_process_does_not_outlive_one_that_is_killed(after_s):
    program = (
        "import sys, time; sys.path.insert(0, sys.argv[1])\n"
        "import subprocess; before = subprocess.Popen\n"
        "def noted(*a, **k):\n"
        "    process = before(*a, **k); print(process.pid, flush=True); return process\n"
        "subprocess.Popen = noted\n"
        "from handmade import made_run\n"
        "from soundmap.outputs.illustrator import illustrator\n"
        "from soundmap.outputs.picture_format import PictureFormat\n"
        "from soundmap.outputs.pictures import run_pictures\n"
        "with illustrator(PictureFormat.PNG) as who:\n"
        "    who.begin(run_pictures(made_run())); time.sleep(60)\n"
    )
    command = [sys.executable, "-c", program, str(TESTS)]
    environment = {**os.environ, "NUMBA_NUM_THREADS": "2"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as parent:
        child = int(parent.stdout.readline())
        time.sleep(after_s)
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    deadline = time.monotonic() + 20.0
    while is_alive(child) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not is_alive(child)


def test_without_pictures_nothing_that_draws_is_loaded(tmp_path):
    program = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from pathlib import Path\n"
        "from handmade import NO_PICTURES, made_run\n"
        "from soundmap.outputs.run_folder import write_run\n"
        "write_run(made_run(), Path(sys.argv[2]), NO_PICTURES)\n"
        "print([name for name in ('matplotlib', 'PIL', 'rerun') if name in sys.modules])"
    )
    command = [sys.executable, "-c", program, str(TESTS), str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"
    assert (tmp_path / "report.html").is_file()
