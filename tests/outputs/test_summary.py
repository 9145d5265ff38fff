import io
import math
from dataclasses import replace

import pytest
from handmade import calibrated_run, fitted_run, made_ratio, made_run, unlucky_run
from rich.console import Console

from soundmap.config import DiffConfig
from soundmap.losses import Loss
from soundmap.outputs.report import diff_report, run_report
from soundmap.outputs.summary import diff_view, log_view, run_view
from soundmap.sensors import ArrayOffsets, Offset, OffsetVerdict
from soundmap.sound import LevelReference, Source, SourceList


def printed(view, *, width: int = 80) -> str:
    stream = io.StringIO()
    Console(file=stream, width=width, highlight=False).print(view)
    return stream.getvalue()


def run_text(run) -> str:
    return printed(run_view({**run_report(run, run.timings_s), "folder": "out/run1"}))


def test_the_summary_of_a_run_names_everything_a_person_asks_for():
    text = run_text(made_run())
    assert "20.0 s of log in 2.0 s, 10 x real time" in text
    assert "dB re (full scale)^2" in text
    rows = [line.split() for line in text.splitlines() if line.strip().startswith("S")]
    assert ["S1", "3.125", "0.275", "-64.0", "22"] in rows
    assert "400 poses, 90.0 % usable" in text
    assert "localize 1.25 s" in text
    assert "out/run1/, to begin with report.html" in text
    assert all(word in " ".join(text.split()) for word in ("1294", "/odom", "lost", "note"))


def test_the_summary_tells_errors_and_remarks_where_a_fit_knows_them():
    text = run_text(fitted_run())
    rows = [line.split() for line in text.splitlines() if line.strip().startswith("S")]
    assert ["S1", "3.125", "0.275", "5", "x", "5", "-64.0", "±", "0.3", "22"] in rows
    assert rows[1][:8] == ["S2", "5.725", "3.375", "29", "x", "12", "-70.0", "17"]
    assert "not seen by laser" in " ".join(text.split())
    assert max(len(line) for line in text.splitlines()) <= 80


def test_the_summary_tells_how_far_the_array_was_off():
    text = " ".join(run_text(calibrated_run()).split())
    assert "Array clock +50 ± 4 ms, corrected; yaw -0.3 ± 0.4 degrees, taken as right" in text
    assert "Array" not in run_text(made_run())


def test_the_summary_says_why_it_cannot_tell_how_far_the_array_was_off():
    unknown = Offset(math.nan, math.nan, OffsetVerdict.UNKNOWN)
    run = replace(made_run(), offsets=ArrayOffsets(unknown, unknown, 0.0, 0, "nothing was heard"))
    text = " ".join(run_text(run).split())
    assert "Array clock and yaw cannot be told: nothing was heard" in text


def test_the_summary_fits_eighty_columns():
    assert max(len(line) for line in run_text(made_run()).splitlines()) <= 80


def test_a_run_without_sources_and_losses_says_so():
    text = run_text(unlucky_run())
    assert "no sources found" in text
    assert "Nothing was lost." in text


def test_many_sources_are_counted_and_not_all_listed():
    many = tuple(Source(1.0, 2.0, 1e-6, 3) for _ in range(25))
    text = run_text(replace(made_run(), sources=SourceList(many, LevelReference.FULL_SCALE)))
    assert "S10" in text
    assert "S11" not in text
    assert "and 15 more in sources.csv" in text


def test_brackets_in_what_a_log_says_are_not_taken_for_markup():
    loss = Loss("odd [red]stamp[/red]", "/scan[0]", 1, "left [bold]out", True)
    text = run_text(replace(made_run(), losses=(loss,)))
    assert "/scan[0]" in text
    assert "[/red]" in text


@pytest.mark.parametrize("changes", [True, False])
def test_the_summary_of_a_difference_lists_what_changed(changes):
    ratio = made_ratio() if changes else replace(made_ratio(), changes=())
    report = diff_report(
        ratio,
        run=made_run().log.parent / "run1",
        background=made_run().log.parent / "run3",
        config=DiffConfig(),
        timings_s={"compare": 0.1},
    )
    text = printed(diff_view({**report, "folder": "run1-run3"}))
    assert "run1 against run3" in text
    assert ("≥ +26.0" in text) == changes
    assert ("nothing differs" in text) == (not changes)
    assert all(len(line) <= 80 for line in text.splitlines())


def log_summary() -> dict:
    return {
        "path": "run1.mcap",
        "size_bytes": 12_300_000,
        "duration_s": 26.7,
        "topics": [
            {
                "name": "/audio/raw",
                "schema": "audio_utils_msgs/msg/AudioFrame",
                "encoding": "cdr",
                "messages": 667,
                "rate_hz": 25.0,
                "gaps": 2,
                "jitter_s": 0.00034,
                "kind": "audio",
                "used": True,
            },
            {
                "name": "/rosout",
                "schema": "rcl_interfaces/msg/Log",
                "encoding": "cdr",
                "messages": 3,
                "rate_hz": None,
                "gaps": 0,
                "jitter_s": 0.0,
                "kind": None,
                "used": False,
            },
        ],
        "audio": {
            "topic": "/audio/raw",
            "channels": 16,
            "drift_ppm": -31.25,
            "stamp": "end",
            "level_db": [-31.04, None, -28.0],
            "unsound_channels": [1],
        },
        "lasers": [{"topic": "/scan[front]", "beams": 1081, "upside_down": True}],
        "odometry": None,
        "base_frame": "base_link",
        "mounts": {"laser": [0.2, -0.1, 0.3, 1.5707963]},
        "losses": [],
        "problems": ["no odometry: give [topics] odometry"],
        "ready_for": {"map": True, "localize": True, "process": False},
    }


def test_the_view_of_a_log_shows_topics_sensors_and_problems():
    text = printed(log_view(log_summary()))
    lines = [line.split() for line in text.splitlines()]
    assert "run1.mcap: 26.7 s, 12.3 MB, ready for map, localize" in text
    assert "levels -31.0 to -28.0 dB" in text
    assert "left out: 1" in " ".join(text.split())
    assert any(
        line[:5] == ["/audio/raw", "667", "25.0", "0.34", "2"] and line[-1] == "audio"
        for line in lines
    )
    assert any(line[:3] == ["/rosout", "3", "-"] and line[-1] == "-" for line in lines)
    assert "channels 16, drift ppm -31.25" in text
    assert "/scan[front]" in text
    assert "upside down yes" in text
    assert "x 0.200, y -0.100, z 0.300 m, yaw 90.0 degrees" in text
    assert "- no odometry: give [topics] odometry" in text
