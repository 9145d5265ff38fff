import json
import re
import time
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from handmade import made_ratio, made_run, unlucky_run

from soundmap.config import Config, DiffConfig, loaded_config
from soundmap.errors import LogError, OutputError
from soundmap.geometry import Trajectory
from soundmap.map_file import read_map
from soundmap.outputs.illustrator import Illustrator
from soundmap.outputs.run_folder import tum_text, write_diff, write_run
from soundmap.outputs.stored_run import read_power_map

CONTENT = {
    "audio_scans.npz",
    "audio_scans.png",
    "config.toml",
    "map.pgm",
    "map.yaml",
    "power_map.npz",
    "power_map.png",
    "reflections.csv",
    "report.html",
    "report.json",
    "sources.csv",
    "trajectory.npz",
    "trajectory.png",
    "trajectory.tum",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run1")
    write_run(made_run(), folder, Illustrator())
    return folder


def test_a_run_folder_holds_every_file(folder):
    assert {path.name for path in folder.iterdir()} == CONTENT


def test_the_power_map_shows_the_cells_above_the_visit_threshold_and_keeps_the_sums(folder):
    run = made_run()
    stored = np.load(folder / "power_map.npz", allow_pickle=False)
    np.testing.assert_array_equal(stored["power"], run.power_map.power(min_visit_share=0.1))
    np.testing.assert_array_equal(stored["power_sum"], run.power_map.power_sum)
    np.testing.assert_array_equal(stored["visits"], run.power_map.visits)
    rarely = (run.power_map.visits > 0) & (run.power_map.visits <= 0.1 * run.power_map.visits.max())
    assert rarely.any()
    assert np.isnan(stored["power"][rarely]).all()
    assert stored["power"].dtype == np.float64
    assert float(stored["resolution_m"]) == 0.05
    assert stored["origin_m"].tolist() == [-0.5, -0.5]
    assert int(stored["schema_version"]) == 1
    assert str(stored["reference"]) == "dB re (full scale)^2"
    assert str(stored["power_unit"]) == "(full scale)^2"


def test_the_power_map_reads_back_as_it_was(folder):
    power_map, share = read_power_map(folder)
    expected = made_run().power_map
    assert (power_map.frame, power_map.reference, share) == (
        expected.frame,
        expected.reference,
        0.1,
    )
    np.testing.assert_array_equal(power_map.power_sum, expected.power_sum)
    np.testing.assert_array_equal(power_map.visits, expected.visits)


def test_the_audio_scans_keep_times_bearings_and_powers(folder):
    scans = made_run().scans
    stored = np.load(folder / "audio_scans.npz", allow_pickle=False)
    assert (stored["time_ns"].dtype, stored["power"].dtype) == (np.int64, np.float32)
    np.testing.assert_array_equal(stored["time_ns"], scans.time_ns)
    np.testing.assert_array_equal(stored["bearing_rad"], scans.bearing_rad)
    np.testing.assert_array_equal(stored["power"], scans.power)


def test_the_trajectory_is_exact_to_the_nanosecond_and_its_quaternions_are_rotations(folder):
    trajectory = made_run().trajectory
    rows = [line.split() for line in (folder / "trajectory.tum").read_text().splitlines()]
    assert [Fraction(row[0]) * 10**9 for row in rows] == trajectory.time_ns.tolist()
    table = np.array(rows, dtype=np.float64)
    np.testing.assert_allclose(table[:, 1:3], trajectory.pose[:, :2], atol=1e-6)
    assert np.all(table[:, 3:6] == 0.0)
    np.testing.assert_allclose(np.hypot(table[:, 6], table[:, 7]), 1.0, atol=1e-8)
    heading = 2.0 * np.arctan2(table[:, 6], table[:, 7])
    np.testing.assert_allclose(np.cos(heading - trajectory.pose[:, 2]), 1.0, atol=1e-9)


def test_the_trajectory_has_one_line_a_laser_scan():
    time_ns = 1_700_000_000_000_000_000 + np.arange(4, dtype=np.int64)
    is_scan = np.array([True, False, False, True])
    text = tum_text(Trajectory(time_ns, np.zeros((4, 3)), np.ones(4, bool), is_scan=is_scan))
    assert [line.split()[0][-1] for line in text.splitlines()] == ["0", "3"]


def test_times_before_1970_and_around_it_are_written_right():
    time_ns = np.array([-1_500_000_000, -1, 0, 1])
    text = tum_text(Trajectory(time_ns, np.zeros((4, 3)), np.ones(4, dtype=bool)))
    seconds = [line.split()[0] for line in text.splitlines()]
    assert seconds == ["-1.500000000", "-0.000000001", "0.000000000", "0.000000001"]


def test_the_map_and_the_configuration_read_back_as_they_were(folder):
    room = read_map(folder / "map.yaml")
    np.testing.assert_array_equal(room.occupied, made_run().room.occupied)
    np.testing.assert_array_equal(room.free, made_run().room.free)
    assert loaded_config([folder / "config.toml"]) == Config()


def test_a_configuration_with_every_kind_of_value_reads_back(tmp_path):
    config = Config.model_validate(
        {
            "array": {"positions_m": [[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0]], "frame": "mics"},
            "topics": {"lasers": ["/a", "/b"]},
            "mounts": {"laser/front": [0.1, 0.0, 0.2, 0.5]},
            "scan": {"low_hz": 500.0},
        }
    )
    write_run(made_run(config=config), tmp_path, Illustrator())
    assert loaded_config([tmp_path / "config.toml"]) == config


def test_the_report_file_is_what_the_function_returns(tmp_path):
    report = write_run(made_run(), tmp_path, Illustrator())
    stored = json.loads((tmp_path / "report.json").read_text())
    assert stored["sources"] == report["sources"]
    assert stored["timings_s"]["outputs"] > 0.0
    assert stored["timings_s"]["localize"] == 1.25


def test_equal_results_give_equal_bytes_whenever_they_are_written(folder, tmp_path, monkeypatch):
    later = time.time() + 40_000_000.0
    monkeypatch.setattr(time, "time", lambda: later)
    write_run(made_run(), tmp_path, Illustrator())
    for name in CONTENT - {"report.json", "report.html"}:
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes(), name
    reports = [json.loads((place / "report.json").read_text()) for place in (tmp_path, folder)]
    for report in reports:
        del report["timings_s"], report["speed"]
    assert reports[0] == reports[1]
    timed = re.compile("<dt>(speed|time)</dt><dd>.*?</dd>")
    pages = [(place / "report.html").read_text() for place in (tmp_path, folder)]
    assert timed.sub("", pages[0]) == timed.sub("", pages[1])


def test_a_run_that_heard_nothing_has_a_whole_folder_too(tmp_path):
    report = write_run(unlucky_run(), tmp_path, Illustrator())
    assert {path.name for path in tmp_path.iterdir()} == CONTENT
    assert report["sources"] == []
    assert np.isnan(np.load(tmp_path / "power_map.npz")["power"]).all()


def test_a_full_disk_is_an_output_error(tmp_path, monkeypatch):
    def full(self, *_args, **_keywords):
        raise OSError(28, "No space left on device", str(self))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OutputError, match=r"map\.pgm.*No space left on device"):
        write_run(made_run(), tmp_path, Illustrator())


def test_a_diff_folder_holds_every_file_and_its_ratio(tmp_path):
    ratio = made_ratio()
    report = write_diff(
        ratio,
        tmp_path,
        Illustrator(),
        room=made_run().room,
        run=Path("runs/run1"),
        background=Path("runs/run3"),
        config=DiffConfig(),
        timings_s={"compare": 0.1},
    )
    assert {path.name for path in tmp_path.iterdir()} == {
        "changes.csv",
        "map.pgm",
        "map.yaml",
        "power_ratio.npz",
        "power_ratio.png",
        "report.html",
        "report.json",
        "sources.csv",
    }
    stored = np.load(tmp_path / "power_ratio.npz", allow_pickle=False)
    np.testing.assert_array_equal(stored["ratio_db"], ratio.ratio_db)
    np.testing.assert_array_equal(stored["background_measured"], ratio.background_measured)
    assert stored["origin_m"].tolist() == [-0.5, -0.5]
    lines = (tmp_path / "sources.csv").read_text().splitlines()
    assert lines[0].startswith("id,x_m,y_m,ratio_db,visits,kind,")
    assert lines[1:] == [
        "S1,3.125,0.275,26.02,22,appeared,,1e-09,S1,",
        "S2,5.725,3.375,19.9,17,louder,0.4,0.002,S2,S1",
    ]
    every = (tmp_path / "changes.csv").read_text().splitlines()
    assert every[:3] == lines
    assert every[3:] == [
        "S3,1.0,3.0,-14.0,2,gone,,0.001,,S2",
        "S4,3.0,4.2,0.7,9,unchanged,0.5,0.8,S3,S3",
    ]
    assert report["timings_s"]["compare"] == 0.1


def test_a_diff_folder_without_a_map_has_none(tmp_path):
    write_diff(
        made_ratio(),
        tmp_path,
        Illustrator(),
        room=None,
        run=Path("run1"),
        background=Path("run3"),
        config=DiffConfig(),
        timings_s={},
    )
    assert not (tmp_path / "map.pgm").exists()
    assert (tmp_path / "power_ratio.png").exists()


def stored_arrays(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / "power_map.npz") as stored:
        return dict(stored)


def test_a_folder_that_is_no_run_folder_is_named(tmp_path):
    for folder in (tmp_path, tmp_path / "missing"):
        with pytest.raises(LogError, match=f"{re.escape(str(folder))}: no run folder"):
            read_power_map(folder)


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "text", "bare array"])
def test_a_damaged_power_map_is_said_so(folder, tmp_path, damage):
    sound = (folder / "power_map.npz").read_bytes()
    file = tmp_path / "power_map.npz"
    if damage == "bare array":
        with file.open("wb") as stream:
            np.save(stream, np.zeros(3))
    else:
        middle = len(sound) // 2
        flipped = sound[:middle] + bytes(255 - byte for byte in sound[middle : middle + 64])
        file.write_bytes(
            {
                "cut": sound[:middle],
                "flipped": flipped + sound[middle + 64 :],
                "empty": b"",
                "text": b"power map",
            }[damage]
        )
    with pytest.raises(LogError, match="cannot be read as a power map"):
        read_power_map(tmp_path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("visits", np.zeros((2, 2), dtype=np.int64)),
        ("visits", np.zeros((110, 140))),
        ("visits", None),
        ("visits", np.full((110, 140), -1)),
        ("power_sum", np.full((110, 140), np.nan)),
        ("resolution_m", 0.0),
        ("resolution_m", np.nan),
        ("origin_m", np.zeros(3)),
        ("reference", "dB"),
        ("min_visit_share", "much"),
        ("visits", np.array({"a": 1}, dtype=object)),
    ],
)
def test_impossible_content_of_a_power_map_is_refused(folder, tmp_path, name, value):
    arrays = stored_arrays(folder) | {name: value}
    np.savez(tmp_path / "power_map.npz", **{k: v for k, v in arrays.items() if v is not None})
    with pytest.raises(LogError, match="cannot be read as a power map"):
        read_power_map(tmp_path)


def test_a_power_map_of_a_newer_soundmap_is_refused(folder, tmp_path):
    np.savez(tmp_path / "power_map.npz", **(stored_arrays(folder) | {"schema_version": 2}))
    with pytest.raises(LogError, match=r"newer soundmap .schema 2; this one reads up to 1"):
        read_power_map(tmp_path)
