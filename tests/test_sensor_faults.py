"""Sensors that fail on the way: each fault is named with its count and time, the rest is used.

Every fault is put into a short simulated drive; the source that the whole log shows must be found
again, at most 0.1 m from there.
"""

import copy
import dataclasses
import itertools
import json

import numpy as np
import pytest
import small_logs
import worlds
from logwriter import SECOND, audio_frame, time_of
from small_logs import MICROPHONES, RATE, START_NS, changed
from typer.testing import CliRunner

from soundmap.cli import app
from soundmap.config import loaded_config
from soundmap.logs.robot_log import open_log
from soundmap.logs.summary import log_summary
from soundmap.map_file import map_files
from soundmap.outputs.progress import chosen_progress
from soundmap.replay import process

MIDDLE_S = 3.0


@pytest.fixture(scope="module")
def drive():
    return small_logs.events()


@pytest.fixture(scope="module")
def site(tmp_path_factory, drive):
    """A folder with the map, and where the whole log shows the source."""
    folder = tmp_path_factory.mktemp("site")
    for name, content in map_files(worlds.room()).items():
        (folder / name).write_bytes(content)
    (folder / "robot.toml").write_text(small_logs.ARRAY + '[detect]\nmethod = "maxima"\n')
    run = run_of(folder, drive)
    assert run.losses == ()
    place = loudest(run)
    assert np.hypot(*(place - small_logs.SOURCE_M)) < 0.1
    return folder, place


def run_of(folder, events):
    small_logs.write(folder / "run.mcap", events)
    settings = loaded_config([folder / "robot.toml"])
    progress = chosen_progress(quiet=True)
    start = small_logs.START
    return process(
        folder / "run.mcap", folder / "map.yaml", settings, start_pose=start, progress=progress
    )


def loudest(run):
    source = max(run.sources, key=lambda source: source.power)
    return np.array([source.x_m, source.y_m])


def reported(site, events):
    """Losses by name, after a look at whether the source is still found."""
    folder, place = site
    run = run_of(folder, copy.deepcopy(events))
    assert np.hypot(*(loudest(run) - place)) < 0.1
    summary = log_summary(folder / "run.mcap", loaded_config([folder / "robot.toml"]))
    told = {(loss.what, loss.count, loss.first_s) for loss in summary.losses}
    found = {loss.what: loss for loss in run.losses}
    logs = [loss for loss in run.losses if loss.where.startswith("/")]
    assert {(loss.what, loss.count, loss.first_s) for loss in logs} <= told
    return found


def seconds(event):
    return (event.time_ns - START_NS) / SECOND


def during(first_s, last_s, change):
    """The change, for events of that time alone; others stay."""
    return lambda i, event: change(event) if first_s < seconds(event) <= last_s else event


def with_values(event, **values):
    return event._replace(values=event.values | values)


def stamped(event, stamp_ns):
    header = event.values["header"] | {"stamp": time_of(stamp_ns)}
    return with_values(event, header=header)


def stamp_of(event):
    stamp = event.values["header"]["stamp"]
    return stamp["sec"] * SECOND + stamp["nanosec"]


def samples_of(event):
    return np.frombuffer(event.values["data"], dtype="<i2").reshape(-1, MICROPHONES)


def with_samples(event, samples):
    return with_values(event, data=np.ascontiguousarray(samples, dtype="<i2").tobytes())


def assert_reported(losses, what, count, first_s, last_s=None):
    """This loss and no other that matters, at this time to within one message."""
    lost = [loss for loss in losses.values() if loss.data_lost and loss.where.startswith("/")]
    assert [loss.what for loss in lost] == [what]
    assert lost[0].count == count
    assert lost[0].first_s == pytest.approx(first_s, abs=0.06)
    assert lost[0].last_s == pytest.approx(first_s if last_s is None else last_s, abs=0.06)
    return lost[0]


# Audio


def test_a_gap_in_the_audio(site, drive):
    events = changed(drive, "/mics", during(MIDDLE_S, 3.4, lambda event: None))
    loss = assert_reported(reported(site, events), "gap in the audio", 1, 3.4)
    assert loss.effect.startswith("0.40 s")


def test_audio_blocks_that_are_repeated(site, drive):
    twice = [event for event in drive if event.topic == "/mics" and 3.0 < seconds(event) <= 3.2]
    events = sorted([*drive, *twice], key=lambda event: event.time_ns)
    what = "audio block repeats or overlaps the one before"
    assert_reported(reported(site, events), what, 10, 3.02, 3.2)


def test_audio_blocks_that_overlap(site, drive):
    """Each block of a stretch begins with what the one before ended with."""
    frames, by_topic = 80, [event for event in drive if event.topic == "/mics"]
    before = {b.time_ns: samples_of(a)[-frames:] for a, b in itertools.pairwise(by_topic)}

    def longer(event):
        samples = np.concatenate([before[event.time_ns], samples_of(event)])
        return with_values(event, **audio_frame(stamp_of(event), samples, RATE))

    events = changed(drive, "/mics", during(3.0, 3.2, longer))
    what = "audio block begins before the end of the one before"
    assert_reported(reported(site, events), what, 10, 3.02, 3.2)


@pytest.mark.parametrize(("topic", "sensor"), [("/scan", "laser"), ("/odom", "odometry")])
def test_stamps_that_run_backwards(site, drive, topic, sensor):
    back = SECOND // 2
    events = changed(drive, topic, during(3.0, 3.1, lambda e: stamped(e, stamp_of(e) - back)))
    count = sum(event.topic == topic and 3.0 < seconds(event) <= 3.1 for event in drive)
    what = f"{sensor} stamp runs backward or repeats"
    assert_reported(reported(site, events), what, count, 3.02 if topic == "/odom" else 3.05, 3.1)


@pytest.mark.parametrize("topic", ["/mics", "/scan", "/odom"])
@pytest.mark.parametrize("step_s", [-0.5, 0.4, 3600.0])
def test_a_clock_that_is_set_on_the_way(site, drive, topic, step_s):
    step_ns = int(step_s * SECOND)
    events = changed(drive, topic, during(3.0, 9.0, lambda e: stamped(e, stamp_of(e) + step_ns)))
    loss = assert_reported(reported(site, events), "clock of the stamps was set", 1, 3.02)
    assert loss.where == topic


def test_audio_stamps_that_go_back_for_a_moment(site, drive):
    back = SECOND // 2
    events = changed(drive, "/mics", during(3.0, 3.06, lambda e: stamped(e, stamp_of(e) - back)))
    assert reported(site, events) == {}  # a stamp that is off for a moment is no clock


def test_a_sample_rate_other_than_the_one_declared(site, drive):
    events = changed(drive, "/mics", lambda i, e: with_values(e, sampling_frequency=15000))
    losses = reported(site, events)
    assert list(losses) == ["the sample rate by the stamps is 16000 Hz, not the recorder's"]
    log = open_log(site[0] / "run.mcap", loaded_config([site[0] / "robot.toml"]))
    assert log.sample_rate_hz == pytest.approx(RATE, rel=1e-3)


def test_a_count_of_channels_that_changes_on_the_way(site, drive):
    def fewer(event):
        return with_values(event, **audio_frame(stamp_of(event), samples_of(event)[:, :4], RATE))

    events = changed(drive, "/mics", during(5.0, 9.0, fewer))
    losses = reported(site, events)
    lost = losses["audio block in another format than most"]
    assert lost.count == pytest.approx((seconds(drive[-1]) - 5.0) / 0.02, abs=2)
    assert lost.first_s == pytest.approx(5.0, abs=0.03)
    assert losses["ends before the other sensors do"].where == "/mics"


def test_a_microphone_that_dies_on_the_way(site, drive):
    def dies(event):
        samples = samples_of(event).copy()
        samples[:, 4] = 7
        return with_samples(event, samples)

    events = changed(drive, "/mics", during(3.0, 9.0, dies))
    loss = assert_reported(
        reported(site, events), "microphone is dead", 1, 3.02, seconds(drive[-1])
    )
    assert loss.effect.startswith("channel 4 ")


def test_a_microphone_the_wrong_way_round(site, drive):
    sign = np.array([1, -1, 1, 1, 1, 1])
    events = changed(drive, "/mics", lambda i, e: with_samples(e, samples_of(e) * sign))
    losses = reported(site, events)
    assert losses["microphone is connected the wrong way round"].count == 1
    assert "channel 1 " in losses["microphone is connected the wrong way round"].effect


def test_a_microphone_whose_cable_is_loose(site, drive):
    rng = np.random.default_rng(2)

    def loose(i, event):
        samples = samples_of(event).copy()
        samples[:, 0] = 700 * rng.standard_normal(len(samples))
        return with_samples(event, samples)

    losses = reported(site, changed(drive, "/mics", loose))
    loss = losses["microphone hears something else than its neighbours"]
    assert loss.effect.startswith("channel 0 ")


def test_a_microphone_that_clips(site, drive):
    def clips(event):
        samples = samples_of(event).copy()
        samples[:, 2] = np.clip(samples[:, 2], -400, 400)
        return with_samples(event, samples)

    events = changed(drive, "/mics", lambda i, event: clips(event))
    losses = reported(site, events)
    assert losses["microphone clips"].count == 1
    assert losses["microphone clips"].effect.startswith("channel 2 ")


def test_float_audio_with_samples_that_are_no_numbers(site, drive):
    def as_float(i, event):
        samples = (samples_of(event) / 2**15).astype("<f4")
        if 3.0 < seconds(event) <= 3.1:
            samples[10:20, 3] = np.nan
            samples[5, 1] = np.inf
        return with_values(event, format="float", data=samples.tobytes())

    losses = reported(site, changed(drive, "/mics", as_float))
    assert_reported(losses, "audio sample is not a number", 5 * 11, 3.02, 3.1)


def test_without_any_sound_there_is_nothing_to_use(site, drive):
    from soundmap.errors import NothingUsableError

    events = changed(drive, "/mics", lambda i, e: with_samples(e, 0 * samples_of(e)))
    with pytest.raises(NothingUsableError, match="nothing but silence"):
        run_of(site[0], events)


# Lasers


def test_laser_scans_without_a_return(site, drive):
    def blind(event):
        return with_values(event, ranges=np.full(361, np.inf))

    events = changed(drive, "/scan", during(3.0, 3.4, blind))
    assert_reported(reported(site, events), "laser scan without a single return", 8, 3.02, 3.4)


@pytest.mark.parametrize("beams", [200, 500])
def test_laser_scans_with_too_few_or_too_many_ranges(site, drive, beams):
    def other(event):
        return with_values(event, ranges=np.resize(event.values["ranges"], beams))

    events = changed(drive, "/scan", during(3.0, 3.4, other))
    what = "laser scan with more or fewer ranges than its angles tell"
    assert_reported(reported(site, events), what, 8, 3.02, 3.4)


def test_laser_scans_without_an_angle_between_rays(site, drive):
    def still(event):
        return with_values(event, angle_increment=0.0, angle_max=event.values["angle_min"])

    events = changed(drive, "/scan", during(3.0, 3.4, still))
    assert_reported(reported(site, events), "damaged laser message", 8, 3.02, 3.4)


def test_laser_angles_that_are_no_numbers(site, drive):
    events = changed(drive, "/scan", during(3.0, 3.4, lambda e: with_values(e, angle_min=np.nan)))
    assert_reported(reported(site, events), "damaged laser message", 8, 3.02, 3.4)


def test_laser_ranges_that_are_no_numbers_are_no_returns(site, drive):
    def holes(i, event):
        ranges = event.values["ranges"].copy()
        ranges[i % 3 :: 3] = np.nan
        return with_values(event, ranges=ranges)

    assert reported(site, changed(drive, "/scan", holes)) == {}


def test_a_laser_that_ends_early(site, drive):
    events = changed(drive, "/scan", during(5.0, 9.0, lambda event: None))
    loss = assert_reported(reported(site, events), "ends before the other sensors do", 1, 5.0)
    assert loss.where == "/scan"


def test_a_laser_that_is_silent_for_a_while(site, drive):
    events = changed(drive, "/scan", during(2.0, 3.0, lambda event: None))
    loss = assert_reported(reported(site, events), "sensor silent for a while", 1, 2.0)
    assert loss.effect.startswith(("1.0 s", "1.1 s"))


# Odometry


def moved(event, x, y):
    pose = copy.deepcopy(event.values["pose"])
    pose["pose"]["position"]["x"] += x
    pose["pose"]["position"]["y"] += y
    return with_values(event, pose=pose)


def test_odometry_that_jumps(site, drive):
    events = changed(drive, "/odom", during(3.0, 9.0, lambda event: moved(event, 5.0, -2.0)))
    assert_reported(reported(site, events), "odometry jumps", 1, 3.02)


def test_odometry_that_is_off_for_one_message(site, drive):
    events = changed(drive, "/odom", during(3.0, 3.02, lambda event: moved(event, 0.0, 8.0)))
    assert_reported(reported(site, events), "odometry jumps", 2, 3.02, 3.04)


def test_odometry_that_ends_early(site, drive):
    events = changed(drive, "/odom", during(5.0, 9.0, lambda event: None))
    loss = assert_reported(reported(site, events), "ends before the other sensors do", 1, 5.0)
    assert loss.where == "/odom"


def test_odometry_that_sticks(site, drive):
    stuck = {}

    def sticks(event):
        stuck.setdefault("pose", event.values["pose"])
        return with_values(event, pose=stuck["pose"])

    events = changed(drive, "/odom", during(4.0, 5.0, sticks))
    losses = reported(site, events)
    assert losses["odometry jumps"].count == 1


def test_a_fault_is_told_everywhere_and_strict_makes_it_an_exit_code(site, drive):
    folder, _ = site
    events = changed(drive, "/mics", during(MIDDLE_S, 3.4, lambda event: None))
    small_logs.write(folder / "run.mcap", events)
    given = [folder / "run.mcap", "--config", folder / "robot.toml"]
    more = ["--map", folder / "map.yaml", "--start-pose", "1,1,0", "--figures", "none", "--strict"]
    command = ["process", *given, *more, "--out", folder / "out"]
    result = CliRunner().invoke(app, [str(argument) for argument in command])
    assert result.exit_code == 5
    assert "gap in the audio" in result.stderr
    row = next(line for line in result.stdout.splitlines() if "gap in the" in line)
    assert row.split()[:5] == ["lost", "1", "at", "3.4", "s"]
    written = json.loads((folder / "out" / "report.json").read_text())["losses"]
    result = CliRunner().invoke(app, ["info", *map(str, given), "--json"])
    for losses in (written, json.loads(result.stdout)["losses"]):
        told = [(loss["what"], loss["count"], loss["first_s"]) for loss in losses]
        assert told == [("gap in the audio", 1, pytest.approx(3.4, abs=0.06))]


def test_fields_of_a_loss_are_what_the_report_says():
    from soundmap.losses import Loss

    names = [field.name for field in dataclasses.fields(Loss)]
    assert names == ["what", "where", "count", "effect", "data_lost", "first_s", "last_s"]
