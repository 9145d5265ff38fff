"""Thousands of damaged logs, and a log cut short at many places: what becomes of them.

Each part prints one line of figures, and what went wrong above it; the exit code is 1 if anything
did.
"""

from __future__ import annotations

import argparse
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cut_logs
import fuzzing
import small_logs
import worlds

from soundmap.config import loaded_config
from soundmap.map_file import map_files

HANG_S = 20


class TooLongError(Exception):
    """A log took longer than `HANG_S`."""


def damaged_logs(count: int, folder: Path) -> tuple[str, list[str]]:
    """Every seed's log read."""
    return complaints(count, fuzzing.Fuzzing(folder).complaints)


def damaged_runs(count: int, folder: Path) -> tuple[str, list[str]]:
    """Every seed's log processed, from the command line to the files."""
    return complaints(count, fuzzing.FuzzedRuns(folder).complaints)


def complaints(count: int, of_seed: Callable[[int], list[str]]) -> tuple[str, list[str]]:
    """What is wrong with each seed's log; memory is the peak of the whole process."""
    wrong: list[str] = []
    slowest = 0.0

    def too_long(*_: object) -> None:
        raise TooLongError

    signal.signal(signal.SIGALRM, too_long)
    for seed in range(count):
        began = time.process_time()
        signal.alarm(HANG_S)
        try:
            wrong += of_seed(seed)
        except Exception:
            wrong.append(f"seed {seed}:\n{traceback.format_exc(limit=-4)}")
        finally:
            signal.alarm(0)
        slowest = max(slowest, time.process_time() - began)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    if peak > 1024:
        wrong.append(f"memory {peak:.0f} MiB")
    return f"{count} damaged logs, slowest {slowest:.2f} s CPU, peak {peak:.0f} MiB", wrong


def site_in(folder: Path) -> tuple[Path, Path, Path]:
    """A short drive with its map and settings, and the file of each."""
    log = small_logs.write(folder / "run.mcap")
    for name, content in map_files(worlds.room()).items():
        (folder / name).write_bytes(content)
    (folder / "robot.toml").write_text(small_logs.ARRAY + '[detect]\nmethod = "maxima"\n')
    return log, folder / "map.yaml", folder / "robot.toml"


def cut_log(count: int, folder: Path, site: Path | None = None) -> tuple[str, list[str]]:
    """A log cut at places spread over its bytes, against the same log ended properly there."""
    if site is None:
        log, map_path, robot = site_in(folder)
        start: dict[str, object] = {"start_pose": small_logs.START}
    else:
        log, start = folder / "run1.mcap", {}
        log.symlink_to((site / log.name).resolve())
        map_path, robot = site / "map.yaml", site / "robot.toml"
    config, size = loaded_config([robot]), log.stat().st_size
    places = [round(size * (place + 0.5) / count) for place in range(count)]
    found = [cut_logs.compared(log, place, map_path, config, **start) for place in places]
    usable = sum(one.usable for one in found)
    wrong = [one.wrong for one in found if one.wrong]
    return f"{count} cuts of {size / 1e6:.1f} MB, {usable} of them with results", wrong


COUNTS = {"damaged": 5000, "processed": 300, "cut": 50}


def main() -> int:
    """Run the parts asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", choices=[*COUNTS], action="append", help="default: all")
    parser.add_argument("--count", type=int, help="how many, instead of the number that is usual")
    parser.add_argument(
        "--site",
        type=Path,
        help="folder with the run1.mcap to be cut, its map.yaml and robot.toml, instead of a short "
        "drive made for it",
    )
    options = parser.parse_args()
    parts: dict[str, Callable[[int, Path], tuple[str, list[str]]]] = {
        "damaged": damaged_logs,
        "processed": damaged_runs,
        "cut": partial(cut_log, site=options.site),
    }
    failed = False
    for part in options.part or parts:
        with tempfile.TemporaryDirectory() as folder:
            figures, wrong = parts[part](options.count or COUNTS[part], Path(folder))
        print(*wrong, f"{part}: {figures}, {len(wrong)} wrong", sep="\n", flush=True)
        failed |= bool(wrong)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
