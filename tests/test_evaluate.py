import json
import math
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from soundmap.errors import LogError
from soundmap.evaluate import Place, evaluation, evaluation_view, matched, read_places, read_tum

TRUTH = "id,x_m,y_m,level_1m_db\nS1,1.0,2.0,50\nS2,4.0,2.0,49\nS3,4.0,6.0,48\n"
FOUND = """id,x_m,y_m,power_db,visits
S1,1.03,2.04,50.1,20
S2,4.0,2.4,47.0,12
S3,7.0,7.0,40.0,5
"""


def tum(shift_m: float = 0.0, turn: float = 0.0, first: float = 100.0) -> str:
    lines = []
    for k in range(11):
        heading = 0.1 * k + turn
        z, w = math.sin(heading / 2), math.cos(heading / 2)
        time = f"{1_700_000_000 + first + 0.1 * k:.6f}"
        lines.append(f"{time} {0.2 * k + shift_m:.6f} 1 0 0 0 {z:.9f} {w:.9f}")
    return "\n".join(lines) + "\n"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run1"
    folder.mkdir()
    (folder / "sources.csv").write_text(FOUND)
    (folder / "trajectory.tum").write_text(tum(shift_m=0.03, turn=0.02))
    (tmp_path / "truth.csv").write_text(TRUTH)
    (tmp_path / "truth.tum").write_text(tum())
    return folder


def test_the_json_is_the_one_that_others_rely_on(run: Path) -> None:
    result = evaluation(run, run.parent / "truth.csv", run.parent / "truth.tum").as_dict()
    assert json.loads(json.dumps(result)) == {
        "sources": [
            {"id": "S1", "detected": True, "error_m": pytest.approx(0.05)},
            {"id": "S2", "detected": True, "error_m": pytest.approx(0.4)},
            {"id": "S3", "detected": False, "error_m": None},
        ],
        "mean_error_m": pytest.approx(0.225),
        "max_error_m": pytest.approx(0.4),
        "false_alarms": 1,
        "trajectory": {
            "median_m": pytest.approx(0.03),
            "p95_m": pytest.approx(0.03),
            "heading_mean_deg": pytest.approx(math.degrees(0.02), abs=1e-4),
        },
    }


def test_without_a_true_trajectory_none_is_judged(run: Path) -> None:
    assert evaluation(run, run.parent / "truth.csv").as_dict()["trajectory"] is None


def test_a_run_without_sources_is_judged_too(run: Path) -> None:
    (run / "sources.csv").write_text("id,x_m,y_m,power_db,visits\n")
    (run.parent / "truth.csv").write_text("id,x_m,y_m\n")
    result = evaluation(run, run.parent / "truth.csv").as_dict()
    assert result["sources"] == []
    assert (result["mean_error_m"], result["max_error_m"]) == (None, None)
    assert result["false_alarms"] == 0


def test_the_table_reads_as_the_papers(run: Path) -> None:
    console = Console(width=80, force_terminal=False)
    with console.capture() as captured:
        console.print(
            evaluation_view(evaluation(run, run.parent / "truth.csv", run.parent / "truth.tum"))
        )
    words = [line.split() for line in captured.get().splitlines()]
    assert ["Run", "Active", "sources", "Detected", "sources", "Error", "(m)"] in words
    assert ["run1", "S1", "S1", "0.050"] in words
    assert ["S3", "missed"] in words
    assert ["False", "alarms", "1", "(S3)"] in words
    assert ["Trajectory", "median", "0.030", "m,"] in [line[:4] for line in words]


def test_each_row_serves_one_source_and_the_nearer_pair_goes_first() -> None:
    truth = [Place("A", 0.0, 0.0), Place("B", 0.4, 0.0)]
    found = [Place("1", 0.35, 0.0)]
    matches, left_over = matched(truth, found)
    assert [(match.id, match.found) for match in matches] == [("A", None), ("B", "1")]
    assert left_over == ()
    assert matched(truth[::-1], found)[0] == matches[::-1]


def test_half_a_metre_is_still_a_detection_and_more_is_not() -> None:
    truth = [Place("A", 0.0, 0.0)]
    assert matched(truth, [Place("1", 0.5, 0.0)])[0][0].found == "1"
    assert matched(truth, [Place("1", 0.501, 0.0)])[1] == ("1",)


def test_poses_are_compared_at_their_own_times(run: Path) -> None:
    late = tum(first=100.05)  # every pose 50 ms later: 0.1 m further in the truth
    (run / "trajectory.tum").write_text(late)
    way = evaluation(run, run.parent / "truth.csv", run.parent / "truth.tum").trajectory
    assert way is not None
    assert way.poses == 10
    assert way.median_m == pytest.approx(0.1, abs=1e-6)


def test_times_are_read_to_the_nanosecond(tmp_path: Path) -> None:
    (tmp_path / "a.tum").write_text("# comment\n1700000000.123456789 1 2 0 0 0 0 1\n")
    trajectory = read_tum(tmp_path / "a.tum")
    assert trajectory.time_ns.tolist() == [1_700_000_000_123_456_789]
    assert np.array_equal(trajectory.pose, [[1.0, 2.0, 0.0]])


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("name,x,y\n", "lacks the column"),
        ("id,x_m,y_m\nS1,1.0,north\n", "line 2"),
        ("id,x_m,y_m\nS1,1.0,nan\n", "line 2"),
        ("id,x_m,y_m\nS1,1.0\n", "line 2"),
    ],
)
def test_a_truth_that_cannot_be_used_is_refused(tmp_path: Path, text: str, what: str) -> None:
    (tmp_path / "truth.csv").write_text(text)
    with pytest.raises(LogError, match=what):
        read_places(tmp_path / "truth.csv")


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    (tmp_path / "truth.csv").write_text(TRUTH)
    with pytest.raises(LogError, match=r"none.sources\.csv: cannot be read"):
        evaluation(tmp_path / "none", tmp_path / "truth.csv")
    (tmp_path / "a.tum").write_text("1.0 2 3\n")
    with pytest.raises(LogError, match="line 1 is no pose"):
        read_tum(tmp_path / "a.tum")


def test_a_trajectory_of_another_time_is_refused(run: Path) -> None:
    (run / "trajectory.tum").write_text(tum(first=5000.0))
    with pytest.raises(LogError, match="no pose lies within the times"):
        evaluation(run, run.parent / "truth.csv", run.parent / "truth.tum")


def test_a_run_with_a_map_of_its_own_is_laid_on_the_truth_first(run: Path) -> None:
    # Its frame stands at (1, 2) of the true one, turned left by 90 degrees: x = 1 - v, y = 2 + u.
    lines = []
    for k in range(11):
        half = 0.05 * k - math.pi / 4
        place = f"{1_700_000_100 + 0.1 * k:.6f} -1 {1 - 0.2 * k:.6f} 0"
        lines.append(f"{place} 0 0 {math.sin(half):.9f} {math.cos(half):.9f}")
    (run / "trajectory.tum").write_text("\n".join(lines) + "\n")
    (run / "sources.csv").write_text("id,x_m,y_m\nS1,0.0,0.0\nS2,0.0,-3.1\nS3,4.0,-3.0\n")
    truth, way = run.parent / "truth.csv", run.parent / "truth.tum"
    assert evaluation(run, truth, way).errors_m == []
    result = evaluation(run, truth, way, align=True)
    assert result.errors_m == pytest.approx([0.0, 0.1, 0.0], abs=1e-5)
    assert result.trajectory is not None
    assert result.trajectory.p95_m < 1e-5
    assert result.trajectory.heading_mean_deg < 1e-3


def test_alignment_needs_a_true_trajectory(run: Path) -> None:
    with pytest.raises(LogError, match="give the true one with --trajectory"):
        evaluation(run, run.parent / "truth.csv", align=True)
