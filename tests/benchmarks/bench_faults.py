"""Thousands of damaged logs, a log cut short at many places, killed runs: what becomes of them.

Each part prints one line of figures, and what went wrong above it; the exit code is 1 if anything
did.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
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
    """Every seed's log read; memory is the peak of the whole process."""
    logs = fuzzing.Fuzzing(folder)
    wrong: list[str] = []
    slowest = 0.0

    def too_long(*_: object) -> None:
        raise TooLongError

    signal.signal(signal.SIGALRM, too_long)
    for seed in range(count):
        began = time.process_time()
        signal.alarm(HANG_S)
        try:
            wrong += logs.complaints(seed)
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


def cut_log(count: int, folder: Path) -> tuple[str, list[str]]:
    """A log cut at places spread over its bytes, against the same log ended properly there."""
    log, map_path, robot = site_in(folder)
    config, size = loaded_config([robot]), log.stat().st_size
    places = [round(size * (place + 0.5) / count) for place in range(count)]
    found = [
        cut_logs.difference(log, place, map_path, config, start_pose=small_logs.START)
        for place in places
    ]
    return f"{count} cuts of {size / 1e6:.1f} MB", [wrong for wrong in found if wrong]


def killed_runs(count: int, folder: Path) -> tuple[str, list[str]]:
    """A run killed at moments spread over its time; then one that must complete."""
    log, map_path, robot = site_in(folder)
    out = folder / "out"
    command = [sys.executable, "-c", "from soundmap.cli import main; main()", "process", str(log)]
    command += ["--map", str(map_path), "--config", str(robot), "--start-pose", "1,1,0"]
    command += ["--out", str(out), "--quiet"]
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")

    def run(kill_after_s: float | None) -> float:
        began = time.monotonic()
        running = subprocess.Popen(command)
        try:
            code = running.wait(kill_after_s)
        except subprocess.TimeoutExpired:
            running.kill()
            code = running.wait()
        return time.monotonic() - began if code == 0 else -1.0

    run(None)  # compiles kernels
    names = sorted(path.name for path in out.iterdir())
    shutil.rmtree(out)
    shutil.rmtree(folder / "cache")
    whole_s = run(None)
    wrong, killed = list[str](), 0
    for moment in range(count):
        shutil.rmtree(out, ignore_errors=True)
        shutil.rmtree(folder / "cache", ignore_errors=True)
        if run(whole_s * (moment + 0.5) / count) > 0:
            continue  # it was faster this time
        killed += 1
        if out.exists():  # right only if all was done, and the process killed while it ended
            if sorted(path.name for path in out.iterdir()) != names:
                wrong.append(f"killed at moment {moment}: a folder that looks finished")
            shutil.rmtree(out)
        if run(None) < 0 or not (out / "report.json").is_file():
            wrong.append(f"killed at moment {moment}: the next run does not complete")
        left = [path.name for path in folder.iterdir() if path.name.startswith(".")]
        if left:
            wrong.append(f"killed at moment {moment}: {left} left behind")
    return f"{killed} runs of {whole_s:.1f} s killed", wrong


PARTS: dict[str, Callable[[int, Path], tuple[str, list[str]]]] = {
    "damaged": damaged_logs,
    "cut": cut_log,
    "killed": killed_runs,
}
COUNTS = {"damaged": 5000, "cut": 50, "killed": 25}


def main() -> int:
    """Run the parts asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", choices=[*PARTS], action="append", help="default: all")
    parser.add_argument("--count", type=int, help="how many, instead of the number that is usual")
    options = parser.parse_args()
    failed = False
    for part in options.part or PARTS:
        with tempfile.TemporaryDirectory() as folder:
            figures, wrong = PARTS[part](options.count or COUNTS[part], Path(folder))
        print(*wrong, f"{part}: {figures}, {len(wrong)} wrong", sep="\n", flush=True)
        failed |= bool(wrong)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
