import os
import sys
from pathlib import Path

import pytest

import soundmap.outputs.viewer
from soundmap.errors import OutputError
from soundmap.outputs.viewer import elsewhere, has_display, show


@pytest.fixture
def viewer(monkeypatch, tmp_path) -> Path:
    """A viewer that writes down how it was called, and ends as the environment says."""
    program = tmp_path / "rerun"
    program.write_text(
        f'#!/bin/sh\nprintf "%s\\n" "$@" > {tmp_path}/arguments\nexit ${{VIEWER_CODE:-0}}\n'
    )
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    return tmp_path / "arguments"


def test_the_viewer_listens_on_this_machine_alone(viewer):
    show(Path("run1/run.rrd"))
    assert viewer.read_text().split() == ["run1/run.rrd", "--bind", "127.0.0.1"]


def test_a_viewer_that_fails_is_told_with_a_way_out(viewer, monkeypatch):
    monkeypatch.setenv("VIEWER_CODE", "7")
    with pytest.raises(OutputError, match=r"ended with code 7(.|\n)*scp .*run\.rrd"):
        show(Path("run1/run.rrd"))


def test_a_missing_viewer_is_told_with_the_package_that_brings_it(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setattr(soundmap.outputs.viewer.shutil, "which", lambda _: None)
    with pytest.raises(OutputError, match=r"not installed.*pip install 'rerun-sdk~=\d+\.\d+\.0'"):
        show(Path("run1/run.rrd"))


def test_the_way_to_look_at_it_elsewhere_names_the_whole_path(tmp_path):
    text = elsewhere(tmp_path / "run.rrd")
    assert f":{os.path.realpath(tmp_path)}/run.rrd ." in text
    assert "rerun run.rrd" in text


@pytest.mark.parametrize(
    ("platform", "display", "wayland", "expected"),
    [
        ("linux", "", "", False),
        ("linux", ":0", "", True),
        ("linux", "", "wayland-0", True),
        ("darwin", "", "", True),
    ],
)
def test_a_display_is_found_where_there_is_one(monkeypatch, platform, display, wayland, expected):
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.setenv("WAYLAND_DISPLAY", wayland)
    assert has_display() is expected
