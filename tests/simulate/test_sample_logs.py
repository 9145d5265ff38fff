"""The sample logs belong to their scene: whoever changes it makes them again."""

from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from soundmap.map_file import map_files
from soundmap.simulate.map_image import drawn_map
from soundmap.simulate.scene_file import loaded_scene
from soundmap.simulate.simulation import drive_of, robot_toml, trajectory_tum

TOP = Path(__file__).parents[2]
LOGS, SCENE = TOP / "sample_logs", TOP / "configs" / "scenes" / "room.toml"


def test_map_and_robot_are_those_of_the_scene() -> None:
    scene = loaded_scene(SCENE)
    for name, content in map_files(drawn_map(scene)).items():
        assert (LOGS / name).read_bytes() == content
    assert (LOGS / "robot.toml").read_text() == robot_toml(scene)


@pytest.mark.parametrize("run", ["run1", "run3"])
def test_truth_is_that_of_the_scene_and_the_log_covers_it(run: str) -> None:
    scene = loaded_scene(SCENE)
    drive, chosen = drive_of(scene, run)
    rows = (LOGS / "truth" / f"{run}.sources.csv").read_text().splitlines()[1:]
    told = [(row.split(",")[0], *map(float, row.split(",")[1:4])) for row in rows]
    assert told == [(s.id, *s.position_m) for s in scene.sources if s.id in chosen.sources]
    stored = np.loadtxt(LOGS / "truth" / f"{run}.tum")
    fresh = np.loadtxt(trajectory_tum(drive).splitlines())
    assert stored == pytest.approx(fresh, abs=1e-5)
    with (LOGS / f"{run}.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    statistics = summary.statistics
    span_s = (statistics.message_end_time - statistics.message_start_time) * 1e-9
    assert span_s == pytest.approx(stored[-1, 0] - stored[0, 0], abs=0.1)
    assert {channel.topic for channel in summary.channels.values()} == {
        "/tf_static", "/odom", "/tf", "/audio", "/scan_front", "/scan_back",
    }  # fmt: skip


def test_the_logs_are_small_enough_to_ship() -> None:
    assert all((LOGS / f"{run}.mcap").stat().st_size < 20e6 for run in ("run1", "run3"))
