"""What an earlier run has kept gives the same results to the bit, or is not used."""

import json
import os
import time
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
import small_logs
import worlds
from typer.testing import CliRunner

from soundmap import measured, replay
from soundmap.cli import app
from soundmap.config import loaded_config
from soundmap.map_file import map_files
from soundmap.measured import MeasuredCache, cache_folder, measured_key
from soundmap.outputs.progress import chosen_progress

SETTINGS = small_logs.ARRAY + '[detect]\nmethod = "maxima"\n'


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    small_logs.write(folder / "run.mcap")
    for name, content in map_files(worlds.room()).items():
        (folder / name).write_bytes(content)
    (folder / "robot.toml").write_text(SETTINGS)
    return folder


@pytest.fixture(scope="module")
def fresh(site):
    return run_of(site)


@pytest.fixture
def cache(tmp_path):
    return MeasuredCache(tmp_path / "cache")


def run_of(site, cache=None, settings="robot.toml", **options):
    options = {"start_pose": small_logs.START} | options
    config = loaded_config([site / "robot.toml", site / settings])
    progress = chosen_progress(quiet=True)
    map_path = site / "map.yaml"
    return replay.process(
        site / "run.mcap", map_path, config, cache=cache, progress=progress, **options
    )


def same(a, b):
    """Whether two values agree to the bit, through dataclasses."""
    if is_dataclass(a):
        return type(a) is type(b) and all(
            same(getattr(a, field.name), getattr(b, field.name))
            for field in fields(a)
            if field.name not in ("timings_s", "from_cache")
        )
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    return a == b and type(a) is type(b)


@pytest.fixture
def no_reading(monkeypatch):
    def refuse(*_, **__):
        pytest.fail("the log was read again")

    return lambda: monkeypatch.setattr(replay, "open_log", refuse)


def test_a_kept_run_equals_a_fresh_one_to_the_bit_and_says_that_it_was_kept(
    site, fresh, cache, no_reading
):
    first = run_of(site, cache)
    no_reading()
    second = run_of(site, cache)
    assert (fresh.from_cache, first.from_cache, second.from_cache) == (False, False, True)
    assert same(first, fresh)
    assert same(second, fresh)
    assert "scan" not in second.timings_s


def test_fusion_and_detection_may_change_and_nothing_is_read_again(site, cache, no_reading):
    run_of(site, cache)
    (site / "other.toml").write_text("[detect]\nmin_visit_share = 0.5\n[fuse]\nd_max_m = 2.0\n")
    changed = run_of(site, settings="other.toml")
    no_reading()
    assert same(run_of(site, cache, "other.toml"), changed)


def test_a_run_that_stopped_after_the_scans_is_taken_up_there(site, cache, no_reading, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(replay, "detect_sources", stop)
        with pytest.raises(KeyboardInterrupt):
            run_of(site, cache)
    no_reading()
    assert run_of(site, cache).from_cache


@pytest.mark.parametrize(
    "settings",
    [
        "[scan]\nbearings = 60\n",
        "[localize]\nseed = 5\n",
        "[array]\npascal_per_count = 0.1\n",
        "[audio]\nstamp = 'start'\n",
        "[calibrate]\nmode = 'off'\n",
    ],
)
def test_other_settings_of_the_slow_stages_have_results_of_their_own(site, settings):
    (site / "changed.toml").write_text(settings)
    config = loaded_config([site / "robot.toml"])
    other = loaded_config([site / "robot.toml", site / "changed.toml"])
    files = [site / "run.mcap"]
    assert measured_key(files, "f", other, None, None) != measured_key(
        files, "f", config, None, None
    )


def test_another_log_map_start_or_program_has_results_of_its_own(site, monkeypatch):
    config, files = loaded_config([site / "robot.toml"]), [site / "run.mcap"]
    room = worlds.room()
    moved = replace(room, occupied=np.roll(room.occupied, 1, axis=0))
    keys = [
        measured_key(files, "f", config, None, None),
        measured_key(files, "g", config, None, None),
        measured_key(files, "f", config, room, None),
        measured_key(files, "f", config, moved, None),
        measured_key(files, "f", config, room, (1.0, 1.0, 0.0)),
    ]
    os.utime(files[0], ns=(1, 1))
    keys.append(measured_key(files, "f", config, None, None))
    monkeypatch.setattr(measured, "_program", lambda: "changed")
    keys.append(measured_key(files, "f", config, None, None))
    assert len(set(keys)) == len(keys)


def test_a_damaged_cache_is_never_used(site, cache, fresh):
    run_of(site, cache)
    (file,) = cache.folder.iterdir()
    key, content = file.stem, file.read_bytes()
    kept = cache.get(key)
    rng = np.random.default_rng(3)
    for place in rng.integers(0, len(content), 40):
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        file.write_bytes(damaged)
        found = cache.get(key)
        assert found is None or same(found, kept)
    for share in (0.0, 0.3, 0.999):
        file.write_bytes(content[: int(share * len(content))])
        assert cache.get(key) is None
    file.with_stem("another").write_bytes(content)
    assert cache.get("another") is None
    run = run_of(site, cache)
    assert not run.from_cache
    assert same(run, fresh)


def test_the_cache_does_not_grow_beyond_its_bound(site, cache, monkeypatch):
    run_of(site, cache)
    (file,) = cache.folder.iterdir()
    kept = cache.get(file.stem)
    monkeypatch.setattr(measured, "MAX_CACHE_BYTES", int(2.5 * file.stat().st_size))
    os.utime(file, ns=(1, 1))
    cache.put("second", kept)
    os.utime(cache.folder / "second.npz", ns=(2, 2))
    cache.get(file.stem)
    cache.put("third", kept)
    assert {path.stem for path in cache.folder.iterdir()} == {file.stem, "third"}


def test_what_killed_runs_left_in_the_cache_is_removed_in_time(site, cache):
    run_of(site, cache)
    for name, age_s in {".old.1": 7200, ".new.2": 60}.items():
        (cache.folder / name).touch()
        then = time.time() - age_s
        os.utime(cache.folder / name, (then, then))
    (file,) = cache.folder.glob("*.npz")
    kept = cache.get(file.stem)
    cache.put("other", kept)
    assert {path.name for path in cache.folder.glob(".*")} == {".new.2"}


def test_a_cache_that_cannot_be_written_costs_nothing_but_time(site, tmp_path, fresh):
    (tmp_path / "file").touch()
    assert same(run_of(site, MeasuredCache(tmp_path / "file" / "cache")), fresh)


def test_the_cache_lies_where_the_user_wants_it(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "soundmap"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache_folder() == tmp_path / "home" / ".cache" / "soundmap"


def test_the_command_keeps_uses_and_ignores_what_was_kept(site, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    settings = ["--map", site / "map.yaml", "--config", site / "robot.toml", "--figures", "none"]
    settings += ["--start-pose", "1,1,0", "--out", tmp_path / "out", "--force", "--json"]

    def reported(*more):
        arguments = ["process", site / "run.mcap", *settings, *more]
        result = CliRunner().invoke(app, [str(argument) for argument in arguments])
        assert result.exit_code == 0, result.output
        return json.loads(result.stdout)

    assert reported("--no-cache")["from_cache"] is False
    assert not (tmp_path / "soundmap").exists()
    first, second, third = reported(), reported(), reported("--no-cache")
    assert [r["from_cache"] for r in (first, second, third)] == [False, True, False]
    assert first["sources"] == second["sources"] == third["sources"]
    assert second["speed"] is None
