"""Speed and accuracy of map building, and how its cost grows with the way driven.

    python tests/benchmarks/bench_mapping.py [LOG [RELATIONS]]

Without a log, only drives through a room with exact geometry are mapped: once round, twice, four
and eight times round. With a log (MCAP file or rosbag2 folder), it is mapped as well, and with a
file of relations (Kuemmerle et al. 2009; t1 t2 x y z roll pitch yaw) the error of its trajectory
is given. Where MRPT's icp-slam is installed (Debian: mrpt-apps), convert the log to its rawlog
format and time that program on the same machine to compare.
"""

from __future__ import annotations

import os
import platform
import sys
from pathlib import Path
from time import process_time

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from soundmap.config import Config, MappingConfig
from soundmap.geometry import relative
from soundmap.logs.robot_log import open_log
from soundmap.mapping.geometric_map import BuiltMap, build_map
from tests import worlds
from tests.mapping import drives

ROUND = [(1, 1), (6, 1), (6, 2.4), (3.5, 2.6), (3.5, 4.2), (1, 4.2)]


def grown() -> None:
    """Time and error over ever longer drives through one room, and the exponent of the growth."""
    print(
        f"{'way [m]':>8} {'key scans':>9} {'time [s]':>8} {'x real time':>11} {'median [mm]':>11}"
    )
    sizes, times = [], []
    for rounds in (1, 1, 2, 4, 8):  # the first compiles
        truth = worlds.driven(ROUND * rounds)
        scans = worlds.laser_scans(truth, [worlds.FRONT, worlds.BACK], rate_hz=10, beams=541)
        scans = drives.noisy(scans, 0.015)
        odometry = drives.reported(truth, scale=1.03, turn_per_metre=0.03)
        began = process_time()
        built = build_map(lambda scans=scans: scans, odometry, MappingConfig())
        took = process_time() - began
        true = drives.from_first(truth, built.trajectory.time_ns)
        error = np.median(drives.errors(built.trajectory.pose, true)[0])
        duration = (truth.time_ns[-1] - truth.time_ns[0]) * 1e-9
        print(
            f"{truth.driven_m()[-1]:8.1f} {built.facts.key_scans:9d} {took:8.2f} "
            f"{duration / took:11.1f} {1e3 * error:11.1f}"
        )
        sizes.append(built.facts.key_scans)
        times.append(took)
    exponent = np.polyfit(np.log(sizes[1:]), np.log(times[1:]), 1)[0]
    print(f"time grows with key scans to the power of {exponent:.2f}")


def relation_errors(built: BuiltMap, relations: Path) -> np.ndarray:
    """Distance between each relation and what the trajectory says of it [m]."""
    table = np.loadtxt(relations)
    time_ns = built.trajectory.time_ns
    moments = np.clip((table[:, :2] * 1e9).astype(np.int64), time_ns[0], time_ns[-1])
    found = relative(built.trajectory.at(moments[:, 0]), built.trajectory.at(moments[:, 1]))
    return np.hypot(found[:, 0] - table[:, 2], found[:, 1] - table[:, 3])


def mapped(path: Path, relations: Path | None) -> None:
    """Time, and error if relations are given, for one log."""
    began = process_time()
    log = open_log(path, Config(), need_audio=False)
    built = build_map(log.lasers, log.odometry, Config().map)
    took = process_time() - began
    facts = built.facts
    print(
        f"{path.name}: {log.duration_s:.0f} s of log, {facts.key_scans} key scans in {took:.1f} s, "
        f"{log.duration_s / took:.1f} x real time; {facts.loops_closed} loops, pairs of scans "
        f"within {1e3 * facts.residual_m:.1f} mm"
    )
    if relations is not None:
        error = relation_errors(built, relations)
        print(
            f"relation error {error.mean():.3f} +- {error.std():.3f} m, "
            f"median {np.median(error):.3f} m, {len(error)} relations"
        )


if __name__ == "__main__":
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}")
    grown()
    if len(sys.argv) > 1:
        mapped(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None)
