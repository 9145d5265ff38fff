import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from handmade import (
    NO_PICTURES,
    fitted_run,
    limited_run,
    made_ratio,
    made_run,
    unlucky_run,
    walled_room,
)

from soundmap.config import DiffConfig
from soundmap.errors import LogError
from soundmap.geometry import Mount
from soundmap.outputs.run_folder import write_diff, write_run
from soundmap.outputs.stored_run import read_difference, read_report, read_run
from soundmap.run import Run


def written(run: Run, folder: Path) -> Path:
    write_run(run, folder, NO_PICTURES)
    return folder


def same(first: object, second: object) -> bool:
    """Equality of dataclasses that hold arrays."""
    if isinstance(first, np.ndarray):
        return np.array_equal(first, second)
    if hasattr(first, "__dataclass_fields__"):
        return all(same(getattr(first, f.name), getattr(second, f.name)) for f in fields(first))
    return first == second


def test_limits_read_back_as_limits(tmp_path):
    run = limited_run()
    assert same(read_run(written(run, tmp_path)).power_map, run.power_map)


def test_a_run_reads_back_as_it_was(tmp_path):
    run = made_run()
    mount = Mount.from_quaternion([0.1, -0.2, 0.6], [0.1, 0.2, 0.3, 0.9])
    known = {}
    if hasattr(run.trajectory, "covariance"):
        shape = (len(run.trajectory), 3, 3)
        known["covariance"] = np.random.default_rng(1).normal(size=shape)
    run = replace(
        run,
        scans=replace(run.scans, mount=mount),
        trajectory=replace(run.trajectory, **known),
    )
    read = read_run(written(run, tmp_path))
    for name in ("trajectory", "scans", "power_map", "room", "losses", "config", "counts"):
        assert same(getattr(read, name), getattr(run, name)), name
    assert read.log == Path.cwd() / "logs" / "run1.mcap"
    assert read.fingerprint == "0123abcd"
    assert [source.visits for source in read.sources] == [22, 17]
    assert [source.power for source in read.sources] == pytest.approx([4e-7, 1e-7], rel=2e-4)


def test_a_run_that_heard_nothing_reads_back_too(tmp_path):
    read = read_run(written(unlucky_run(), tmp_path))
    assert len(read.sources) == 0
    assert len(read.scans) == 0
    assert read.scans.mount is None


def test_a_difference_reads_back_as_it_was(tmp_path):
    ratio = made_ratio()
    write_diff(
        ratio,
        tmp_path,
        NO_PICTURES,
        room=walled_room(),
        run=Path("run1"),
        background=Path("run3"),
        config=DiffConfig(),
        timings_s={},
    )
    read = read_difference(tmp_path)
    np.testing.assert_array_equal(read.ratio.ratio_db, ratio.ratio_db)
    np.testing.assert_array_equal(read.ratio.background_measured, ratio.background_measured)
    assert read.ratio.frame == ratio.frame
    rounded = [replace(change, ratio_db=round(change.ratio_db, 3)) for change in ratio.changes]
    assert list(read.ratio.changes) == rounded
    assert len(read.ratio.louder) == 2
    assert same(read.room, walled_room())
    assert read.title == "run1 against run3"


def test_a_difference_of_an_earlier_soundmap_still_reads(tmp_path):
    write_diff(
        replace(made_ratio(), changes=made_ratio().changes[:2]),
        tmp_path,
        NO_PICTURES,
        room=None,
        run=Path("run1"),
        background=Path("run3"),
        config=DiffConfig(),
        timings_s={},
    )
    report = json.loads((tmp_path / "report.json").read_text())
    del report["changes"]
    for row in report["sources"]:
        for name in set(row) - {"id", "x_m", "y_m", "ratio_db", "visits"}:
            del row[name]
    (tmp_path / "report.json").write_text(json.dumps(report))
    changes = read_difference(tmp_path).ratio.changes
    assert [change.ratio_db for change in changes] == [26.02, 19.9]
    assert {change.false_alarm_probability for change in changes} == {None}


def test_settings_that_are_no_longer_known_do_not_keep_a_run_from_being_read(tmp_path):
    write_run(made_run(), tmp_path, NO_PICTURES)
    file = tmp_path / "config.toml"
    text = file.read_text()
    file.write_text(text.replace("[scan]", "[once]\nkey = 1\n\n[scan]\nformer = true"))
    assert read_run(tmp_path).config == made_run().config


def test_what_a_fit_found_reads_back_as_it_was(tmp_path):
    run = fitted_run()
    write_run(run, tmp_path, NO_PICTURES)
    read = read_run(tmp_path).sources
    for found, made in zip(read, run.sources, strict=True):
        assert found.fit.flags == made.fit.flags
        assert found.fit.level_sigma_db == made.fit.level_sigma_db
        np.testing.assert_allclose(found.fit.covariance_m2, made.fit.covariance_m2)
        assert found.fit.power_1m == pytest.approx(made.fit.power_1m, rel=1e-3)
        assert found.fit.false_alarm_probability == made.fit.false_alarm_probability
    assert [image.source for image in read.reflections] == [0, None]


def test_what_is_no_run_folder_is_said_to_be_none(tmp_path):
    with pytest.raises(LogError, match=r"no run folder: it holds no power_map\.npz"):
        read_run(tmp_path)
    with pytest.raises(LogError, match=r"no run folder: it holds no report\.json"):
        read_difference(tmp_path)


@pytest.mark.parametrize("content", [b"{", b"[1]", b"\xff\xfe"])
def test_a_damaged_report_is_named(tmp_path, content):
    (tmp_path / "report.json").write_bytes(content)
    with pytest.raises(LogError, match=r"report\.json: cannot be read"):
        read_report(tmp_path)


@pytest.mark.parametrize("missing", ["log_path", "sources", "level_reference", "losses"])
def test_a_report_that_lacks_something_is_named(tmp_path, missing):
    folder = written(made_run(), tmp_path)
    report = json.loads((folder / "report.json").read_text())
    del report[missing]
    (folder / "report.json").write_text(json.dumps(report))
    with pytest.raises(LogError, match=rf"report\.json: cannot be read.*{missing}"):
        read_run(folder)


@pytest.mark.parametrize("name", ["trajectory.npz", "audio_scans.npz"])
def test_a_damaged_archive_is_named(tmp_path, name):
    folder = written(made_run(), tmp_path)
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[: len(content) // 2])
    with pytest.raises(LogError, match=f"{name}: cannot be read as part of a run"):
        read_run(folder)
