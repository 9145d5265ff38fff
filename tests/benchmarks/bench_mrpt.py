"""Localization and mapping beside MRPT's: CPU time and accuracy on one real log, in one run.

    python tests/benchmarks/bench_mrpt.py --log LOG --map YAML --truth TUM --relations FILE

Needs MRPT's programs (Debian's `mrpt-apps`); without them it says so and stops. The log has one
laser scanner at the base. Its scans and odometry are written in CARMEN's format, which
`carmen2rawlog` reads; that gives every scan the same time, so the true ones are put in its place.

`pf-localization` is told the start, to half a metre and 10 degrees, and runs with two sizes of its
filter and two measurement models; soundmap is told nothing. `icp-slam` runs with the settings of
MRPT's own demo. Positions are compared with the reference trajectory, maps by the relations between
poses that were checked by hand (Kuemmerle et al. 2009). Times are CPU seconds of whole processes of
MRPT without pictures, and of soundmap's second call, after it has been compiled; both read the log
before, from a file and into memory.
"""

from __future__ import annotations

import argparse
import gzip
import re
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from time import process_time

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from soundmap.config import Config
from soundmap.geometry import Trajectory, relative, wrapped_angle
from soundmap.grid import OccupancyGrid
from soundmap.localize.trajectory import estimate_trajectory
from soundmap.logs.robot_log import open_log
from soundmap.map_file import read_map
from soundmap.mapping.geometric_map import build_map
from soundmap.sensors import LaserScan

PROGRAMS = ("carmen2rawlog", "ros-map-yaml2mrpt", "pf-localization", "icp-slam")
NO_RETURN_M = 81.9
"""What a SICK scanner reports where it sees nothing."""
FILTERS = {
    "likelihood field, 1000": (4, 1000),
    "likelihood field, 5000": (4, 5000),
    "beam model, 1000": (1, 1000),
}
"""MRPT's number of the measurement model, and the particles."""
PF_INI = """
[KLD_options]
KLD_binSize_PHI_deg=10
KLD_binSize_XY=0.10
KLD_delta=0.01
KLD_epsilon=0.01
KLD_maxSampleSize={particles}
KLD_minSampleSize={particles}
KLD_minSamplesPerBin=0
[PF_options]
PF_algorithm=0
resamplingMethod=3
adaptiveSampleSize=0
BETA=0.5
sampleSize=1
[DummyOdometryParams]
minStdXY=0.05
minStdPHI=2.0
[LocalizationExperiment]
use_3D_poses=false
map_file={room}
rawlog_file={rawlog}
logOutput_dir={out}
3DSceneFrequency=-1
experimentRepetitions=1
particles_count={particles}
init_PDF_mode=0
init_PDF_min_x={left}
init_PDF_max_x={right}
init_PDF_min_y={bottom}
init_PDF_max_y={top}
init_PDF_min_yaw_deg={right_most}
init_PDF_max_yaw_deg={left_most}
SHOW_PROGRESS_3D_REAL_TIME=false
[MetricMap]
occupancyGrid_count=1
pointsMap_count=0
likelihoodMapSelection=-1
[MetricMap_occupancyGrid_00_creationOpts]
resolution={cell_m}
[MetricMap_occupancyGrid_00_insertOpts]
mapAltitude=0
useMapAltitude=0
[MetricMap_occupancyGrid_00_likelihoodOpts]
likelihoodMethod={model}
LF_decimation=3
LF_stdHit=0.15
LF_maxCorrsDistance=0.50
LF_zHit=0.95
LF_zRandom=0.05
LF_maxRange=80
rayTracing_useDistanceFilter=0
rayTracing_decimation=3
rayTracing_stdHit=0.20
"""
ESTIMATE = re.compile(r"PDF estimation: \(([-\d.]+),([-\d.]+),([-\d.]+)deg\)")
"""How pf-localization prints the pose of each scan."""
ICP_DEMO = Path("/usr/share/mrpt/config_files/icp-slam/icp-slam_demo_classic.ini")


def carmen_log(scans: list[LaserScan], odometry: Trajectory) -> str:
    """The scans and the odometry at their times in CARMEN's text format, one line a scan."""
    lines = []
    for scan in scans:
        ranges = np.where(np.isfinite(scan.range_m), scan.range_m, NO_RETURN_M)
        pose = " ".join(f"{value:.6f}" for value in odometry.at(scan.time_ns))
        time_s = scan.time_ns * 1e-9
        values = " ".join(f"{value:.3f}" for value in ranges)
        lines.append(f"FLASER {len(ranges)} {values} {pose} {pose} {time_s:.6f} log {time_s:.6f}\n")
    return "".join(lines)


def timed_rawlog(rawlog: bytes, time_ns: list[int]) -> bytes:
    """A rawlog in which odometry and scan of each time have that time, where all had the same."""
    label = b"ODOMETRY"
    at = rawlog.index(label) + len(label)
    stamp = rawlog[at : at + 8]
    parts = rawlog.split(stamp)
    if len(parts) != 2 * len(time_ns) + 1:
        raise SystemExit(f"carmen2rawlog wrote {len(parts) - 1} times for {len(time_ns)} scans")
    # Tenths of microseconds since the year 1601.
    ticks = [time // 100 + 11_644_473_600 * 10**7 for time in time_ns]
    timed = [parts[0]]
    for number, part in enumerate(parts[1:]):
        timed += [ticks[number // 2].to_bytes(8, "little"), part]
    return b"".join(timed)


def run(command: list[str], folder: Path) -> tuple[float, str]:
    """CPU seconds of a program, and what it printed."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, stdin=subprocess.DEVNULL
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode != 0:
        raise SystemExit(f"{command[0]} ended with {done.returncode}: {done.stderr[-500:]}")
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, done.stdout


def position_errors(pose: np.ndarray, time_ns: np.ndarray, truth: Trajectory) -> str:
    """Against the reference, at the times it knows."""
    off = pose - truth.at(time_ns)
    off = off[np.isfinite(off[:, 0])]
    error_m, turn = np.hypot(off[:, 0], off[:, 1]), np.abs(wrapped_angle(off[:, 2]))
    return (
        f"median {np.median(error_m):.3f}, 95 % {np.quantile(error_m, 0.95):.3f}, mean "
        f"{error_m.mean():.3f} m, heading {np.degrees(turn.mean()):.2f} deg"
    )


def relation_errors(found: Trajectory, odometry: Trajectory, relations: np.ndarray) -> str:
    """Against the relations: time, time, x, y, z, roll, pitch, yaw; carried there by odometry."""
    ends = []
    for column in range(2):
        time_ns = np.rint(relations[:, column] * 1e9).astype(np.int64)
        time_ns = time_ns.clip(found.time_ns[0], found.time_ns[-1])
        near = np.abs(found.time_ns[None, :] - time_ns[:, None]).argmin(axis=1)
        step = relative(odometry.at(found.time_ns[near]), odometry.at(time_ns))
        cos, sin = np.cos(found.pose[near, 2]), np.sin(found.pose[near, 2])
        x = found.pose[near, 0] + cos * step[:, 0] - sin * step[:, 1]
        y = found.pose[near, 1] + sin * step[:, 0] + cos * step[:, 1]
        ends.append(np.column_stack([x, y, found.pose[near, 2] + step[:, 2]]))
    off = relative(ends[0], ends[1]) - relations[:, [2, 3, 7]]
    off = off[np.isfinite(off[:, 0])]
    error_m, turn = np.hypot(off[:, 0], off[:, 1]), np.abs(wrapped_angle(off[:, 2]))
    return (
        f"{len(off)} relations, mean {error_m.mean():.3f}, median {np.median(error_m):.3f} m, "
        f"{np.degrees(turn.mean()):.2f} deg"
    )


def mrpt_localized(
    folder: Path, room: OccupancyGrid, start: np.ndarray, model: int, particles: int
) -> tuple[np.ndarray, float]:
    """Poses that pf-localization found, one a scan, and the CPU seconds it took."""
    out = folder / f"pf_{model}_{particles}"
    ini = folder / "pf.ini"
    ini.write_text(
        PF_INI.format(
            particles=particles,
            model=model,
            room=next(folder.glob("*.gridmap*")),
            rawlog=folder / "run.rawlog",
            out=out,
            cell_m=room.frame.resolution_m,
            left=start[0] - 0.5,
            right=start[0] + 0.5,
            bottom=start[1] - 0.5,
            top=start[1] + 0.5,
            right_most=np.degrees(start[2]) - 10.0,
            left_most=np.degrees(start[2]) + 10.0,
        )
    )
    took_s, printed = run(["pf-localization", str(ini)], folder)
    pose = np.array(ESTIMATE.findall(printed), dtype=np.float64).reshape(-1, 3)
    return pose * [1.0, 1.0, np.pi / 180.0], took_s


def mrpt_mapped(folder: Path) -> tuple[np.ndarray, float]:
    """Poses that icp-slam found, one a scan, and the CPU seconds it took."""
    settings = ICP_DEMO.read_text()
    for key, value in {
        "rawlog_file": folder / "run.rawlog",
        "logOutput_dir": folder / "icp",
        "LOG_FREQUENCY": 0,
        "SAVE_3D_SCENE": 0,
        "SAVE_POSE_LOG": 1,
        "SHOW_PROGRESS_3D_REAL_TIME": 0,
    }.items():
        settings = re.sub(rf"(?m)^{key}\s*=.*$", f"{key}={value}", settings)
    ini = folder / "icp.ini"
    ini.write_text(settings)
    took_s, _ = run(["icp-slam", str(ini)], folder)
    table = np.loadtxt(folder / "icp" / "log_estimated_path.txt")
    return table[1::2, 1:], took_s  # a line each for odometry and scan


def read_reference(path: Path) -> Trajectory:
    """A trajectory in TUM's format."""
    table = np.loadtxt(path)
    heading = wrapped_angle(2.0 * np.arctan2(table[:, 6], table[:, 7]))
    time_ns = np.rint(table[:, 0] * 1e9).astype(np.int64)
    pose = np.column_stack([table[:, 1:3], heading])
    return Trajectory(time_ns, pose, np.ones(len(pose), dtype=bool))


def compared(log_path: Path, map_file: Path, truth: Trajectory, relations: np.ndarray) -> None:
    """Prints one line for every program and setting."""
    log = open_log(log_path, Config(), need_audio=False)
    scans, room = list(log.lasers()), read_map(map_file)
    time_ns = np.array([scan.time_ns for scan in scans], dtype=np.int64)
    start = truth.pose[np.abs(truth.time_ns - time_ns[0]).argmin()]
    for _ in range(2):  # the first compiles
        began = process_time()
        found = estimate_trajectory(scans, log.odometry, room, Config().localize)
        own_s = process_time() - began
    own = found.of_scans()
    share = f"{own.usable.mean():.0%} usable"
    error = position_errors(own.pose[own.usable], own.time_ns[own.usable], truth)
    print(f"localized by soundmap, start sought: {error}, {share}; {own_s:.2f} s")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "run.log").write_text(carmen_log(scans, log.odometry))
        run(["carmen2rawlog", "-q", "-w", "-i", "run.log", "-o", "plain.rawlog"], folder)
        plain = gzip.decompress((folder / "plain.rawlog").read_bytes())
        timed = timed_rawlog(plain, time_ns.tolist())
        (folder / "run.rawlog").write_bytes(gzip.compress(timed))
        run(["ros-map-yaml2mrpt", "-q", "-w", "-d", name, "-i", str(map_file.resolve())], folder)
        for setting, (model, particles) in FILTERS.items():
            pose, took_s = mrpt_localized(folder, room, start, model, particles)
            print(
                f"localized by pf-localization, {setting}, start told: "
                f"{position_errors(pose, time_ns, truth)}; {took_s:.2f} s, "
                f"{took_s / own_s:.1f} times as long as soundmap"
            )
        for _ in range(2):
            began = process_time()
            built = build_map(lambda: scans, log.odometry, Config().map)
            own_s = process_time() - began
        error = relation_errors(built.trajectory.of_scans(), log.odometry, relations)
        print(f"mapped by soundmap: {error}; {own_s:.2f} s")
        pose, took_s = mrpt_mapped(folder)
        found = Trajectory(time_ns, pose, np.ones(len(pose), dtype=bool))
        error = relation_errors(found, log.odometry, relations)
        print(
            f"mapped by icp-slam: {error}; {took_s:.2f} s, "
            f"{took_s / own_s:.2f} times as long as soundmap"
        )
        print(f"reference: {relation_errors(truth, log.odometry, relations)}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    for option in ("--log", "--map", "--truth", "--relations"):
        parser.add_argument(option, type=Path, required=True)
    options = parser.parse_args()
    missing = [program for program in PROGRAMS if shutil.which(program) is None]
    if missing:
        raise SystemExit(
            f"skipped: {', '.join(missing)} not found; Debian and Ubuntu have MRPT's programs in "
            "the package mrpt-apps"
        )
    compared(
        options.log,
        options.map,
        read_reference(options.truth),
        np.loadtxt(options.relations, ndmin=2),
    )
