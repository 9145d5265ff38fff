"""Accuracy, robustness and speed of localization.

    python tests/benchmarks/bench_localize.py [--starts 20] [--log LOG --map YAML --truth TUM]

Drives through two scenes are simulated, without sound: from random starts, from any tenth of the
way, with a third of every scan covered, with one scanner, and with odometry that errs, drifts and
sticks. Every line gives the outcome: "right" if all usable poses are within 0.15 m, "cannot tell"
if the program says so, else "WRONG". The corridor looks the same after every quarter turn; its
second set of lines has the start pose.

Two halls of 60 m x 40 m follow, one without a mark and one with doors and a store room, and a
scanner of 30 m that sees a single wall for most of the way: the first looks the same after half a
turn.

With a log and a reference trajectory in its map, the log is localized in the map and, as a strict
test, in a map built from its first 60 %: the whole of it, and its last 40 %. Such a map differs
from the reference itself, as a line says; localization alone shows in a map of the same scans that
is drawn with the reference's poses. Errors are told with and without their constant part: a map may
be drawn up to half a cell beside the walls, and poses are in the frame of the map as drawn. Times
are CPU seconds.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from time import process_time

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parent))

from drive_logs import Drive, drive_through, simulated_drive

from soundmap.config import Config
from soundmap.errors import MapError
from soundmap.evaluate import frame_in_truth
from soundmap.geometry import Trajectory, composed, relative, wrapped_angle
from soundmap.grid import OccupancyGrid
from soundmap.localize.trajectory import estimate_trajectory
from soundmap.logs.robot_log import open_log
from soundmap.losses import LossLedger
from soundmap.map_file import read_map
from soundmap.mapping.geometric_map import build_map
from soundmap.mapping.key_scans import chosen_key_scans
from soundmap.mapping.occupancy import drawn_map
from soundmap.sensors import LaserScan
from soundmap.simulate.scene import Laser, Odometry, Robot, Scene, Wall

SCENES = Path(__file__).parents[2] / "configs" / "scenes"
CONFIG = Config().localize
RIGHT_M = 0.15
RINGS = {
    "corridor": [(1.0, 1.1), (6.9, 1.0), (7.0, 6.9), (1.0, 7.0)],
    "workshop": [(1.0, 1.2), (8.6, 1.2), (8.6, 2.8), (5.2, 2.6), (5.2, 5.6), (1.2, 5.4)],
}
"""Corners of the rounds driven in the scenes [m]."""

HALLS = {
    "plain hall": [(0, 0), (60, 0), (60, 40), (0, 40)],
    "hall with doors": [
        *[(0, 0), (9, 0), (9, -0.4), (10.2, -0.4), (10.2, 0), (41, 0), (41, -0.4), (42.2, -0.4)],
        *[(42.2, 0), (60, 0), (60, 22), (60.3, 22), (60.3, 25), (60, 25), (60, 40), (33, 40)],
        *[(33, 40.4), (31, 40.4), (31, 40), (12, 40), (12, 33), (0, 33)],
    ],
}
HALL_WAYS = {
    "along a wall": [(25, 3), (40, 3), (40, 5), (25, 5)],
    "to a corner": [(28, 3), (56, 3), (56, 20)],
    "in the middle": [(30, 20), (45, 20), (45, 8), (30, 8)],
    "across": [(30, 4), (30, 36)],
    "along the far wall": [(36, 37), (22, 37), (22, 34), (36, 34)],
    "at an angle": [(20, 6), (30, 14), (22, 20), (34, 24)],
}


def hall(outline: str, way: str, seed: int) -> Drive:
    """A drive in a hall with a scanner of 180 degrees."""
    view = {"field_deg": 180.0, "step_deg": 0.5, "rate_hz": 10.0}
    return drive_through(
        Scene(
            name=outline,
            seed=seed,
            walls=(Wall(name=outline, corners_m=tuple(HALLS[outline])),),
            robot=Robot(way_points_m=tuple(HALL_WAYS[way]), speed_m_s=0.8),
            lasers=(Laser(topic="/scan", frame="laser", mount=(0.18, 0.0, 0.3, 0.0), **view),),
            odometry=Odometry(left_scale=1.006, right_scale=0.996, wheelbase_scale=1.02),
        )
    )


def random_way(ring: list[tuple[float, float]], rng: np.random.Generator) -> list[tuple]:
    """A round from anywhere on it, in either direction."""
    count = len(ring)
    first, share = int(rng.integers(count)), rng.uniform(0.15, 0.85)
    here, there = np.array(ring[first]), np.array(ring[(first + 1) % count])
    start = tuple((here + share * (there - here)).tolist())
    ahead = [ring[(first + 1 + k) % count] for k in range(count - 1)]
    behind = [ring[(first - k) % count] for k in range(count - 1)]
    return [start, *(ahead if rng.random() < 0.5 else behind)]


def outcome(drive: Drive, *, told: bool = False) -> str:
    """What came of localizing a drive; whether it is told the start, to 0.15 m and 5 degrees."""
    first = drive.truth.at(drive.scans[0].middle_ns) + np.array([0.1, -0.1, np.radians(5.0)])
    start = tuple(first) if told else None
    began = process_time()
    try:
        found = estimate_trajectory(
            drive.scans, drive.odometry, drive.room, CONFIG, start_pose=start
        )
    except MapError as error:
        return "cannot tell" if "looks alike" in str(error) else f"refused: {error}"[:60]
    took_s = process_time() - began
    off = found.pose - drive.truth.at(found.time_ns)
    known = found.usable & np.isfinite(off[:, 0])
    error_m, turn = np.hypot(off[known, 0], off[known, 1]), np.abs(wrapped_angle(off[known, 2]))
    speed = (found.time_ns[-1] - found.time_ns[0]) * 1e-9 / took_s
    verdict = "right" if error_m.max() < RIGHT_M else "WRONG"
    return (
        f"{verdict}: median {np.median(error_m):.3f}, 95 % {np.quantile(error_m, 0.95):.3f}, "
        f"greatest {error_m.max():.3f} m, heading {np.degrees(turn.mean()):.2f} deg, "
        f"{known.mean():.0%} usable, {speed:.0f} x real time"
    )


def begun_late(drive: Drive, tenth: int) -> Drive:
    """The same drive, recorded from some tenth of its duration on."""
    time_ns = drive.truth.time_ns
    begin = time_ns[0] + tenth * (time_ns[-1] - time_ns[0]) // 10
    return replace(drive, scans=[scan for scan in drive.scans if scan.time_ns >= begin])


def covered(drive: Drive, share: float, seed: int = 0) -> Drive:
    """Obstacles that no map shows before a share of every scan, moving from scan to scan."""
    rng, scans = np.random.default_rng(seed), []
    for scan in drive.scans:
        count = len(scan.range_m)
        hidden = (np.arange(count) + rng.integers(count)) % count < share * count
        near = np.minimum(scan.range_m, rng.uniform(0.4, 1.2))
        scans.append(replace(scan, range_m=np.where(hidden, near, scan.range_m)))
    return replace(drive, scans=scans)


def one_scanner(drive: Drive, scanner: int) -> Drive:
    """The same drive without the other scanner."""
    return replace(drive, scans=[scan for scan in drive.scans if scan.scanner == scanner])


def misreported(
    drive: Drive, *, scale: float = 1.0, turn_per_m: float = 0.0, sticks_s: tuple = (0.0, 0.0)
) -> Drive:
    """Odometry with errors of scale and of turn that sticks for a while."""
    odometry = drive.odometry
    step = relative(odometry.pose[:-1], odometry.pose[1:])
    step[:, 2] += turn_per_m * np.hypot(step[:, 0], step[:, 1])
    step[:, :2] *= scale
    time_s = (odometry.time_ns[1:] - odometry.time_ns[0]) * 1e-9
    step[(time_s > sticks_s[0]) & (time_s < sticks_s[1])] = 0.0
    pose = [np.zeros(3)]
    for each in step:
        pose.append(composed(pose[-1], each))
    return replace(drive, odometry=replace(odometry, pose=np.array(pose)))


def robustness(scene: str, starts: int, *, told: bool) -> None:
    """One line for every way to make it hard."""
    file = SCENES / f"{scene}.toml"
    rng = np.random.default_rng(2026)
    drive = simulated_drive(file)
    outcome(drive, told=told)  # compiles
    hard: dict[str, Drive] = {
        **{
            f"random start {number}": simulated_drive(
                file, random_way(RINGS[scene], rng), seed=100 + number
            )
            for number in range(1, starts + 1)
        },
        **{f"begun after {tenth} tenths": begun_late(drive, tenth) for tenth in range(10)},
        "30 % covered": covered(drive, 0.3),
        "front scanner alone": one_scanner(drive, 0),
        "back scanner alone": one_scanner(drive, 1),
        "5 % and 3 deg/m": misreported(drive, scale=1.05, turn_per_m=np.radians(3.0)),
        "-5 % and -3 deg/m": misreported(drive, scale=0.95, turn_per_m=-np.radians(3.0)),
        "odometry sticks 10 s to 14 s": misreported(drive, sticks_s=(10.0, 14.0)),
        "odometry sticks 20 s to 23 s": misreported(drive, sticks_s=(20.0, 23.0)),
    }
    way = "start told" if told else "start sought"
    for name, each in hard.items():
        print(f"{scene}, {way}, {name}: {outcome(each, told=told)}")


def judged(found: Trajectory, truth: Trajectory) -> str:
    """Errors of the usable poses, what is left less their constant part, and the usable share."""
    found = found.of_scans()
    off = found.pose - truth.at(found.time_ns)
    known = found.usable & np.isfinite(off[:, 0])
    error_m, turn = np.hypot(off[known, 0], off[known, 1]), np.abs(wrapped_angle(off[known, 2]))
    shift = np.median(off[known, :2], axis=0)
    about_m = np.hypot(*(off[known, :2] - shift).T)
    return (
        f"median {np.median(error_m):.3f}, 95 % {np.quantile(error_m, 0.95):.3f}, mean "
        f"{error_m.mean():.3f}, greatest {error_m.max():.2f} m, heading "
        f"{np.degrees(turn.mean()):.2f} deg, {found.usable.mean():.0%} usable; about a constant "
        f"({shift[0]:+.3f}, {shift[1]:+.3f}) m: median {np.median(about_m):.3f}, 95 % "
        f"{np.quantile(about_m, 0.95):.3f} m"
    )


def real_log(path: Path, map_file: Path, truth_file: Path) -> None:
    """A log with a reference trajectory: in its map, and in a map of its first 60 %."""
    table = np.loadtxt(truth_file)
    time_ns = np.rint(table[:, 0] * 1e9).astype(np.int64)
    heading = 2.0 * np.arctan2(table[:, 6], table[:, 7])
    pose = np.column_stack([table[:, 1:3], wrapped_angle(heading)])
    truth = Trajectory(time_ns, pose, np.ones(len(pose), dtype=bool))
    log = open_log(path, Config(), need_audio=False)
    scans, room = list(log.lasers()), read_map(map_file)
    for _ in range(2):  # the first compiles
        began = process_time()
        found = estimate_trajectory(scans, log.odometry, room, CONFIG)
        took_s = process_time() - began
    print(f"{path.name} in its map: {judged(found, truth)}; {took_s:.2f} s of CPU")

    cut = scans[0].time_ns + int(0.6 * (scans[-1].time_ns - scans[0].time_ns))
    begun = [scan for scan in scans if scan.time_ns <= cut]
    rest = [scan for scan in scans if scan.time_ns > cut]
    built = build_map(lambda: begun, log.odometry, Config().map)
    own = built.trajectory.of_scans()
    frame = frame_in_truth(own, truth)
    own = replace(own, pose=composed(frame, own.pose), usable=np.ones(len(own), dtype=bool))
    print(f"first 60 %, mapped: {judged(own, truth)}")
    maps = {
        "a map of the first 60 %": (built.room, frame),
        "one drawn with the reference's poses": (
            drawn_with(truth, begun, log.odometry),
            np.zeros(3),
        ),
    }
    for where, (room, frame) in maps.items():
        for which, part in (("the whole run", scans), ("its last 40 %", rest)):
            found = estimate_trajectory(part, log.odometry, room, CONFIG)
            moved = replace(found, pose=composed(frame, found.pose))
            print(f"{which} in {where}: {judged(moved, truth)}; {lost_stretches(found)}")


def drawn_with(truth: Trajectory, scans: list[LaserScan], odometry: Trajectory) -> OccupancyGrid:
    """A map of the key scans among some scans, from poses that are given."""
    config = Config().map
    keys = chosen_key_scans(
        scans,
        odometry,
        distance_m=config.key_distance_m,
        angle_rad=config.key_angle_rad,
        most_returns=config.returns,
        spacing_m=config.return_spacing_m,
        losses=LossLedger(),
    ).scans
    pose = truth.at(np.array([key.time_ns for key in keys]))
    known = np.flatnonzero(np.isfinite(pose[:, 0]))
    return drawn_map(
        [keys[k] for k in known],
        pose[known],
        cell_m=config.cell_m,
        occupied_share=config.occupied_share,
    )


def lost_stretches(found: Trajectory) -> str:
    """How often and how long the pose was not known, and how often it was found again."""
    usable = found.of_scans().usable.astype(np.int8)
    lost = np.flatnonzero(np.diff(usable) < 0)
    again = np.flatnonzero(np.diff(usable) > 0)
    return f"lost {len(lost)} times, found again {len(again)} times"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--starts", type=int, default=20, help="0: the log alone")
    parser.add_argument("--log", type=Path)
    parser.add_argument("--map", type=Path)
    parser.add_argument("--truth", type=Path)
    options = parser.parse_args()
    if options.log:
        real_log(options.log, options.map, options.truth)
    if options.starts:
        robustness("workshop", options.starts, told=False)
        robustness("corridor", options.starts, told=False)
        robustness("corridor", options.starts, told=True)
        for outline in HALLS:
            for way in HALL_WAYS:
                for seed in (1, 2, 3):
                    print(f"{outline}, {way}, seed {seed}: {outcome(hall(outline, way, seed))}")
