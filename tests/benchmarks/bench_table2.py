"""The paper's Table 2, measured: three runs in a corridor, and what differs between them.

    python tests/benchmarks/bench_table2.py [--seeds 5] [--cache DIR] [--jobs 1] [--record]

Simulates runs 1, 2 and 3 of ``configs/scenes/corridor.toml`` once for each seed, which draws all
errors of the robot anew, runs the program on each as a user would, with ``configs/paper.toml`` and
with the defaults, and compares the results with the truth. ``--cache`` keeps the simulated logs;
they are made again only when the scene or the simulator changes. ``--record`` puts the table into
``README.md`` and, dated, into ``RESULTS.md``.
"""

from __future__ import annotations

import argparse
import hashlib
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

import soundmap
from soundmap.evaluate import Evaluation, evaluation

TOP = Path(__file__).parents[2]
SCENE = TOP / "configs" / "scenes" / "corridor.toml"
SIMULATOR = TOP / "soundmap" / "simulate"
PAPER = TOP / "configs" / "paper.toml"
README, RESULTS = TOP / "README.md", Path(__file__).with_name("RESULTS.md")
SOUNDMAP = str(Path(sys.executable).with_name("soundmap"))  # of this environment
RUNS = ("run1", "run2", "run3")
DIFFERENCES = {"run1-run3": ("run1", "run3"), "run2-run3": ("run2", "run3")}
COLUMNS = {"paper.toml": (PAPER,), "default": ()}
"""Heading of the table, and the configuration files that come before the robot's own."""
START = "1.0,1.2,0"
"""Where the scene's robot starts: the corridor looks the same after every quarter turn."""
TABLE_2 = {"run1": {"S1": 0.29, "S2": 0.22, "S3": 0.07}, "run2": {"S1": 0.11, "S3": 0.18}}
"""Errors [m] that the paper gives in its Table 2."""
HEADING = "| | paper | paper.toml | default |\n|---|---|---|---|\n"
NOT_TOLD = "-"

Results = dict[str, list[tuple[Evaluation, int]]]
"""For each run or difference: a seed's evaluation, and its false alarms above some source."""


def simulated(cache: Path, seed: int) -> Path:
    """Folder with one folder a run, simulated unless an equal one is there already."""
    text, changed = re.subn(r"^seed = \d+$", f"seed = {seed}", SCENE.read_text(), flags=re.M)
    if changed != 1:
        raise SystemExit(f"{SCENE}: should have one line 'seed = ...'")
    code = b"".join(path.read_bytes() for path in sorted(SIMULATOR.glob("*.py")))
    digest = hashlib.sha256(code + text.encode()).hexdigest()[:12]
    folder = cache / f"seed{seed}-{digest}"
    folder.mkdir(parents=True, exist_ok=True)
    scene = folder / SCENE.name
    scene.write_text(text)
    for run in RUNS:
        if not (folder / run).exists():  # it appears only when it is whole
            program("simulate", scene, "--run", run, "--out", folder / run, "--quiet")
    return folder


def program(*arguments: object) -> None:
    """Run soundmap; stop the benchmark with its message if it fails."""
    done = subprocess.run(
        [SOUNDMAP, *map(str, arguments)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"soundmap {' '.join(map(str, arguments))}\n{done.stderr}")


def results_of(logs: Path, files: Sequence[Path], out: Path) -> dict[str, tuple[Evaluation, int]]:
    """Every run and difference of one seed, processed with some configuration and judged."""
    settings = [
        word for file in (*files, logs / "run1" / "robot.toml") for word in ("--config", file)
    ]
    quiet = ("--figures", "none", "--quiet")
    judgements = {}
    for run in RUNS:
        log = logs / run / f"{run}.mcap"
        way = ("--map", logs / run / "map.yaml", "--out", out / run, "--start-pose", START)
        program("process", log, *way, *settings, *quiet)
        truth = logs / run / "sources.csv"
        judgements[run] = judged(out / run, truth, logs / run / "trajectory.tum")
    for name, (loud, silent) in DIFFERENCES.items():
        program("diff", out / loud, out / silent, "--out", out / name, *settings, *quiet)
        judgements[name] = judged(out / name, logs / loud / "sources.csv")
    return judgements


def judged(folder: Path, sources: Path, trajectory: Path | None = None) -> tuple[Evaluation, int]:
    """A run against its truth, and how many of its false alarms come before its last source.

    The tables begin with the loudest, so this counts what a person would take for a source who
    knew how many there are.
    """
    result = evaluation(folder, sources, trajectory)
    rows = [line.split(",")[0] for line in (folder / "sources.csv").read_text().splitlines()[1:]]
    places = [rows.index(match.found) for match in result.matches if match.found is not None]
    before = max(places, default=-1) + 1 - len(places)
    return result, before


def table(columns: dict[str, Results]) -> str:
    """The whole table, in Markdown."""
    lines = []

    def row(name: str, paper: str, cell: Callable[[Results], str]) -> None:
        cells = [cell(results) for results in columns.values()]
        lines.append(f"| {name} | {paper} | {' | '.join(cells)} |\n")

    for run, sources in TABLE_2.items():
        for source, error in sources.items():
            row(
                f"run {run[-1]}, {source}: error [m]",
                f"{error:.2f}",
                lambda results, run=run, source=source: spread(errors(results, [run], source)),
            )
    told = [error for sources in TABLE_2.values() for error in sources.values()]
    row("runs 1 and 2: sources found", f"{len(told)} of {len(told)}", lambda r: found(r, TABLE_2))
    row(
        "error, mean (greatest) [m]",
        f"{np.mean(told):.2f} ({max(told):.2f})",
        lambda results: spread(errors(results, TABLE_2)),
    )
    row("false alarms in runs 1, 2, 3", NOT_TOLD, lambda r: false_alarms(r, RUNS))
    row(
        "of these above a source (runs 1, 2)",
        "0, -",
        lambda r: false_alarms(r, TABLE_2, above=True),
    )
    row("differences 1 - 3, 2 - 3: sources found", NOT_TOLD, lambda r: found(r, DIFFERENCES))
    row(
        "error, mean (greatest) [m]",
        NOT_TOLD,
        lambda results: spread(errors(results, DIFFERENCES)),
    )
    row("false alarms", NOT_TOLD, lambda r: false_alarms(r, DIFFERENCES))
    row("trajectory: median error [m]", NOT_TOLD, way_error)
    return HEADING + "".join(lines)


def found(results: Results, names: Iterable[str]) -> str:
    """How many of all sources of all seeds."""
    chosen = [result for name in names for result, _ in results[name]]
    total = sum(len(result.matches) for result in chosen)
    return f"{sum(len(result.errors_m) for result in chosen)} of {total}"


def errors(results: Results, names: Iterable[str], source: str | None = None) -> list[float]:
    """Errors [m] of the detected sources of all seeds, or of one of the sources."""
    matches = [match for name in names for result, _ in results[name] for match in result.matches]
    chosen = [match for match in matches if source in (None, match.id)]
    return [match.error_m for match in chosen if match.error_m is not None]


def spread(values: list[float]) -> str:
    """Mean and greatest."""
    return f"{np.mean(values):.3f} ({max(values):.3f})" if values else "none found"


def false_alarms(results: Results, names: Iterable[str], *, above: bool = False) -> str:
    """Mean over the seeds, one for each name; or of those alone that stand above some source."""
    counts = [
        np.mean([before if above else len(result.false_alarms) for result, before in results[name]])
        for name in names
    ]
    return ", ".join(f"{count:.1f}" for count in counts)


def way_error(results: Results) -> str:
    """Mean over runs and seeds of the median error."""
    ways = [result.trajectory for run in RUNS for result, _ in results[run]]
    return f"{np.mean([way.median_m for way in ways if way is not None]):.3f}"


def circumstances(seeds: int) -> str:
    """When, of which commit, and where."""
    git = ["git", "-C", str(TOP)]
    commit = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True)
    changed = subprocess.run(
        [*git, "status", "--porcelain", "--", "soundmap", "configs"], capture_output=True, text=True
    )
    words = commit.stdout.strip() + (" and changes" if changed.stdout.strip() else "")
    info = Path("/proc/cpuinfo")
    names = re.findall(r"model name\s*: (.*)", info.read_text()) if info.exists() else []
    machine = f"{len(names)} x {names[0]}" if names else platform.processor()
    return f"{datetime.now(UTC):%Y-%m-%d}, commit {words}, {seeds} seeds, {machine}"


def record(text: str, what: str) -> None:
    """Put the table into the README, and before the earlier ones into the results."""
    readme, results = README.read_text(), RESULTS.read_text()
    before, rest = readme.split(HEADING)
    after = rest[rest.index("\n\n") + 1 :]
    README.write_text(before + text + after)
    title = "## Table 2: `bench_table2.py`\n\n"
    before, rest = results.split(title)
    RESULTS.write_text(f"{before}{title}### {what}\n\n{text}\n{rest}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--cache", type=Path, help="folder that keeps the simulated logs")
    parser.add_argument("--jobs", type=int, default=1, help="seeds that run at the same time")
    parser.add_argument("--record", action="store_true", help="write README.md and RESULTS.md")
    options = parser.parse_args()
    if Path(soundmap.__file__).parents[1] != TOP:
        raise SystemExit(f"measures {soundmap.__file__}: install {TOP} with pip install -e")
    what = circumstances(options.seeds)
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)

        def one(seed: int) -> dict[str, dict[str, tuple[Evaluation, int]]]:
            logs = simulated(options.cache or scratch / "logs", seed)
            judgements = {}
            for name, files in COLUMNS.items():
                out = scratch / f"{seed}-{name}"
                judgements[name] = results_of(logs, files, out)
                shutil.rmtree(out)
            print(f"seed {seed} done", file=sys.stderr)
            return judgements

        with ThreadPoolExecutor(options.jobs) as pool:
            seeds = list(pool.map(one, range(1, options.seeds + 1)))
    columns = {
        name: {run: [seed[name][run] for seed in seeds] for run in seeds[0][name]}
        for name in COLUMNS
    }
    text = table(columns)
    print(f"{what}\n\n{text}")
    if options.record:
        record(text, what)


if __name__ == "__main__":
    main()
