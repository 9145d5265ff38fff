from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rerun as rr
from handmade import NO_PICTURES, START_NS, made_ratio, made_run, walled_room
from rerun.chunk import RrdReader

import soundmap.retelling
from soundmap.config import DiffConfig
from soundmap.errors import LogError
from soundmap.geometry import Mount
from soundmap.outputs.progress import SilentProgress
from soundmap.outputs.run_folder import write_diff, write_run
from soundmap.retelling import recorded, recording_of, write_recording
from soundmap.sensors import LaserScan

SWEEPS = 100


@pytest.fixture(autouse=True)
def _strict():
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


def seen_from(pose: np.ndarray, bearing: np.ndarray) -> np.ndarray:
    """Distance to the walls of the room of 6 m x 4.5 m, by a closed form."""
    direction = bearing + pose[2]
    with np.errstate(divide="ignore"):
        across = np.where(np.cos(direction) > 0, 6.0 - pose[0], -pose[0]) / np.cos(direction)
        along = np.where(np.sin(direction) > 0, 4.5 - pose[1], -pose[1]) / np.sin(direction)
    return np.minimum(across, along)


@pytest.fixture
def run(tmp_path):
    (tmp_path / "run1.mcap").touch()
    run = made_run(tmp_path / "run1.mcap")
    usable = np.ones(len(run.trajectory), dtype=bool)
    mount = Mount.planar(0.0, 0.0, 0.5, 0.0)
    return replace(
        run,
        scans=replace(run.scans, mount=mount),
        trajectory=replace(run.trajectory, usable=usable),
    )


@pytest.fixture
def log(monkeypatch, run):
    """The log of the run: one scanner, which meets the walls exactly, ten times a second."""
    bearing = np.linspace(-3.0, 3.0, 721)

    def lasers():
        for number in range(SWEEPS):
            time_ns = START_NS + number * 100_000_000
            ranges = seen_from(run.trajectory.at(time_ns), bearing)
            yield LaserScan(time_ns, 0.0, bearing, ranges, 30.0, Mount.planar(0, 0, 0, 0), 0)

    opened = SimpleNamespace(fingerprint=run.fingerprint, lasers=lasers, odometry=run.trajectory)
    monkeypatch.setattr(soundmap.retelling, "open_log", lambda path, config: opened)
    return opened


def rows(file: Path, entity: str, component: str) -> list:
    found = []
    for chunk in RrdReader(file).stream():
        if str(chunk.entity_path).replace("\\", "") == entity:
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                if name.endswith(f":{component}"):
                    found += [row for row in batch.column(name).to_pylist() if row is not None]
    return found


def entities(file: Path) -> set[str]:
    return {str(chunk.entity_path) for chunk in RrdReader(file).stream()}


def test_laser_points_lie_on_the_walls_of_the_map(run, log, tmp_path):
    assert write_recording(run, tmp_path / "run.rrd") is None
    sweeps = rows(tmp_path / "run.rrd", "/world/run/laser_1", "positions")
    assert len(sweeps) == SWEEPS // 2  # five a second
    for points in sweeps:
        x, y = np.array(points)[:, :2].T
        off_wall = np.min(np.abs([x, x - 6.0, y, y - 4.5]), axis=0)
        assert off_wall.max() < 1e-4
        assert len(points) <= 540
    shares = rows(tmp_path / "run.rrd", "/plots/pose/laser_points_on_walls", "scalars")
    assert min(share[0] for share in shares) == 1.0


def test_a_pose_that_is_off_shows_in_the_share_of_points_on_walls(run, log, tmp_path):
    shifted = run.trajectory.pose + np.array([0.5, 0.3, 0.0])
    off = replace(run, trajectory=replace(run.trajectory, pose=shifted))
    write_recording(off, tmp_path / "run.rrd")
    shares = rows(tmp_path / "run.rrd", "/plots/pose/laser_points_on_walls", "scalars")
    assert max(share[0] for share in shares) < 0.5


def test_the_power_map_grows_and_hits_lie_on_walls_in_range(run, log, tmp_path):
    write_recording(run, tmp_path / "run.rrd")
    hits = np.array(rows(tmp_path / "run.rrd", "/world/run/laser_hit", "positions"))[:, 0, :2]
    x, y = hits.T
    assert len(hits) > 10
    assert np.min(np.abs([x, x - 6.0, y, y - 4.5]), axis=0).max() < 0.02
    maps = rows(tmp_path / "run.rrd", "/world/run/power", "data")
    seen = [np.count_nonzero(np.array(data[0][3::4], dtype=np.uint8)) for data in maps]
    assert len(maps) >= 3
    assert seen == sorted(seen)
    assert seen[0] < seen[-1]


def test_a_log_that_is_gone_or_changed_is_told_and_the_rest_recorded(run, log, tmp_path):
    file = tmp_path / "run.rrd"
    log.fingerprint = "another"
    assert "is not the one that this run was made of" in write_recording(run, file)
    gone = replace(run, log=tmp_path / "gone.mcap")
    remark = write_recording(gone, file)
    assert "gone.mcap: the log is no longer there" in remark
    assert "neither laser points nor" in remark
    assert "/world/result/sources" in entities(file)
    assert "/world/robot/audio_scan" in entities(file)
    assert not any("laser" in entity for entity in entities(file))


def test_a_log_that_cannot_be_read_is_told(run, monkeypatch, tmp_path):
    def refused(path, config):
        raise LogError(f"{path}: not an MCAP file.")

    monkeypatch.setattr(soundmap.retelling, "open_log", refused)
    assert "not an MCAP file" in write_recording(run, tmp_path / "run.rrd")


def test_the_recording_of_a_folder_is_made_once(run, log, tmp_path):
    folder = tmp_path / "run1"
    folder.mkdir()
    write_run(run, folder, NO_PICTURES)
    before = {path.name for path in folder.iterdir()}
    file, remark = recording_of(folder, progress=SilentProgress())
    assert (file, remark) == (folder / "run.rrd", None)
    assert {path.name for path in folder.iterdir()} - before == {"run.rrd"}
    written = file.stat().st_mtime_ns
    assert recording_of(folder, progress=SilentProgress()) == (file, None)
    assert file.stat().st_mtime_ns == written


def test_a_recording_that_fails_leaves_nothing(run, log, tmp_path):
    folder = tmp_path / "run1"
    folder.mkdir()
    write_run(run, folder, NO_PICTURES)
    before = {path.name for path in folder.iterdir()}

    def broken():
        raise RuntimeError("stop")

    log.lasers = broken
    with pytest.raises(RuntimeError, match="stop"):
        recording_of(folder, progress=SilentProgress())
    assert {path.name for path in folder.iterdir()} == before


def test_a_difference_has_a_recording_of_its_own(tmp_path):
    write_diff(
        made_ratio(),
        tmp_path,
        NO_PICTURES,
        room=walled_room(),
        run=Path("run1"),
        background=Path("run3"),
        config=DiffConfig(),
        timings_s={},
    )
    file, _ = recording_of(tmp_path, progress=SilentProgress())
    assert file.name == "diff.rrd"
    assert "/world/result/power_ratio" in entities(file)


def test_what_is_no_run_folder_has_no_recording(tmp_path):
    with pytest.raises(LogError, match="no run folder"):
        recording_of(tmp_path, progress=SilentProgress())
    assert list(tmp_path.iterdir()) == []


def test_the_time_of_recording_is_told(run, log, tmp_path):
    timed = recorded(run, tmp_path, progress=SilentProgress())
    assert timed.timings_s["record"] > 0
    assert (tmp_path / "run.rrd").is_file()
