"""Accuracy over random scenes: paper.toml beside default.toml.

    python tests/benchmarks/bench_accuracy.py --cache /tmp/scenes --half tuning

Even seeds are the tuning half, odd ones from 33001 on the judging half: look at the judging half
only to judge, and take fresh seeds once it has been looked at. Scenes are simulated once and kept
in the cache. The start pose given to the program is the true one, off by 8 cm and 2 degrees or so;
trajectories are estimated. A source counts as detected when a row of sources.csv lies within 0.5 m
of it.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

# As the command line has it; read when numpy is first imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from random_scenes import Difficulty, written_scene

from soundmap.config import loaded_config
from soundmap.evaluate import Place, matched, read_tum, trajectory_error
from soundmap.geometry import CHI_SQUARED_95
from soundmap.outputs.progress import SilentProgress
from soundmap.replay import process
from soundmap.run import Run
from soundmap.simulate.simulation import simulated_run

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
FIRST_SEED = {"tuning": 0, "judging": 33001}
FIRST_SILENT_SEED = {"tuning": 100, "judging": 34001}


@dataclass(frozen=True)
class Outcome:
    """One scene, one configuration."""

    difficulty: Difficulty
    sources: int
    errors_m: list[float]
    false_alarms: int
    level_errors_db: list[float]
    inside: list[bool]
    pose_error_m: float
    sound_s_per_min: float


def simulated(
    seed: int, cache: Path, *, silent: bool, ways: int = 1, beside: str | None = None
) -> tuple[Path, Difficulty]:
    """Folder of a simulated scene, from the cache if it is there."""
    name = ("s" if silent else "") + str(seed) + ("" if ways == 1 else f"x{ways}") + (beside or "")
    folder, notes = cache / name, cache / f"{name}.json"
    if not (folder / "run.mcap").is_file() or not notes.is_file():
        difficulty = written_scene(
            seed, cache / f"{name}.toml", silent=silent, ways=ways, beside=beside
        )
        simulated_run(cache / f"{name}.toml", folder, force=True)
        notes.write_text(json.dumps(dataclasses.asdict(difficulty)))
    return folder, Difficulty(**json.loads(notes.read_text()))


def processed(folder: Path, settings: Path, seed: int) -> Run:
    """A simulated scene as `soundmap process` has it, from a start pose that is off a little."""
    off = np.random.default_rng(seed).normal(0.0, [0.08, 0.08, 0.04])
    true_start = read_tum(folder / "trajectory.tum").pose[0]
    x, y, heading = (float(value) for value in true_start + off)
    return process(
        folder / "run.mcap",
        folder / "map.yaml",
        loaded_config([settings, folder / "robot.toml"]),
        start_pose=(x, y, heading),
        progress=SilentProgress(),
    )


def outcome(folder: Path, difficulty: Difficulty, settings: Path, seed: int) -> Outcome:
    """A simulated scene processed and judged."""
    run = processed(folder, settings, seed)
    way = trajectory_error(run.trajectory, read_tum(folder / "trajectory.tum"))
    return judged(run, folder / "sources.csv", difficulty, way)


def judged(run: Run, truth_file: Path, difficulty: Difficulty, way: object) -> Outcome:
    """A run against its truth."""
    with truth_file.open(newline="") as file:
        truth = {row["id"]: row for row in csv.DictReader(file)}
    places = [Place(name, float(row["x_m"]), float(row["y_m"])) for name, row in truth.items()]
    found = [Place(str(i), source.x_m, source.y_m) for i, source in enumerate(run.sources)]
    matches, left_over = matched(places, found)
    errors, levels, inside = [], [], []
    for match, place in zip(matches, places, strict=True):
        if match.found is None or match.error_m is None:
            continue
        source = run.sources.sources[int(match.found)]
        errors.append(match.error_m)
        if source.fit is not None:
            step = np.array([source.x_m - place.x_m, source.y_m - place.y_m])
            distance = step @ np.linalg.solve(source.fit.covariance_m2, step)
            inside.append(bool(distance < CHI_SQUARED_95))
            level = 10.0 * np.log10(source.fit.power_1m)
            levels.append(float(level) - float(truth[match.id]["level_1m_db"]))
    return Outcome(
        difficulty,
        len(places),
        errors,
        len(left_over),
        levels,
        inside,
        getattr(way, "median_m", float("nan")),
        60.0 * run.timings_s["detect"] / run.duration_s,
    )


def row(name: str, outcomes: Sequence[Outcome]) -> str:
    """One line of the table."""
    sources = sum(each.sources for each in outcomes)
    errors = np.array([error for each in outcomes for error in each.errors_m])
    levels = np.array([error for each in outcomes for error in each.level_errors_db])
    inside = [good for each in outcomes for good in each.inside]
    alarms = sum(each.false_alarms for each in outcomes) / max(len(outcomes), 1)
    cells = [f"{name:<28}", f"{len(outcomes):>4} {sources:>5}"]
    cells.append(f"{len(errors) / sources:6.3f}" if sources else "     -")
    cells.append(f"{alarms:7.2f}")
    if len(errors):
        p95 = np.percentile(errors, 95)
        cells.append(
            f"{errors.mean():6.3f} {np.median(errors):6.3f} {p95:6.3f} {errors.max():6.3f}"
        )
    if len(levels):
        cells.append(f"{levels.mean():+6.2f} {np.abs(levels).mean():5.2f} {np.mean(inside):6.3f}")
    return "  ".join(cells)


BREAKDOWN: dict[str, list[tuple[str, Callable[[Outcome], bool]]]] = {
    "level gap": [
        ("< 4 dB", lambda each: each.difficulty.level_gap_db < 4.0),
        ("4 dB and more", lambda each: each.difficulty.level_gap_db >= 4.0),
    ],
    "separation": [
        ("< 1.5 m", lambda each: each.difficulty.separation_m < 1.5),
        ("1.5 m and more", lambda each: each.difficulty.separation_m >= 1.5),
    ],
    "reverberation": [
        ("< 0.7 s", lambda each: each.difficulty.reverberation_s < 0.7),
        ("0.7 s and more", lambda each: each.difficulty.reverberation_s >= 0.7),
    ],
    "pose error": [
        ("< 1 cm", lambda each: each.pose_error_m < 0.01),
        ("1 cm and more", lambda each: each.pose_error_m >= 0.01),
    ],
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--half", choices=["tuning", "judging"], default="tuning")
    parser.add_argument("--scenes", type=int, default=30)
    parser.add_argument("--silent", type=int, default=10)
    parser.add_argument("--configs", nargs="+", default=["paper.toml", "default.toml"])
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    jobs = [(FIRST_SEED[options.half] + 2 * i, False) for i in range(options.scenes)]
    jobs += [(FIRST_SILENT_SEED[options.half] + 2 * i, True) for i in range(options.silent)]
    results: dict[tuple[str, bool], list[Outcome]] = {}
    for seed, silent in jobs:
        folder, difficulty = simulated(seed, options.cache, silent=silent)
        for name in options.configs:
            each = outcome(folder, difficulty, CONFIGS / name, seed)
            results.setdefault((name, silent), []).append(each)
            print(
                f"{'silent ' if silent else ''}{seed} {name}: {len(each.errors_m)} of "
                f"{each.sources}, {each.false_alarms} false",
                file=sys.stderr,
            )
    print(f"{'':28}  runs   src  recall  alarms  mean_m  med_m  p95_m  max_m  level   mae  cover")
    for name in options.configs:
        loud, quiet = results.get((name, False), []), results.get((name, True), [])
        print(row(name, loud))
        if quiet:
            silent_runs = sum(each.false_alarms == 0 for each in quiet)
            print(f"  silent runs without a source: {silent_runs} of {len(quiet)}")
        print(
            f"  detection: {np.mean([each.sound_s_per_min for each in loud + quiet]):.1f} s "
            "a minute of log"
        )
        for what, parts in BREAKDOWN.items():
            for label, belongs in parts:
                print(row(f"  {what} {label}", [each for each in loud if belongs(each)]))


if __name__ == "__main__":
    main()
