"""The sample logs through the whole program, as the README tells a newcomer to run it."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from soundmap.cli import app

SAMPLES = Path(__file__).resolve().parents[1] / "sample_logs"
TRUTH = SAMPLES / "truth"


def soundmap(*arguments: object) -> dict:
    result = CliRunner().invoke(app, [str(argument) for argument in (*arguments, "--json")])
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Both logs processed by default and compared."""
    folder = tmp_path_factory.mktemp("samples")
    logs = (SAMPLES / "run1.mcap", SAMPLES / "run3.mcap")
    common = ("--map", SAMPLES / "map.yaml", "--out", folder, "--figures", "none")
    soundmap("process", *logs, *common, "--strict")  # nothing is wrong with them
    runs = (folder / "run1", folder / "run3")
    soundmap("diff", *runs, "--out", folder / "diff", "--figures", "none")
    return folder


@pytest.mark.parametrize("name", ["run1", "run3"])
def test_every_machine_that_runs_is_found_and_nothing_else(folder, name):
    truth = ("--sources", TRUTH / f"{name}.sources.csv", "--trajectory", TRUTH / f"{name}.tum")
    found = soundmap("evaluate", folder / name, *truth)
    assert all(source["detected"] for source in found["sources"])
    assert found["false_alarms"] == 0
    assert found["max_error_m"] is None or found["max_error_m"] < 0.1
    assert found["trajectory"]["median_m"] < 0.02


def test_the_difference_shows_the_machines_that_were_switched_on(folder):
    found = soundmap("evaluate", folder / "diff", "--sources", TRUTH / "run1.sources.csv")
    assert all(source["detected"] for source in found["sources"])
    assert found["false_alarms"] == 0
    changes = json.loads((folder / "diff" / "report.json").read_text())["changes"]
    assert {change["kind"] for change in changes} == {"appeared"}
    assert all(change["false_alarm_probability"] < 1e-6 for change in changes)
