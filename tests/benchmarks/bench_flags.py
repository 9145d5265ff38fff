"""Flags of what is not steady: scenes in which someone walks, or a machine pauses.

    python tests/benchmarks/bench_flags.py --cache /tmp/scenes --first 400

The random scenes of `bench_accuracy.py`, as they are, with someone who walks to and fro and sounds,
and with one machine that is silent now and then. Rows of sources.csv are counted by what they stand
for: a steady machine, the one that pauses, or neither, as all places on a walker's way.
"""

from __future__ import annotations

import argparse
import csv
import sys
import tomllib
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from bench_accuracy import CONFIGS, processed, simulated
from random_scenes import BESIDE, NoRoomError

from soundmap.evaluate import Place, matched

FLAGS = ("unsteady", "moving")


def counted(scene: Path, folder: Path, seed: int) -> Counter[tuple[str, str]]:
    """Rows of a scene by what they stand for, all of them and those with each flag."""
    run = processed(folder, CONFIGS / "default.toml", seed)
    with (folder / "sources.csv").open(newline="") as file:
        truth = [Place(r["id"], float(r["x_m"]), float(r["y_m"])) for r in csv.DictReader(file)]
    table = tomllib.loads(scene.read_text())
    pausing = {source["id"] for source in table["sources"] if "on_s" in source}
    found = [Place(str(i), source.x_m, source.y_m) for i, source in enumerate(run.sources)]
    stands_for = {match.found: match.id for match in matched(truth, found)[0]}
    counts: Counter[tuple[str, str]] = Counter()
    for place, source in zip(found, run.sources, strict=True):
        name = stands_for.get(place.id)
        what = "neither" if name is None else "pauses" if name in pausing else "steady"
        counts[what, "rows"] += 1
        counts.update((what, flag) for flag in FLAGS if flag in source.fit.flags)
    counts["steady", "there"] = len(truth) - len(pausing)
    counts["pauses", "there"] = len(pausing)
    return counts


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--first", type=int, default=0, help="first seed; every second is taken")
    parser.add_argument("--scenes", type=int, default=20)
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    print("scenes     runs  row of     there  rows  " + "  ".join(FLAGS))
    for beside in (None, *BESIDE):
        total: Counter[tuple[str, str]] = Counter()
        runs = 0
        for number in range(options.scenes):
            seed = options.first + 2 * number
            try:
                folder, _ = simulated(seed, options.cache, silent=False, beside=beside)
            except NoRoomError:
                continue
            total += counted(options.cache / f"{folder.name}.toml", folder, seed)
            runs += 1
        for what in ("steady", "pauses", "neither"):
            cells = "  ".join(f"{total[what, flag]:>{len(flag)}}" for flag in FLAGS)
            row = f"{total[what, 'there']:>5}  {total[what, 'rows']:>4}  {cells}"
            print(f"{beside or 'as they are':<11}{runs:>4}  {what:<8}  {row}", flush=True)


if __name__ == "__main__":
    main()
