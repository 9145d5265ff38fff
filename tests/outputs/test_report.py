import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from handmade import calibrated_run, made_ratio, made_run, unlucky_run
from scipy.special import ellipeinc

from soundmap.config import Config, DiffConfig
from soundmap.outputs.report import (
    SOURCE_COLUMNS,
    csv_text,
    diff_report,
    json_text,
    run_report,
    source_rows,
)
from soundmap.sensors import ArrayOffsets, Offset, OffsetVerdict
from soundmap.sound import LevelReference, Source, SourceList


def strictly_parsed(text: str) -> dict:
    def refuse(token):
        raise AssertionError(f"{token} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_the_rows_name_the_sources_by_loudness_and_say_what_the_level_refers_to():
    first, second = source_rows(made_run().sources)
    # 10 log10(4e-7) = -63.979
    assert first == {
        "id": "S1",
        "x_m": 3.125,
        "y_m": 0.275,
        "power_db": -63.979,
        "visits": 22,
        "power_reference": "dB re (full scale)^2",
    }
    assert (second["id"], second["x_m"], second["power_db"]) == ("S2", 5.7251, -70.0)


def test_the_table_reads_back_with_the_columns_in_their_order():
    text = csv_text(SOURCE_COLUMNS, source_rows(made_run().sources))
    assert text.startswith("id,x_m,y_m,power_db,visits,power_reference,")
    rows = list(csv.DictReader(io.StringIO(text)))
    assert [row["id"] for row in rows] == ["S1", "S2"]
    assert float(rows[0]["power_db"]) == -63.979
    assert rows[1]["visits"] == "17"


def test_without_a_source_the_table_is_its_header_alone():
    text = csv_text(SOURCE_COLUMNS, source_rows(unlucky_run().sources))
    assert text == ",".join(SOURCE_COLUMNS) + "\n"


def test_a_silent_source_has_an_empty_level_in_the_table_and_null_in_the_report():
    silent = SourceList((Source(1.0, 2.0, 0.0, 3),), LevelReference.SOUND_PRESSURE)
    (row,) = source_rows(silent)
    assert row["power_db"] is None
    line = csv_text(SOURCE_COLUMNS, [row]).splitlines()[1]
    assert line.rstrip(",") == "S1,1.0,2.0,,3,dB re (20 uPa)^2"


def test_the_report_is_strict_json_with_the_rows_of_the_table_and_every_loss():
    run = made_run()
    report = strictly_parsed(json_text(run_report(run, {**run.timings_s, "outputs": 0.5})))
    assert report["sources"] == source_rows(run.sources)
    assert report["losses"][0] == {
        "what": "odometry pose is not finite",
        "where": "/odom",
        "count": 1294,
        "effect": "motion taken from the twist",
        "data_lost": True,
        "first_s": None,
        "last_s": None,
    }
    assert report["speed"] == pytest.approx(20.0 / 2.5)
    assert report["trajectory"]["usable_share"] == pytest.approx(0.9)
    # an arc of 324 degrees of the ellipse with semi-axes 1.8 m and 1.35 m
    flat = 1.0 - (1.35 / 1.8) ** 2
    arc = 1.8 * (ellipeinc(1.3 * np.pi, flat) + ellipeinc(0.5 * np.pi, flat))
    assert report["trajectory"]["length_m"] == pytest.approx(arc, rel=1e-3)
    assert report["log"] == "run1.mcap"
    assert report["versions"]["numpy"] == np.__version__
    assert Config.model_validate(report["config"]) == run.config


def test_the_report_tells_how_far_the_array_was_off():
    run = calibrated_run()
    array = strictly_parsed(json_text(run_report(run, run.timings_s)))["array"]
    assert array["clock_offset_s"] == 0.0503
    assert array["clock_verdict"] == "corrected"
    assert array["yaw_offset_deg"] == pytest.approx(-0.3)
    assert array["yaw_verdict"] == "taken as right"
    assert (array["explained_share"], array["fixed_places"], array["why"]) == (0.81, 5, "")
    assert run_report(made_run(), run.timings_s)["array"] is None


def test_offsets_that_nothing_is_known_of_are_null():
    unknown = Offset(np.nan, np.nan, OffsetVerdict.UNKNOWN)
    run = replace(made_run(), offsets=ArrayOffsets(unknown, unknown, 0.0, 0, "nothing was heard"))
    array = strictly_parsed(json_text(run_report(run, run.timings_s)))["array"]
    assert array["clock_offset_s"] is None
    assert array["yaw_sigma_deg"] is None
    assert array["why"] == "nothing was heard"


def test_what_is_not_finite_becomes_null_and_numpy_numbers_become_numbers():
    run = replace(made_run(), duration_s=float("nan"), counts={"scans": np.int64(3)})
    report = strictly_parsed(json_text(run_report(run, {"scan": np.float64("inf")})))
    assert report["duration_s"] is None
    assert report["timings_s"]["scan"] is None
    assert report["counts"] == {"scans": 3}


def test_a_run_without_poses_has_no_usable_share():
    run = made_run()
    none = replace(
        run.trajectory,
        time_ns=run.trajectory.time_ns[:0],
        pose=run.trajectory.pose[:0],
        usable=run.trajectory.usable[:0],
    )
    report = run_report(replace(run, trajectory=none), {})
    assert report["trajectory"] == {"poses": 0, "length_m": 0.0, "usable_share": None}
    assert report["speed"] is None


def test_the_report_of_a_difference_counts_the_cells_without_a_background(tmp_path):
    ratio = made_ratio()
    report = diff_report(
        ratio,
        run=tmp_path / "run1",
        background=tmp_path / "run3",
        config=DiffConfig(),
        timings_s={"compare": 0.1},
    )
    compared = sum(not np.isnan(value) for value in ratio.ratio_db.ravel())
    assert report["counts"]["cells_compared"] == compared
    assert 0 < report["counts"]["cells_without_background"] < compared
    assert (report["run"], report["background"]) == ("run1", "run3")
    assert report["sources"][0]["ratio_db"] == 26.02
