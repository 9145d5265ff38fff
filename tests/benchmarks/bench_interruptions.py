"""Runs that are killed, stopped, or out of room: what they leave behind, and what comes next.

Each part prints one line of figures, and what went wrong above it; the exit code is 1 if anything
did. Small disks are mounted, which takes root on Linux; elsewhere that part is left out with a
word.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import small_logs
import worlds

from soundmap.map_file import map_files

PROGRAM = [sys.executable, "-c", "from soundmap.cli import main; main()"]
RESULTS = ("sources.csv", "trajectory.tum", "power_map.npz", "audio_scans.npz", "map.pgm")
POLL_S = 0.002


@dataclass(frozen=True)
class Site:
    """A short drive with its map and settings, and the command that processes it."""

    folder: Path

    @classmethod
    def made(cls, folder: Path) -> Site:
        small_logs.write(folder / "run.mcap")
        for name, content in map_files(worlds.room()).items():
            (folder / name).write_bytes(content)
        (folder / "robot.toml").write_text(small_logs.ARRAY)
        return cls(folder)

    @property
    def out(self) -> Path:
        return self.folder / "out"

    @property
    def cache(self) -> Path:
        return self.folder / "cache"

    def command(self, *more: object, out: Path | None = None) -> list[str]:
        given: list[object] = ["process", self.folder / "run.mcap", "--quiet", *more]
        given += ["--map", self.folder / "map.yaml", "--config", self.folder / "robot.toml"]
        return [*PROGRAM, *map(str, [*given, "--start-pose", "1,1,0", "--out", out or self.out])]

    def map_command(self, *, out: Path) -> list[str]:
        given = ["map", self.folder / "run.mcap", "--quiet", "--out", out]
        return [*PROGRAM, *map(str, given)]

    def started(self, command: list[str]) -> subprocess.Popen[str]:
        surroundings = os.environ | {"XDG_CACHE_HOME": str(self.cache)}
        return subprocess.Popen(
            command, env=surroundings, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def run(self, command: list[str]) -> tuple[int, str]:
        """Exit code and what was said on the standard error."""
        running = self.started(command)
        _, said = running.communicate()
        return running.returncode, said

    def clean(self) -> None:
        shutil.rmtree(self.out, ignore_errors=True)
        shutil.rmtree(self.cache / "soundmap", ignore_errors=True)

    def hidden(self) -> list[str]:
        """What is beside the results and in the cache without being meant to stay."""
        places = [self.folder, self.cache / "soundmap"]
        return [path.name for place in places for path in place.glob(".*")]

    def results(self) -> dict[str, bytes]:
        return {name: (self.out / name).read_bytes() for name in RESULTS}


def cpu_s(process: int) -> float:
    """CPU time of a process and its threads so far."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


Moment = Callable[[Site, int, float], bool]
"""Whether a run has come to a moment: the site, its process, how early to take it."""


def moments(site: Site, whole_cpu_s: float, files: int, count: int) -> dict[str, Moment]:
    """Moments spread over the work, and over the writing of the cache and of the files."""
    written = max(count // 3, 1)
    worked = max(count - written - 2, 1)

    def after_work(share: float) -> Moment:
        return lambda _, process, earlier: cpu_s(process) > share * earlier * whole_cpu_s

    def after_files(number: int) -> Moment:
        return lambda s, _, __: len([*s.folder.glob(".out.partial-*/*")]) >= number

    result: dict[str, Moment] = {}
    for i in range(worked):
        share = (i + 0.5) / worked
        result[f"after {share:.0%} of the work"] = after_work(share)
    result["in the writing of the cache"] = lambda s, _, __: any(s.cache.glob("soundmap/.*"))
    result["after the writing of the cache"] = lambda s, _, __: any(s.cache.glob("soundmap/*.npz"))
    for i in range(written):
        number = 1 + round(i * (files - 1) / max(written - 1, 1))
        result[f"in the writing of file {number}"] = after_files(number)
    return result


def interrupted(site: Site, moment: Moment, number: int) -> tuple[int, str]:
    """A run that gets a signal at a moment; tried again a little earlier if it was over."""
    earlier = 1.0
    while earlier > 0.5:
        site.clean()
        running = site.started(site.command("--rerun"))
        while running.poll() is None:
            try:
                if moment(site, running.pid, earlier):
                    break
            except (OSError, ValueError):
                continue
            time.sleep(POLL_S)
        running.send_signal(number)
        _, said = running.communicate()
        if running.returncode != 0:
            return running.returncode, said
        earlier *= 0.97
    return 0, ""


def signalled(count: int, folder: Path, number: int) -> tuple[str, list[str]]:
    """Runs that get a signal at moments spread over their time; after each, one that completes."""
    site = Site.made(folder)
    site.run(site.command())  # compiles kernels
    site.clean()
    before = os.times()
    code, said = site.run(site.command("--rerun"))
    if code != 0:
        return "", [f"the run without interruption fails: {said}"]
    whole_cpu_s = sum(os.times()[2:4]) - sum(before[2:4])
    names, whole = sorted(path.name for path in site.out.iterdir()), site.results()
    wrong, hit = list[str](), 0
    for name, moment in moments(site, whole_cpu_s, len(names), count).items():
        code, said = interrupted(site, moment, number)
        hit += code != 0
        if code == 0:
            wrong.append(f"{name}: the run was over before")
            continue
        if number == signal.SIGINT:
            if code != 130 or len(said.splitlines()) != 1 or "stopped" not in said:
                wrong.append(f"{name}: exit code {code} and {said!r}")
            if left := site.hidden():
                wrong.append(f"{name}: {left} left behind")
        if site.out.exists():  # right only if all was done, and the signal came while it ended
            if sorted(path.name for path in site.out.iterdir()) != names:
                wrong.append(f"{name}: a folder that looks finished")
            shutil.rmtree(site.out)
        code, said = site.run(site.command("--rerun"))
        if code != 0:
            wrong.append(f"{name}: the next run fails: {said}")
        elif site.results() != whole:
            wrong.append(f"{name}: the next run has other results")
        if left := [path.name for path in site.folder.glob(".*")]:
            wrong.append(f"{name}: {left} left behind by the next run")
    return f"{hit} runs of {whole_cpu_s:.1f} s CPU interrupted", wrong


def killed(count: int, folder: Path) -> tuple[str, list[str]]:
    """kill -9."""
    return signalled(count, folder, signal.SIGKILL)


def stopped(count: int, folder: Path) -> tuple[str, list[str]]:
    """Ctrl-C."""
    return signalled(count, folder, signal.SIGINT)


@contextmanager
def disk(place: Path, options: str) -> Iterator[Path]:
    """A disk in memory; the options say how large, or that it is read-only."""
    place.mkdir(parents=True, exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(place)], check=True)
    try:
        yield place
    finally:
        subprocess.run(["umount", str(place)], check=True)


def sizes(folder: Path, count: int) -> list[int]:
    """Sizes of disk on which, in turn, each of so many files is the first that does not fit."""
    files = sorted(folder.iterdir(), key=lambda file: file.stat().st_mtime_ns)
    total, result = 0, []
    for file in files:
        pages = -(-file.stat().st_size // 4096)
        result.append((total + pages // 2) * 4096)
        total += pages
    step = max(len(result) // count, 1)
    return [size for size in result[::step] if size]  # of no bytes would mean without bounds


def full(count: int, folder: Path) -> tuple[str, list[str]]:
    """Disks that fill up at each file in turn, for results and for the cache; and one read-only."""
    if os.geteuid() != 0:
        return "left out: mounting takes root", []
    site, wrong, failed = Site.made(folder), list[str](), 0
    commands = {"process": partial(site.command, "--rerun"), "map": site.map_command}
    for name, command in commands.items():
        code, said = site.run(command(out=folder / name))
        if code != 0:
            return "", [f"{name} fails: {said}"]
        for size in [*sizes(folder / name, count), 0]:
            option = "size={size}" if size else "ro"
            with disk(folder / "disk", option.format(size=size)) as small:
                code, said = site.run(command(out=small / "out"))
                failed += code == 1
                told = said.startswith(f"soundmap: error: {small / 'out'}: cannot be written")
                if code != 1 or len(said.splitlines()) != 1 or not told:
                    wrong.append(f"{name} on {size} bytes: exit code {code} and {said!r}")
                if left := [path.name for path in small.iterdir()]:
                    wrong.append(f"{name} on {size} bytes: left {left}")
    kept = sum(file.stat().st_size for file in site.cache.glob("soundmap/*"))
    for share in (0.01, 0.5, 0.95):
        site.clean()
        with disk(site.cache / "soundmap", f"size={int(share * kept) // 4096 * 4096 + 4096}"):
            code, said = site.run(site.command())
            if code != 0 or said or any(site.cache.glob("soundmap/*")) or site.hidden():
                wrong.append(f"a cache with {share} of the room: {code}, {said!r}, {site.hidden()}")
    return f"{failed} runs failed on disks too small", wrong


def together(count: int, folder: Path) -> tuple[str, list[str]]:
    """Two runs that write to the same folder, the second begun a little later."""
    site, wrong = Site.made(folder), list[str]()
    site.run(site.command())
    names = sorted(path.name for path in site.out.iterdir())
    whole = site.results()
    for i in range(count):
        force = ["--force"] * (i % 2)
        shutil.rmtree(site.cache / "soundmap")
        if not force:
            shutil.rmtree(site.out)
        runs = []
        for _ in range(2):
            runs.append(site.started(site.command(*force)))
            time.sleep(0.2 * (i // 2))
        said = [run.communicate()[1] for run in runs]
        codes = sorted(run.returncode for run in runs)
        if codes != ([0, 0] if force else [0, 1]):
            wrong.append(f"{force}, pause {i // 2}: exit codes {codes}, {said}")
        if not force and not any("exists and is not empty" in text for text in said):
            wrong.append(f"pause {i // 2}: {said}")
        if site.results() != whole or sorted(path.name for path in site.out.iterdir()) != names:
            wrong.append(f"{force}, pause {i // 2}: another folder than one run alone makes")
        if site.hidden():
            wrong.append(f"{force}, pause {i // 2}: {site.hidden()} left behind")
    return f"{count} pairs of runs", wrong


PARTS = {"killed": killed, "stopped": stopped, "full": full, "together": together}


def main() -> int:
    """Run the parts asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", choices=[*PARTS], action="append", help="default: all")
    parser.add_argument("--count", type=int, default=25, help="moments, disks, pairs of a part")
    options = parser.parse_args()
    # What is begun in the background ignores Ctrl-C, and so would what it begins.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    failed = False
    for part in options.part or PARTS:
        with tempfile.TemporaryDirectory() as folder:
            figures, wrong = PARTS[part](options.count, Path(folder))
        print(*wrong, f"{part}: {figures}, {len(wrong)} wrong", sep="\n", flush=True)
        failed |= bool(wrong)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
