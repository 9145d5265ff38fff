import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from handmade import (
    START_NS,
    fitted_run,
    limited_run,
    made_ratio,
    made_run,
    unlucky_run,
    walled_room,
)
from rerun.chunk import RrdReader

from soundmap.geometry import Mount
from soundmap.outputs.markdown import difference_markdown, run_markdown
from soundmap.outputs.recording import run_recording, write_difference_recording
from soundmap.outputs.stored_run import StoredDifference


@pytest.fixture(autouse=True)
def _strict():
    """Data that Rerun would drop with a warning is an error here."""
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


class Recorded:
    """What a recording holds, by entity: columns by their short name, and times."""

    def __init__(self, file: Path) -> None:
        self.batches: dict[str, list] = {}
        for chunk in RrdReader(file).stream():
            path = str(chunk.entity_path).replace("\\", "")
            self.batches.setdefault(path, []).append(chunk.to_record_batch())

    def values(self, entity: str, component: str) -> list:
        """All rows of a component, in the order of the file."""
        rows = []
        for batch in self.batches[entity]:
            for name in batch.schema.names:
                if name.endswith(f":{component}"):
                    rows += [row for row in batch.column(name).to_pylist() if row is not None]
        return rows

    def times_ns(self, entity: str) -> list[int]:
        times = []
        for batch in self.batches[entity]:
            if "time" in batch.schema.names:
                times += batch.column("time").cast("int64").to_pylist()
        return times

    def is_static(self, entity: str) -> bool:
        return all("time" not in batch.schema.names for batch in self.batches[entity])

    def picture(self, entity: str, row: int = 0) -> np.ndarray:
        """A grid as the viewer draws it, first row on top, shape (H, W, 4)."""
        (form,) = self.values(entity, "format")[row]
        data = np.array(self.values(entity, "data")[row][0], dtype=np.uint8)
        return data.reshape(form["height"], form["width"], 4)

    def corner_m(self, entity: str, row: int = 0) -> list[float]:
        """Lower-left corner of a grid."""
        return self.values(entity, "translation")[row][0][:2]


@pytest.fixture(scope="module")
def run():
    run = made_run()
    mount = Mount.planar(0.1, 0.0, 0.6, np.pi / 2)
    if not hasattr(run.trajectory, "covariance"):
        return replace(run, scans=replace(run.scans, mount=mount))
    covariance = np.tile(np.diag([0.04, 0.01, 0.001]), (len(run.trajectory), 1, 1))
    return replace(
        run,
        scans=replace(run.scans, mount=mount),
        trajectory=replace(run.trajectory, covariance=covariance),
    )


@pytest.fixture(scope="module")
def recorded(run, tmp_path_factory) -> Recorded:
    file = tmp_path_factory.mktemp("recording") / "run.rrd"
    rr.set_strict_mode(True)
    with run_recording(run, file) as drawn:
        for step in range(3):
            time_ns = START_NS + step * 200_000_000
            drawn.add_laser(time_ns, 0, np.array([[1.0, 2.0], [3.0, step]]), 0.5)
            drawn.add_hit(time_ns, np.array([1.0, 1.0]), np.array([2.0, float(step)]))
            drawn.add_power_map(time_ns, run.power_map)
    return Recorded(file)


def test_the_sources_stand_in_the_map_cell_that_the_run_gives(recorded, run):
    points = np.array(recorded.values("/world/result/sources", "positions")[0])
    frame = run.power_map.frame
    expected = [frame.cells([source.x_m, source.y_m]).tolist() for source in run.sources]
    assert frame.cells(points[:, :2].astype(np.float64)).tolist() == expected
    (labels,) = recorded.values("/world/result/source_labels", "labels")
    assert labels == ["S1  -64.0 dB", "S2  -70.0 dB"]


def test_results_are_seen_whatever_the_time(recorded):
    for entity in ("sources", "source_labels", "power", "trajectory"):
        assert recorded.is_static(f"/world/result/{entity}")
    assert recorded.is_static("/world/map")
    assert recorded.is_static("/summary")


def test_the_map_is_the_right_way_up(tmp_path, run):
    room = walled_room()
    occupied = room.occupied.copy()
    occupied[15, 100] = True  # an L in the lower right: 4.5 m to the right, 0.25 m up
    with run_recording(replace(run, room=replace(room, occupied=occupied)), tmp_path / "run.rrd"):
        pass
    recorded = Recorded(tmp_path / "run.rrd")
    picture = recorded.picture("/world/map")
    rows, columns = room.frame.shape
    assert picture.shape == (rows, columns, 4)
    wall, floor = picture[rows - 1 - 15, 100], picture[15, 100]
    assert wall.tolist() == [90, 95, 105, 255]
    assert floor.tolist() == [236, 238, 240, 255]
    assert recorded.corner_m("/world/map") == pytest.approx([-0.5, -0.5])


def test_limits_are_pale(tmp_path):
    run = limited_run()
    file = tmp_path / "run.rrd"
    with run_recording(run, file):
        pass
    alpha = Recorded(file).picture("/world/result/power")[..., 3]
    assert set(np.unique(alpha)) == {0, 76, 255}


def test_the_power_map_shows_its_loudest_cell_where_it_is_and_nothing_unmeasured(recorded, run):
    power = run.power_map.power(min_visit_share=run.config.detect.min_visit_share)
    picture = recorded.picture("/world/result/power")[::-1]
    seen = picture[..., 3] > 0
    frame = run.power_map.frame
    offset = np.array(recorded.corner_m("/world/result/power")) - np.array(frame.origin_m)
    column, row = np.rint(offset / frame.resolution_m).astype(int)
    part = power[row : row + seen.shape[0], column : column + seen.shape[1]]
    np.testing.assert_array_equal(seen, np.isfinite(part))
    assert np.isfinite(part).sum() == np.isfinite(power).sum()
    brightest = np.unravel_index(np.nanargmax(part), part.shape)
    assert picture[brightest][:3].tolist() == [253, 231, 36]  # the upper end of viridis


def test_what_happened_lies_on_the_times_of_the_log(recorded, run):
    assert recorded.times_ns("/world/robot") == run.trajectory.time_ns.tolist()
    assert recorded.times_ns("/world/robot/audio_scan") == run.scans.time_ns.tolist()
    lasers = [START_NS, START_NS + 200_000_000, START_NS + 400_000_000]
    for entity in ("laser_1", "chosen_bearing", "laser_hit", "power"):
        assert recorded.times_ns(f"/world/run/{entity}") == lasers
    at = np.array(recorded.values("/world/robot", "translation"))[:, 0, :2]
    np.testing.assert_allclose(at, run.trajectory.pose[:, :2], atol=1e-6)


def test_the_trajectory_grows_to_its_full_length(recorded, run):
    strips = recorded.values("/world/run/trajectory", "strips")
    lengths = [len(strip[0]) for strip in strips]
    assert lengths == sorted(lengths)
    last = np.array(strips[-1][0])[:, :2]
    np.testing.assert_allclose(last[-1], run.trajectory.pose[-1, :2], atol=1e-6)
    np.testing.assert_allclose(last[0], run.trajectory.pose[0, :2], atol=1e-6)


def test_the_polar_curve_points_at_the_loudest_bearing_in_the_robots_frame(recorded, run):
    scans = run.scans
    curves = recorded.values("/world/robot/audio_scan", "strips")
    for index in (0, 90, len(scans) - 1):
        from_array = np.array(curves[index][0])[:, :2] - [0.1, 0.0]
        farthest = from_array[np.argmax(np.hypot(*from_array.T))]
        loudest = scans.bearing_rad[np.argmax(scans.power[index])] + np.pi / 2  # the mount's yaw
        apart = np.arctan2(farthest[1], farthest[0]) - loudest
        assert np.cos(apart) == pytest.approx(1.0, abs=1e-6)


def test_the_uncertainty_is_an_ellipse_of_two_standard_deviations(recorded, run):
    ellipse = np.array(recorded.values("/world/run/pose_uncertainty", "strips")[7][0])[:, :2]
    reach = np.abs(ellipse - run.trajectory.pose[7, :2]).max(axis=0)
    assert reach == pytest.approx([0.4, 0.2], rel=1e-3)
    spread = recorded.values("/plots/pose/spread_m", "scalars")
    assert spread[0][0] == pytest.approx(np.sqrt(0.05))


def test_levels_are_told_over_time_and_not_across_gaps(recorded, run):
    levels = np.array(recorded.values("/plots/level/loudest_bearing", "scalars"))[:, 0]
    expected = 10 * np.log10(run.scans.power.max(axis=1))
    np.testing.assert_allclose(levels[~np.isnan(levels)], expected, rtol=1e-5)
    assert np.flatnonzero(np.isnan(levels)).tolist() == [
        90
    ]  # after scan 89 two seconds are missing


def test_the_file_is_whole_and_small(tmp_path, run):
    file = tmp_path / "run.rrd"
    with run_recording(run, file):
        pass
    rerun = Path(sys.executable).parent / "rerun"
    assert subprocess.run([rerun, "rrd", "verify", file], capture_output=True).returncode == 0
    assert file.stat().st_size * 60.0 / run.duration_s < 40e6


def test_a_failure_while_recording_is_not_hidden_and_the_file_is_closed(tmp_path, run):
    file = tmp_path / "run.rrd"
    with pytest.raises(RuntimeError, match="stop"), run_recording(run, file):
        raise RuntimeError("stop")
    assert "/summary" in Recorded(file).batches


def test_a_run_that_heard_nothing_has_a_recording(tmp_path):
    with run_recording(unlucky_run(), tmp_path / "run.rrd"):
        pass
    recorded = Recorded(tmp_path / "run.rrd")
    assert "/world/result/sources" not in recorded.batches
    assert not recorded.picture("/world/result/power")[..., 3].any()
    assert "No source was found." in recorded.values("/summary", "text")[0][0]


def test_a_difference_has_a_recording(tmp_path):
    difference = StoredDifference(made_ratio(), walled_room(), "run1 against run3")
    write_difference_recording(difference, tmp_path / "diff.rrd")
    recorded = Recorded(tmp_path / "diff.rrd")
    points = np.array(recorded.values("/world/result/sources", "positions")[0])
    assert points[:2, :2] == pytest.approx(np.array([[3.125, 0.275], [5.725, 3.375]]))
    labels = recorded.values("/world/result/source_labels", "labels")[0]
    assert labels[:3] == [
        "S1  appeared  ≥ +26.0 dB",
        "S2  louder  +19.9 ± 0.4 dB",
        "S3  gone  ≤ -14.0 dB",
    ]
    picture = recorded.picture("/world/result/power_ratio")[::-1]
    ratio = made_ratio()
    np.testing.assert_array_equal(picture[..., 3] > 0, np.isfinite(ratio.ratio_db))
    loud, quiet = np.nanargmax(ratio.ratio_db), np.nanargmin(ratio.ratio_db)
    red, blue = picture.reshape(-1, 4)[loud], picture.reshape(-1, 4)[quiet]
    assert red[0] > red[2]
    assert blue[2] > blue[0]


def test_what_a_fit_tells_is_drawn(tmp_path):
    with run_recording(fitted_run(), tmp_path / "run.rrd"):
        pass
    recorded = Recorded(tmp_path / "run.rrd")
    labels = recorded.values("/world/result/source_labels", "labels")[0]
    assert labels == ["S1  -64.0 ± 0.3 dB", "S2  -70.0 dB (not seen by laser, unsteady)"]
    ellipse = np.array(recorded.values("/world/result/source_ellipses", "strips")[0][1])
    reach = np.abs(ellipse[:, :2] - ellipse[:-1, :2].mean(axis=0)).max(axis=0)
    assert reach == pytest.approx(np.sqrt(5.991) * np.array([0.12, 0.05]), rel=0.02)
    images = np.array(recorded.values("/world/result/mirror_images", "positions")[0])
    assert images[:, :2] == pytest.approx(np.array([[3.1, -0.4], [9.0, 9.0]]))
    owners = recorded.values("/world/result/mirror_images", "labels")[0]
    assert owners == ["mirror image of S1", "mirror image"]


def test_the_summary_tells_sources_and_losses(run):
    text = run_markdown(run)
    assert "| S2 | 5.73 | 3.38 | -70.0 | 17 |\n" in text
    assert "| 17 | not seen by laser, unsteady |" in run_markdown(fitted_run())
    assert "1294 x odometry pose is not finite" in text
    assert "level [dB re (full scale)²]" in text
    assert "Nothing." in run_markdown(unlucky_run())


def test_the_summary_of_a_difference_tells_what_changed():
    difference = StoredDifference(made_ratio(), None, "a against b")
    text = difference_markdown(difference)
    assert "| S1 | appeared | 3.12 | 0.28 | ≥ +26.0 | < 1e-06 |" in text
    assert "| S4 | unchanged | 3.00 | 4.20 | +0.7 ± 0.5 | 0.8 |" in text
    nothing = replace(difference, ratio=replace(difference.ratio, changes=()))
    assert "Nothing differs." in difference_markdown(nothing)
