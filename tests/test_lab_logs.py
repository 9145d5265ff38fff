"""Two simulated logs of a lab with their truth, through the whole program as a user runs it."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from logwriter import reencoded_as_protobuf
from typer.testing import CliRunner

from soundmap.cli import app

ROOT = Path(__file__).resolve().parents[1]
LAB = ROOT.parent / "shared" / "data" / "lab"
PAPER = ROOT / "configs" / "paper.toml"

pytestmark = pytest.mark.skipif(not LAB.is_dir(), reason="the lab logs lie beside the checkout")


def soundmap(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return result.stdout


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def matched(found: list[dict[str, str]]) -> tuple[list[float], int]:
    """Distance of each true source to the nearest row not yet used, and the rows left over."""
    places = [(float(row["x_m"]), float(row["y_m"])) for row in found]
    errors = []
    for row in rows(LAB / "truth" / "run1.sources.csv"):
        away = [np.hypot(float(row["x_m"]) - x, float(row["y_m"]) - y) for x, y in places]
        nearest = int(np.argmin(away))
        errors.append(float(away[nearest]))
        del places[nearest]
    return errors, len(places)


def poses(path: Path) -> tuple[np.ndarray, np.ndarray]:
    table = np.loadtxt(path)
    heading = np.unwrap(2 * np.arctan2(table[:, 6], table[:, 7]))
    return table[:, 0] - 1_700_007_000, np.column_stack([table[:, 1:3], heading])


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """Both logs processed as the paper does, without a start pose, and compared."""
    folder = tmp_path_factory.mktemp("lab")
    settings = ["--config", PAPER, "--config", LAB / "robot.toml", "--map", LAB / "map.yaml"]
    soundmap("process", LAB / "run1.mcap", LAB / "run3.mcap", *settings, "--out", folder, "--quiet")
    soundmap("diff", folder / "run1", folder / "run3", "--out", folder / "diff", "--quiet")
    return folder


def test_the_papers_method_finds_every_source_as_near_as_the_paper_did(runs):
    errors, _ = matched(rows(runs / "run1" / "sources.csv"))
    assert max(errors) <= 0.29
    assert np.mean(errors) <= 0.17


def test_the_difference_to_the_silent_run_shows_every_source(runs):
    errors, _ = matched(rows(runs / "diff" / "sources.csv"))
    assert max(errors) <= 0.29


@pytest.mark.parametrize("run", ["run1", "run3"])
def test_the_trajectory_follows_the_truth(runs, run):
    time, truth = poses(LAB / "truth" / f"{run}.tum")
    own_time, own = poses(runs / run / "trajectory.tum")
    estimate = np.column_stack([np.interp(time, own_time, own[:, i]) for i in range(3)])
    off = estimate - truth
    heading = np.abs((off[:, 2] + np.pi) % (2 * np.pi) - np.pi)
    assert np.median(np.hypot(off[:, 0], off[:, 1])) <= 0.05
    assert np.degrees(heading.mean()) <= 1.0


def test_broken_odometry_is_reported(runs):
    report = json.loads((runs / "run1" / "report.json").read_text())
    assert [loss["count"] for loss in report["losses"] if "odometry" in loss["what"]] == [1334]


def test_by_default_every_source_is_found_and_nothing_else(tmp_path):
    soundmap(
        "process", LAB / "run1.mcap", "--config", LAB / "robot.toml", "--map", LAB / "map.yaml",
        "--out", tmp_path / "run1", "--quiet",
    )  # fmt: skip
    errors, false_alarms = matched(rows(tmp_path / "run1" / "sources.csv"))
    assert np.mean(errors) <= 0.03
    assert false_alarms == 0


def test_an_array_that_is_turned_is_found_out_and_its_sources_stay(tmp_path):
    mount = tmp_path / "mount.toml"  # that of the log, but for 6 degrees
    mount.write_text(f"[array]\nmount = [0.0, 0.0, 0.65, {np.radians(-6.0)}]\n")
    soundmap(
        "process", LAB / "run1.mcap", "--config", LAB / "robot.toml", "--config", mount,
        "--map", LAB / "map.yaml", "--out", tmp_path / "run1", "--quiet",
    )  # fmt: skip
    array = json.loads((tmp_path / "run1" / "report.json").read_text())["array"]
    assert array["yaw_verdict"] == "corrected"
    assert array["yaw_offset_deg"] == pytest.approx(6.0, abs=0.5)
    assert array["clock_offset_s"] == pytest.approx(0.0, abs=0.01)
    errors, false_alarms = matched(rows(tmp_path / "run1" / "sources.csv"))
    assert max(errors) <= 0.1
    assert false_alarms == 0
    with np.load(tmp_path / "run1" / "audio_scans.npz") as scans:
        axis = np.degrees(np.arctan2(scans["array_rotation"][1, 0], scans["array_rotation"][0, 0]))
    assert axis == pytest.approx(0.0, abs=0.5)


def test_the_same_log_in_protobuf_under_other_names_gives_the_same_sources(runs, tmp_path):
    log = tmp_path / "site.mcap"
    reencoded_as_protobuf(
        LAB / "run1.mcap",
        log,
        audio_topic="/robot/mics",
        laser_topics={"/scan_front": "/robot/lidar_1", "/scan_back": "/robot/lidar_2"},
        odometry_topic="/wheels",
        lasers_as_protobuf=False,
    )
    soundmap(
        "process", log, "--config", PAPER, "--config", LAB / "robot.toml",
        "--map", LAB / "map.yaml", "--out", tmp_path / "run", "--quiet",
    )  # fmt: skip
    errors, _ = matched(rows(tmp_path / "run" / "sources.csv"))
    assert max(errors) <= 0.29
    before, after = (
        rows(folder / "sources.csv")[0] for folder in (runs / "run1", tmp_path / "run")
    )
    assert np.hypot(*(float(before[k]) - float(after[k]) for k in ("x_m", "y_m"))) <= 0.1
    assert float(before["power_db"]) == pytest.approx(float(after["power_db"]), abs=0.5)


def test_the_same_log_gives_the_same_results(runs, tmp_path):
    soundmap(
        "process", LAB / "run3.mcap", "--config", PAPER, "--config", LAB / "robot.toml",
        "--map", LAB / "map.yaml", "--out", tmp_path / "run3", "--quiet",
    )  # fmt: skip
    for name in ("sources.csv", "trajectory.tum", "power_map.npz", "audio_scans.npz"):
        assert (tmp_path / "run3" / name).read_bytes() == (runs / "run3" / name).read_bytes(), name


def test_two_logs_at_a_time_give_the_same_results(runs, tmp_path):
    settings = ["--config", PAPER, "--config", LAB / "robot.toml", "--map", LAB / "map.yaml"]
    soundmap(
        "process", LAB / "run1.mcap", LAB / "run3.mcap", *settings, "--out", tmp_path, "--quiet",
        "--jobs", 2,
    )  # fmt: skip
    for run in ("run1", "run3"):
        for name in ("sources.csv", "trajectory.tum", "power_map.npz", "audio_scans.npz"):
            assert (tmp_path / run / name).read_bytes() == (runs / run / name).read_bytes(), name
