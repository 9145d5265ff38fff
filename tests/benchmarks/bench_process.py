"""How long the whole program takes, and how much memory, as logs grow.

    python tests/benchmarks/bench_process.py --cache DIR [--minutes 1 10 60] [--repeats 1]

Logs of one simulated lap, driven over and over (`long_logs.py`): 16 channels at 48 kHz, two laser
scanners of 40 Hz, odometry, zstd. Each is processed by the installed `soundmap process`, defaults
and pictures included, in a process of its own. Wall and CPU time, the greatest resident memory (of
that process: the one that draws its pictures takes another 130 to 140 MB for a while), the stages
of `report.json`, and the exponent with which CPU time grows from the first to the last log. A first
run, which may have to compile, is not counted.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from long_logs import lap, long_log
from machine import machine

SOUNDMAP = str(Path(sys.executable).with_name("soundmap"))
START = "3.0,1.1,0"


@dataclass(frozen=True)
class Cost:
    """What one run took."""

    log_s: float
    wall_s: float
    cpu_s: float
    peak_mb: float
    stages_s: dict[str, float]
    sources: int


def cost(log: Path, site: Path, *, with_map: bool, rerun: bool = False) -> Cost:
    """Process a log and tell what it took."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        command = [SOUNDMAP, "process", str(log), "--out", str(out), "--no-cache", "--quiet"]
        command += ["--config", str(site / "robot.toml")]
        if rerun:
            command.append("--rerun")
        if with_map:
            command += ["--map", str(site / "map.yaml"), "--start-pose", START]
        began = time.perf_counter()
        running = subprocess.Popen(command)
        _, status, used = os.wait4(running.pid, 0)
        wall_s = time.perf_counter() - began
        if status:
            raise SystemExit(f"{' '.join(command)} failed")
        report = json.loads((out / "report.json").read_text())
    return Cost(
        report["duration_s"],
        wall_s,
        used.ru_utime + used.ru_stime,
        used.ru_maxrss / 1024,
        report["timings_s"],
        len(report["sources"]),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cache", type=Path, required=True, help="where the logs are kept")
    parser.add_argument("--minutes", type=float, nargs="+", default=[1.0, 10.0, 60.0])
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--no-map", action="store_true", help="build the map from the log")
    parser.add_argument("--rerun", action="store_true", help="write recordings, too")
    options = parser.parse_args()
    site = lap(options.cache)
    logs = [long_log(options.cache, minutes) for minutes in sorted(options.minutes)]
    print(machine("numpy", "scipy", "numba", "zstandard"))
    print("map built from the log" if options.no_map else "with a map", end="\n\n")
    cost(logs[0], site, with_map=not options.no_map)
    print(
        "| log [s] | wall [s] | x real time | CPU [s] | x real time | peak [MB] | sources ", end=""
    )
    print("| stages, wall [s] |\n|---|---|---|---|---|---|---|---|", flush=True)
    best = []
    for log in logs:
        runs = [
            cost(log, site, with_map=not options.no_map, rerun=options.rerun)
            for _ in range(options.repeats)
        ]
        least = min(runs, key=lambda run: run.wall_s)
        best.append(least)
        worst_s = max(run.wall_s for run in runs)
        wall = f"{least.wall_s:.1f}" + (f" to {worst_s:.1f}" if len(runs) > 1 else "")
        stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in least.stages_s.items())
        peak_mb = max(run.peak_mb for run in runs)
        print(f"| {least.log_s:.0f} | {wall} | {least.log_s / least.wall_s:.1f} ", end="")
        print(f"| {least.cpu_s:.1f} | {least.log_s / least.cpu_s:.1f} ", end="")
        print(f"| {peak_mb:.0f} | {least.sources} | {stages} |", flush=True)
    if len(best) > 1:
        ratio = np.log(best[-1].cpu_s / best[0].cpu_s) / np.log(best[-1].log_s / best[0].log_s)
        print(f"\nCPU time grows with the power {ratio:.2f} of the log's duration")


if __name__ == "__main__":
    main()
