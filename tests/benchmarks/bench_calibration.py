"""Errors of the array's clock and yaw put into simulated runs, and what is found of them.

    python tests/benchmarks/bench_calibration.py --cache /tmp/scenes --half tuning

The random scenes of `bench_accuracy.py`, from the same cache; even seeds are the tuning half, odd
ones the judging half. Each log is read and localized once. Then its audio is stamped off and its
array believed turned by random amounts, and all that follows is done again: with the correction,
and without it. Sources are compared with those of the clean run, not with the truth: what matters
here is what the offsets do. The scenes' drives of 20 to 40 s have one to three turns; `--ways 2`
lets the robot drive back as well.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

# As the command line has it; read when numpy is first imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from bench_accuracy import simulated

from soundmap.config import Config, loaded_config
from soundmap.detect.fitted_sources import fitted_sources
from soundmap.evaluate import read_tum
from soundmap.fuse.bearing_range import ranges_around
from soundmap.fuse.power_map import level_reference
from soundmap.fuse.surroundings import SurroundingsGatherer
from soundmap.geometry import Trajectory
from soundmap.grid import OccupancyGrid
from soundmap.localize.trajectory import estimate_trajectory
from soundmap.logs.robot_log import open_log
from soundmap.map_file import read_map
from soundmap.replay import offsets_by_peaks, refined_offsets
from soundmap.scan.audio_scan import audio_scans, kept_scans
from soundmap.sensors import ArrayOffsets, LaserScan, MicArray, OffsetVerdict
from soundmap.sound import AudioScans
from soundmap.surroundings import Surroundings

MOST_CLOCK_S, MOST_YAW_RAD = 0.080, np.radians(8.0)
SAME_M, NEAR_M = 0.5, 0.03
"""A source is the clean run's within the first; the offsets did no harm within the second."""


@dataclass(frozen=True)
class Heard:
    """A run up to where offsets matter."""

    config: Config
    room: OccupancyGrid
    trajectory: Trajectory
    scans: AudioScans
    surroundings: Surroundings
    array: MicArray
    duration_s: float


@dataclass(frozen=True)
class Trial:
    """One pair of offsets: put in and found, and how far the clean run's sources moved [m]."""

    clock_s: float
    yaw_rad: float
    found: ArrayOffsets
    cost_s_per_min: float
    moved_m: list[float]
    moved_uncorrected_m: list[float]

    @property
    def told(self) -> bool:
        """Whether both can be told."""
        return OffsetVerdict.UNKNOWN not in (
            self.found.clock.verdict,
            self.found.yaw.verdict,
        )


def heard(folder: Path, seed: int) -> Heard:
    """A simulated log, read and localized from a start that is off a little."""
    config = loaded_config([folder / "robot.toml"])
    log = open_log(folder / "run.mcap", config)
    assert log.array is not None
    room = read_map(folder / "map.yaml")
    off = np.random.default_rng(seed).normal(0.0, [0.08, 0.08, 0.04])
    x, y, heading = (float(v) for v in read_tum(folder / "trajectory.tum").pose[0] + off)
    trajectory = estimate_trajectory(
        log.lasers(), log.odometry, room, config.localize, start_pose=(x, y, heading)
    )
    gatherer = SurroundingsGatherer(log.odometry)

    def audio():
        for item in log.measurements():
            if isinstance(item, LaserScan):
                gatherer.see(item)
            else:
                yield item

    scans = kept_scans(
        audio_scans(audio(), log.array, config.scan, sharp=True),
        level_reference(log.array.pascal_per_count),
        log.array.mount,
        config.scan.sub_band_hz,
    )
    return Heard(config, room, trajectory, scans, gatherer.gathered(), log.array, log.duration_s)


def offset_by(run: Heard, clock_s: float, yaw_rad: float) -> Heard:
    """The run with so much to be added to its audio's clock and its array's yaw."""
    mount = run.array.mount.turned(yaw_rad)
    time_ns = run.scans.time_ns + round(clock_s * 1e9)
    return replace(
        run,
        scans=replace(run.scans, time_ns=time_ns, mount=mount),
        array=replace(run.array, mount=mount),
    )


def found_offsets(run: Heard) -> tuple[ArrayOffsets, float]:
    """Offsets, and the CPU time that they took for each minute of the log [s]."""
    began = time.process_time()
    by_peaks = offsets_by_peaks(run.scans, run.trajectory, run.array, run.config)
    assert by_peaks is not None
    where = run.surroundings, run.trajectory, run.array, run.config
    found = refined_offsets(by_peaks, run.scans, *where)
    return found, (time.process_time() - began) * 60.0 / run.duration_s


def source_places(run: Heard) -> np.ndarray:
    """Sources found, shape (K, 2) [m]."""
    around = ranges_around(run.surroundings, run.trajectory, run.scans.time_ns, run.array.mount)
    sources = fitted_sources(
        run.scans,
        around,
        run.trajectory,
        run.array,
        run.config.scan,
        run.config.detect,
        room=run.room,
    )
    return np.array([(source.x_m, source.y_m) for source in sources]).reshape(-1, 2)


def moves(places: np.ndarray, clean: np.ndarray) -> list[float]:
    """Distance of each of the clean run's sources to the nearest now [m]; inf if it is gone."""
    away = np.hypot(*(places[None] - clean[:, None]).transpose(2, 0, 1))
    nearest = away.min(axis=1, initial=np.inf)
    return [float(d) if d < SAME_M else float("inf") for d in nearest]


def trials(run: Heard, rng: np.random.Generator, count: int, *, detect: bool) -> list[Trial]:
    """The clean run first, then runs with random offsets."""
    clean = source_places(run) if detect else np.empty((0, 2))
    done = []
    for number in range(count + 1):
        clock_s = yaw_rad = 0.0
        if number:
            clock_s = float(rng.uniform(-MOST_CLOCK_S, MOST_CLOCK_S))
            yaw_rad = float(rng.uniform(-MOST_YAW_RAD, MOST_YAW_RAD))
        off = offset_by(run, -clock_s, -yaw_rad)
        found, cost = found_offsets(off)
        corrected = offset_by(off, found.clock.correction, found.yaw.correction)
        moved = moves(source_places(corrected), clean) if detect else []
        uncorrected = moves(source_places(off), clean) if detect and number else []
        done.append(Trial(clock_s, yaw_rad, found, cost, moved, uncorrected))
    return done


def clock_error_ms(trial: Trial) -> float:
    return 1e3 * (trial.found.clock.value - trial.clock_s)


def yaw_error_deg(trial: Trial) -> float:
    return float(np.degrees(trial.found.yaw.value - trial.yaw_rad))


def described(seed: int, trial: Trial) -> str:
    clock, yaw = trial.found.clock, trial.found.yaw
    put_in = f"{seed:>5} {1e3 * trial.clock_s:+6.1f} ms {np.degrees(trial.yaw_rad):+5.2f} deg: "
    if not trial.told:
        return put_in + f"not told, {trial.found.why}"
    return put_in + (
        f"off by {clock_error_ms(trial):+6.1f} ms (sigma {1e3 * clock.sigma:4.1f}), "
        f"{yaw_error_deg(trial):+5.2f} deg (sigma {np.degrees(yaw.sigma):4.2f}), "
        f"{trial.found.explained:.2f} explained; {clock.verdict}; {yaw.verdict}"
    )


def quantiles(values: Sequence[float]) -> str:
    if not len(values):
        return "-"
    low, high, top = np.percentile(np.abs(values), [50, 90, 100])
    return f"{low:.2f}, {high:.2f}, {top:.2f}"


def summary(name: str, done: Sequence[Trial]) -> str:
    """Lines about some trials."""
    told = [trial for trial in done if trial.told]
    changed = sum(t.found.clock.correction != 0.0 or t.found.yaw.correction != 0.0 for t in done)
    within = sum(abs(clock_error_ms(t)) <= 5.0 and abs(yaw_error_deg(t)) <= 0.5 for t in told)
    lines = [
        f"{name}: {len(done)} runs, told in {len(told)}, corrected in {changed}",
        f"  clock off by [ms], median, 90 %, greatest: {quantiles([*map(clock_error_ms, told)])}",
        f"  yaw off by [deg], median, 90 %, greatest: {quantiles([*map(yaw_error_deg, told)])}",
        f"  both within 5 ms and 0.5 deg: {within} of {len(told)}",
    ]
    for what, moved in (
        ("corrected", [d for t in told for d in t.moved_m]),
        ("uncorrected", [d for t in told for d in t.moved_uncorrected_m]),
        ("where nothing was told", [d for t in done if not t.told for d in t.moved_m]),
    ):
        if moved:
            kept = np.array(moved)[np.isfinite(moved)]
            near = np.mean(np.array(moved) <= NEAR_M)
            lines.append(
                f"  {what}: {len(moved)} sources of the clean run, {near:.0%} within "
                f"{NEAR_M} m of there, {len(moved) - len(kept)} gone; moved by [m], median, 90 %, "
                f"greatest: {quantiles(kept)}"
            )
    return "\n".join(lines)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--cache", type=Path, required=True, help="folder for simulated scenes")
    parser.add_argument("--half", choices=("tuning", "judging"), default="tuning")
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="number of the first scene")
    parser.add_argument("--offsets", type=int, default=3, help="pairs of offsets for each scene")
    parser.add_argument(
        "--ways", type=int, default=1, help="how often each way is driven, there and back in turn"
    )
    parser.add_argument("--no-sources", action="store_true", help="estimate offsets only")
    arguments = parser.parse_args()
    arguments.cache.mkdir(parents=True, exist_ok=True)
    done: list[Trial] = []
    for number in range(arguments.first, arguments.first + arguments.scenes):
        seed = 2 * number + (arguments.half == "judging")
        folder, _ = simulated(seed, arguments.cache, silent=False, ways=arguments.ways)
        rng = np.random.default_rng([seed, 8])
        new = trials(heard(folder, seed), rng, arguments.offsets, detect=not arguments.no_sources)
        for trial in new:
            print(described(seed, trial), flush=True)
        done += new
    clean = [trial for trial in done if trial.clock_s == trial.yaw_rad == 0.0]
    print(summary("clean", clean))
    print(summary("with offsets", [trial for trial in done if trial not in clean]))
    cost = np.mean([trial.cost_s_per_min for trial in done])
    print(f"cost: {cost:.2f} s of CPU time for each minute of the log")


if __name__ == "__main__":
    main()
