"""Whole logs: written, read back by other libraries, and compared with what they should hold."""

import wave
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from soundmap.config import loaded_config
from soundmap.errors import ConfigError, OutputError
from soundmap.map_file import read_map
from soundmap.simulate.audio_log import recorder
from soundmap.simulate.scene_file import loaded_scene
from soundmap.simulate.simulation import drive_of, simulated_run
from soundmap.simulate.spectra import a_weighting

SCENE = """\
name = "box"
[room]
image_order = {order}
reverberation_s = {reverberation}
floor_reflection = {reflection}
ceiling_reflection = {reflection}
[[walls]]
name = "outer"
corners_m = [[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0]]
reflection = {reflection}
[[sources]]
id = "S1"
position_m = [5.0, 2.0, 0.6]
facing_deg = 180.0
front_to_back_db = 6.0
level_dba_5cm = 78.5
{sound}
[[runs]]
name = "run1"
sources = ["S1"]
[[runs]]
name = "run3"
sources = []
[robot]
way_points_m = {way}
rest_s = {rest}
[array]
mount = [0.0, 0.0, 0.6, 0.0]
microphones = 4
pascal_per_count = 1e-4
self_noise_dba = -50.0
[noise]
ambient_dba = {ambient}
drive_dba = -200.0
{more}
"""
FREE = {"order": 0, "reverberation": 0.0, "reflection": 0.0, "ambient": -200.0, "rest": 1.0}
PLAIN = {"sound": 'sound = "fan"', "way": "[[3.0, 2.0]]", "more": ""}


def scene_file(folder: Path, **changes: object) -> Path:
    path = folder / "scene.toml"
    path.write_text(SCENE.format(**(FREE | PLAIN | changes)))
    return path


def messages(log: Path) -> dict[str, list[tuple[int, object]]]:
    """Arrival and content of every message by topic, decoded by rosbags, CRCs checked."""
    store = get_typestore(Stores.EMPTY)
    found: dict[str, list[tuple[int, object]]] = defaultdict(list)
    with log.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            if schema.name not in store.types:
                store.register(get_types_from_msg(schema.data.decode(), schema.name))
            content = store.deserialize_cdr(message.data, schema.name)
            found[channel.topic].append((message.log_time, content))
    return found


def stamp_ns(message: object) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def pressure_of(path: Path, run: str, samples: int) -> np.ndarray:
    drive, _ = drive_of(loaded_scene(path), run)
    recording = recorder(drive, path.parent, np.random.default_rng(3))
    return recording.samples(0, samples, np.random.default_rng(4)) * 1e-4


def measured_dba(pressure: np.ndarray) -> float:
    window = np.hanning(len(pressure))[:, None]
    spectrum = np.fft.rfft(pressure * window, axis=0)
    weight = a_weighting(np.fft.rfftfreq(len(pressure), 1 / 48000.0))[:, None]
    power = 2 * np.sum((np.abs(spectrum) * weight) ** 2) / pressure.shape[1]
    power /= len(pressure) * np.sum(window**2)
    return float(10 * np.log10(power / 20e-6**2))


def test_a_log_holds_what_the_scene_says(tmp_path: Path) -> None:
    more = "[audio.clock]\njitter_s = 0.0002\ngaps = [{start_s = 0.5, duration_s = 0.1}]"
    way = "[[2.0, 2.0], [3.0, 2.0]]"
    done = simulated_run(scene_file(tmp_path, way=way, more=more), tmp_path / "out", run="run1")
    found = messages(done.log)
    assert {topic: bool(each) for topic, each in found.items()} == dict.fromkeys(
        ["/tf_static", "/odom", "/tf", "/audio", "/scan_front", "/scan_back"], True
    )
    start, seconds = 1_700_000_000 * 10**9, done.duration_s
    mounts = {t.child_frame_id: t for t in found["/tf_static"][0][1].transforms}
    assert set(mounts) == {"laser_front", "laser_back", "mic_array"}
    assert mounts["mic_array"].transform.translation.z == 0.6

    front = [scan for _, scan in found["/scan_front"]]
    assert len(front) == pytest.approx(40 * seconds, abs=2)
    for scan in (front[0], front[-1]):
        bearing = scan.angle_min + scan.angle_increment * np.arange(1081)
        x = 2.18 if scan is front[0] else 3.18
        across = np.where(np.cos(bearing) > 0, (6 - x) / np.cos(bearing), -x / np.cos(bearing))
        true = np.minimum(across, 2.0 / np.abs(np.sin(bearing) + 1e-12))
        error = (scan.ranges - true)[np.isfinite(scan.ranges)]
        assert error.std() == pytest.approx(0.012, abs=0.003)
        assert abs(np.mean(error)) < 0.002

    blocks = found["/audio"]
    assert len(blocks) == pytest.approx((seconds - 0.1) * 100, abs=2)
    late = np.array([log - stamp_ns(block) for log, block in blocks]) * 1e-9
    assert np.median(late) == pytest.approx(0.0023, abs=0.0003)
    steps = np.diff([stamp_ns(block) for _, block in blocks]) * 1e-9
    assert np.sum(steps > 0.1) == 1
    assert np.median(steps) == pytest.approx(0.01, abs=1e-4)
    assert stamp_ns(blocks[0][1]) - start == pytest.approx(10_000_000, abs=1_000_000)

    odometry = [said for _, said in found["/odom"]]
    assert odometry[-1].pose.pose.position.x == pytest.approx(1.0, abs=0.02)


def test_beside_the_log_lie_map_truth_and_robot(tmp_path: Path) -> None:
    done = simulated_run(scene_file(tmp_path, rest=0.2), tmp_path / "out")
    assert done.run == "run1"
    out = tmp_path / "out"
    room = read_map(out / "map.yaml")
    assert room.free.sum() * 0.05**2 == pytest.approx(24.0, rel=0.01)
    assert room.occupied.sum() * 0.05 == pytest.approx(20.0, rel=0.03)
    ids = [line.split(",")[:3] for line in (out / "sources.csv").read_text().split()]
    assert ids == [["id", "x_m", "y_m"], ["S1", "5", "2"]]
    rows = np.loadtxt(out / "trajectory.tum")
    assert rows[0] == pytest.approx([1.7e9, 3.0, 2.0, 0, 0, 0, 0, 1])
    config = loaded_config([out / "robot.toml"])
    assert config.array.microphone_positions()[1] == pytest.approx([0.0, 0.155, 0.0])
    assert config.array.pascal_per_count == 1e-4


def test_a_simulation_is_the_same_every_time_and_each_run_its_own(tmp_path: Path) -> None:
    path = scene_file(tmp_path, rest=0.2, ambient=42.0)
    logs = [
        simulated_run(path, tmp_path / str(k), run=run).log.read_bytes()
        for k, run in enumerate(["run3", "run3", "run1"])
    ]
    assert logs[0] == logs[1]
    assert logs[0] != logs[2]


def test_a_full_folder_and_an_unknown_run_are_refused(tmp_path: Path) -> None:
    path = scene_file(tmp_path)
    with pytest.raises(OutputError, match="--force"):
        simulated_run(path, tmp_path)
    with pytest.raises(ConfigError, match=r"no run .run9.\. Runs: run1, run3"):
        simulated_run(path, tmp_path / "out", run="run9")


def test_the_level_at_the_array_is_that_of_the_source_less_the_distance(tmp_path: Path) -> None:
    pressure = pressure_of(scene_file(tmp_path), "run1", 96 * 1000)[9600:]
    expected = 78.5 - 20 * np.log10(2.0 / 0.05)
    assert measured_dba(pressure) == pytest.approx(expected, abs=0.3)


def test_the_ambient_level_at_the_array_is_that_asked_for(tmp_path: Path) -> None:
    pressure = pressure_of(scene_file(tmp_path, ambient=42.0), "run3", 96 * 2000)
    assert measured_dba(pressure) == pytest.approx(42.0, abs=0.3)


def test_a_click_dies_away_with_the_reverberation_time_of_the_scene(tmp_path: Path) -> None:
    with wave.open(str(tmp_path / "click.wav"), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(48000)
        click = np.zeros(48000 * 6, dtype="<i2")
        click[4800] = 30000
        file.writeframes(click.tobytes())
    path = scene_file(
        tmp_path, sound='wav = "click.wav"', reverberation=0.6, reflection=0.8, order=2
    )
    pressure = pressure_of(path, "run1", 96 * 600)[4800:]
    left = np.cumsum(pressure[::-1] ** 2, axis=0)[::-1].mean(axis=1)
    level = 10 * np.log10(np.maximum(left / left[0], 1e-12))
    fitted = (level < -8.0) & (level > -33.0)
    slope = np.polyfit(np.flatnonzero(fitted) / 48000.0, level[fitted], 1)[0]
    assert -60.0 / slope == pytest.approx(0.6, rel=0.10)


def test_an_intermittent_source_falls_silent_on_time(tmp_path: Path) -> None:
    path = scene_file(tmp_path, sound="on_s = 0.5\noff_s = 0.5")
    pressure = pressure_of(path, "run1", 96 * 800)
    travel = int(2.0 / 343.0 * 48000)
    on = pressure[2000 + travel : 22000 + travel].std()
    off = pressure[26000 + travel : 46000 + travel].std()
    assert off < 1e-3 * on


def test_microphones_hear_a_source_in_the_order_of_their_distance(tmp_path: Path) -> None:
    pressure = pressure_of(scene_file(tmp_path), "run1", 96 * 500)[4800:]
    spectra = np.fft.rfft(pressure, axis=0)
    frequency = np.fft.rfftfreq(len(pressure), 1 / 48000.0)
    band = (frequency > 300) & (frequency < 1500)
    for m, distance in ((1, np.hypot(2.0, 0.155)), (2, 2.155)):
        cross = spectra[band, m] * spectra[band, 0].conj()
        delay = -np.sum(np.unwrap(np.angle(cross)) * frequency[band] * np.abs(cross)) / np.sum(
            2 * np.pi * frequency[band] ** 2 * np.abs(cross)
        )
        assert delay * 48000 == pytest.approx((distance - 1.845) / 343.0 * 48000, abs=0.02)
