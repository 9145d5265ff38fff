"""The two commands from outside: simulate a scene, judge a run."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from soundmap.cli import app

SCENE = """\
name = "closet"
[[walls]]
name = "outer"
corners_m = [[0.0, 0.0], [3.0, 0.0], [3.0, 2.0], [0.0, 2.0]]
[robot]
way_points_m = [[1.0, 1.0]]
rest_s = 0.1
[array]
microphones = 2
"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "closet.toml"
    path.write_text(SCENE)
    return path


def test_simulate_writes_all_files_and_tells_the_next_command(scene: Path) -> None:
    out = scene.parent / "out"
    outcome = CliRunner().invoke(app, ["simulate", str(scene), "--out", str(out)])
    assert outcome.exit_code == 0, outcome.output
    assert sorted(file.name for file in out.iterdir()) == [
        "closet.mcap", "map.pgm", "map.yaml", "robot.toml", "sources.csv", "trajectory.tum",
    ]  # fmt: skip
    assert f"soundmap process {out / 'closet.mcap'} --map {out / 'map.yaml'}" in outcome.stdout
    assert not [file for file in scene.parent.iterdir() if file.name.startswith(".")]


def test_a_full_folder_is_refused_and_with_force_keeps_its_other_files(scene: Path) -> None:
    arguments = ["simulate", str(scene), "--out", str(scene.parent)]
    refused = CliRunner().invoke(app, arguments)
    assert refused.exit_code == 1
    assert "--force" in refused.stderr
    forced = CliRunner().invoke(app, [*arguments, "--force", "--quiet"])
    assert (forced.exit_code, forced.stdout) == (0, "")
    assert scene.read_text() == SCENE


def test_an_impossible_scene_is_a_usage_error_with_its_line(scene: Path) -> None:
    scene.write_text(SCENE.replace("[1.0, 1.0]", "[5.0, 1.0]"))
    outcome = CliRunner().invoke(app, ["simulate", str(scene), "--out", str(scene.parent / "o")])
    assert outcome.exit_code == 2
    assert "line 6: robot.way_points_m: way point 1 at (5, 1) lies outside" in outcome.stderr
    assert not (scene.parent / "o").exists()


def test_evaluate_prints_a_table_or_one_json_object(tmp_path: Path) -> None:
    (tmp_path / "sources.csv").write_text("id,x_m,y_m,power_db,visits\nS1,1.1,2.0,50,9\n")
    (tmp_path / "truth.csv").write_text("id,x_m,y_m\nfan,1.0,2.0\n")
    arguments = ["evaluate", str(tmp_path), "--sources", str(tmp_path / "truth.csv")]
    table = CliRunner().invoke(app, arguments)
    assert table.exit_code == 0
    assert [line.split()[-3:] for line in table.stdout.splitlines() if "fan" in line] == [
        ["fan", "fan", "0.100"]
    ]
    result = json.loads(CliRunner().invoke(app, [*arguments, "--json"]).stdout)
    assert result["mean_error_m"] == pytest.approx(0.1)
    assert CliRunner().invoke(app, [*arguments[:3], "missing.csv"]).exit_code == 3
