import io
import json
from dataclasses import replace

import numpy as np
import pytest
from handmade import NO_PICTURES, START_NS, round_trip, walled_room
from PIL import Image
from rich.console import Console

from soundmap.config import Config, loaded_config
from soundmap.errors import OutputError
from soundmap.losses import Loss
from soundmap.map_file import read_map
from soundmap.outputs.figures import map_figure
from soundmap.outputs.illustrator import Illustrator
from soundmap.outputs.map_folder import map_report, write_map_run
from soundmap.outputs.summary import map_view
from soundmap.run import MapRun


def made_map_run(log):
    facts = {
        "key_scans": 120,
        "unmatched": 1,
        "loops_recognised": 3,
        "loops_closed": 2,
        "residual_m": 0.0042,
        "residual_rad": 0.001,
        "odometry_distance_scale": 0.952,
        "odometry_turn_scale": 1.0,
        "odometry_turn_per_metre": 0.05,
    }
    return MapRun(
        log=log,
        fingerprint="0123abcd",
        config=Config(),
        room=walled_room(),
        trajectory=round_trip(),
        facts=facts,
        losses=(Loss("laser scan without odometry", "map", 3, "scan not used", True),),
        counts={"laser scanners": 2, "key scans": 120},
        timings_s={"read": 0.5, "map": 1.5},
        duration_s=20.0,
    )


@pytest.fixture
def run(tmp_path):
    return made_map_run(tmp_path / "hall.mcap")


def test_the_map_written_is_read_back_as_it_was(run, tmp_path):
    write_map_run(run, tmp_path, NO_PICTURES)
    found = read_map(tmp_path / "map.yaml")
    np.testing.assert_array_equal(found.occupied, run.room.occupied)
    np.testing.assert_array_equal(found.free, run.room.free)
    assert found.frame == run.room.frame


def test_the_image_has_its_first_row_at_the_top_as_map_server_wants(run, tmp_path):
    corner = np.zeros(run.room.frame.shape, dtype=bool)
    corner[0, 0] = True  # lower left
    write_map_run(replace(run, room=replace(run.room, occupied=corner)), tmp_path, Illustrator())
    with Image.open(tmp_path / "map.pgm") as image:
        pixels = np.asarray(image)
    assert pixels[-1, 0] == 0
    assert np.count_nonzero(pixels == 0) == 1
    assert set(np.unique(pixels)) <= {0, 205, 254}


def test_every_file_is_there_and_the_settings_can_be_used_again(run, tmp_path):
    report = write_map_run(run, tmp_path, Illustrator())
    expected = {
        "map.pgm",
        "map.yaml",
        "map.png",
        "trajectory.tum",
        "trajectory.npz",
        "report.json",
        "config.toml",
    }
    assert {path.name for path in tmp_path.iterdir()} == expected
    assert loaded_config([tmp_path / "config.toml"]) == run.config
    stored = json.loads((tmp_path / "report.json").read_text())
    assert stored["map"] == report["map"]
    assert stored["losses"][0]["count"] == 3
    table = np.loadtxt(tmp_path / "trajectory.tum")
    assert table.shape == (len(run.trajectory), 8)
    assert table[0, 0] == pytest.approx(START_NS * 1e-9)


def test_speed_counts_all_stages(run):
    report = map_report(run, {"read": 1.0, "map": 3.0, "outputs": 1.0})
    assert report["speed"] == pytest.approx(4.0)
    assert report["map"]["free_m2"] == pytest.approx(6.0 * 4.5)


def test_a_person_reads_what_the_odometry_was_worth(run):
    console = Console(width=100, file=io.StringIO())
    console.print(map_view({**map_report(run, run.timings_s), "folder": "hall"}))
    text = console.file.getvalue()
    assert "distance x 0.9520" in text
    assert "+2.86 degrees a metre" in text
    assert "2 closed of 3 recognised" in text
    assert "laser scan without odometry" in text


def test_a_folder_that_cannot_be_written_is_named(run, tmp_path):
    with pytest.raises(OutputError, match="nowhere"):
        write_map_run(run, tmp_path / "nowhere", NO_PICTURES)


def test_the_picture_shows_map_and_way(run):
    figure = map_figure(run.room, run.trajectory, "hall")
    axes = figure.axes[0]
    assert len(axes.images) == 1
    assert {"start", "end"} <= {line.get_label() for line in axes.lines}
