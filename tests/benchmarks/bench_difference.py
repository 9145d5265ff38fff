"""Differences of two runs on random scenes: what is called changed that is not, and the reverse.

    python tests/benchmarks/bench_difference.py --cache /tmp/pairs

Each scene is recorded three times, every time with other errors of the robot and other sounds:
twice as it is, and once with one machine off and another 6 dB louder. The first two show how often
an unchanged source is said to have changed, and how its level scatters beside its stated error; the
third shows how often a change is found, and how great it is taken to be.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

# As the command line has it; read when numpy is first imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import tomli_w

sys.path.insert(0, str(Path(__file__).parent))
from random_scenes import random_scene

from soundmap.change import Change, ChangeKind
from soundmap.comparison import compared
from soundmap.config import loaded_config
from soundmap.errors import SoundmapError
from soundmap.evaluate import read_places, read_tum
from soundmap.outputs.illustrator import Illustrator
from soundmap.outputs.picture_format import PictureFormat
from soundmap.outputs.progress import SilentProgress
from soundmap.outputs.run_folder import write_run
from soundmap.replay import process
from soundmap.simulate.simulation import simulated_run

FIRST_SEED = 7000
LOUDER_DB = 6.0
NEAR_M = 0.5
CHANGED = (ChangeKind.APPEARED, ChangeKind.LOUDER, ChangeKind.QUIETER, ChangeKind.GONE)


def scenes(seed: int) -> dict[str, dict[str, Any]]:
    """The three recordings of a scene with two sources or more, by name."""
    table, _ = random_scene(seed)
    sources = [source["id"] for source in table["sources"]]
    table["runs"] = [{"name": "run", "sources": sources}]
    if len(sources) < 2:
        return {}
    changed = json.loads(json.dumps(table))
    off, louder = sources[0], sources[1]
    changed["runs"][0]["sources"] = [name for name in sources if name != off]
    for source in changed["sources"]:
        if source["id"] == louder:
            source["level_dba_5cm"] += LOUDER_DB
    again = json.loads(json.dumps(table))
    again["seed"], changed["seed"] = table["seed"] + 50_000, table["seed"] + 60_000
    return {"first": table, "again": again, "changed": changed}


def run_folder(name: str, table: dict[str, Any], cache: Path) -> Path:
    """A recording simulated and processed; kept in the cache."""
    made, folder = cache / f"{name}-log", cache / name
    if not (folder / "report.json").is_file():
        (cache / f"{name}.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
        simulated_run(cache / f"{name}.toml", made, force=True)
        x, y, heading = (float(value) for value in read_tum(made / "trajectory.tum").pose[0])
        run = process(
            made / "run.mcap",
            made / "map.yaml",
            loaded_config([made / "robot.toml"]),
            start_pose=(x, y, heading),
            progress=SilentProgress(),
        )
        folder.mkdir(exist_ok=True)
        write_run(run, folder, Illustrator(PictureFormat.NONE))
        (made / "run.mcap").unlink()
    return folder


def nearest(changes: Sequence[Change], x_m: float, y_m: float) -> Change | None:
    """The change at a place, if there is one near it."""
    away = [np.hypot(change.x_m - x_m, change.y_m - y_m) for change in changes]
    if not away or min(away) > NEAR_M:
        return None
    return changes[int(np.argmin(away))]


def main() -> None:
    """Print what came out."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--scenes", type=int, default=8)
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    config = loaded_config([])
    same: list[Change] = []
    told: dict[str, Counter[str]] = {"off": Counter(), "louder": Counter(), "other": Counter()}
    steps, done, seed = [], 0, FIRST_SEED
    while done < options.scenes:
        seed += 1
        try:
            tables = scenes(seed)
            folders = {n: run_folder(f"{seed}-{n}", t, options.cache) for n, t in tables.items()}
        except SoundmapError as error:
            print(f"{seed}: {error}", file=sys.stderr)
            continue
        if not folders:
            continue
        done += 1
        first = folders["first"]
        same += compared(folders["again"], first, config.diff, config.detect).ratio.changes
        changes = compared(folders["changed"], first, config.diff, config.detect).ratio.changes
        names = tables["first"]["runs"][0]["sources"]
        places = {p.id: p for p in read_places(options.cache / f"{seed}-first-log" / "sources.csv")}
        for number, name in enumerate(names):
            what = ("off", "louder")[number] if number < 2 else "other"
            change = nearest(changes, places[name].x_m, places[name].y_m)
            told[what]["not found" if change is None else str(change.kind)] += 1
            if what == "louder" and change is not None and change.sigma_db is not None:
                steps.append(change.ratio_db - LOUDER_DB)
        print(f"{seed}: {len(names)} sources", file=sys.stderr)
    known = [change for change in same if change.sigma_db is not None]
    ratio = np.array([change.ratio_db for change in known])
    sigma = np.array([change.sigma_db for change in known], dtype=float)
    false = sum(change.kind in CHANGED for change in same)
    print(f"unchanged sites: {done} pairs, {len(same)} sources, {false} called changed")
    print(
        f"  level differs by {ratio.std():.2f} dB rms, stated {np.sqrt((sigma**2).mean()):.2f} dB"
    )
    for what, counts in told.items():
        print(f"{what}: " + ", ".join(f"{n} {kind}" for kind, n in counts.most_common()))
    print(f"6 dB more came out as {6 + np.mean(steps):.2f} dB, rms error {np.std(steps):.2f} dB")


if __name__ == "__main__":
    main()
