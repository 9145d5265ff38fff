"""Thousands of damaged logs, logs cut short, killed runs, full disks: what becomes of them.

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
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import fuzzing

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


PARTS: dict[str, Callable[[int, Path], tuple[str, list[str]]]] = {
    "damaged": damaged_logs,
}
COUNTS = {"damaged": 5000}


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
