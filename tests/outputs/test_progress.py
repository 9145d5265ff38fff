import io
import sys

import pytest
from rich.console import Console

from soundmap.outputs.progress import SilentProgress, TerminalProgress, chosen_progress


def terminal() -> tuple[Console, io.StringIO]:
    screen = io.StringIO()
    return Console(file=screen, force_terminal=True, width=80), screen


def test_a_bar_shows_the_name_and_the_share_done_on_a_terminal():
    console, screen = terminal()
    with TerminalProgress(console).stage("localize", total=20.0) as stage:
        stage.advance_to(5.0)
    assert "localize" in screen.getvalue()
    assert "25 %" in screen.getvalue()


def test_stages_may_lie_inside_one_another_and_follow_one_another():
    console, screen = terminal()
    progress = TerminalProgress(console)
    with progress.stage("outer", total=None), progress.stage("inner", total=1.0) as inner:
        inner.advance_to(1.0)
    with progress.stage("later", total=1.0):
        pass
    for name in ("outer", "inner", "later"):
        assert name in screen.getvalue()


def test_the_bars_stop_when_the_work_fails():
    console, screen = terminal()
    progress = TerminalProgress(console)
    with pytest.raises(ZeroDivisionError), progress.stage("scan", total=1.0):
        _ = 1 / 0
    after = len(screen.getvalue())
    console.print("still writable")
    assert "still writable" in screen.getvalue()[after:]


def test_a_stage_name_is_not_taken_for_markup():
    console, screen = terminal()
    with TerminalProgress(console).stage("run[1]", total=1.0):
        pass
    assert "run[1]" in screen.getvalue()


@pytest.mark.parametrize(("terminal", "quiet"), [(False, False), (True, True), (False, True)])
def test_there_is_silence_unless_a_person_watches(monkeypatch, terminal, quiet):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
    assert isinstance(chosen_progress(quiet=quiet), SilentProgress)


def test_a_person_at_a_terminal_sees_bars(monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    assert isinstance(chosen_progress(quiet=False), TerminalProgress)


def test_silence_writes_nothing(capfd):
    with SilentProgress().stage("scan", total=3.0) as stage:
        stage.advance_to(2.0)
    assert capfd.readouterr() == ("", "")
