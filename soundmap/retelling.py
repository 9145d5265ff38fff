"""A finished run told once more, with its log beside it, for whoever wants to watch it unfold.

The audio scans are kept with the run, so the sound need not be analysed again; laser scans are
read, and fused with the scans as in `soundmap.replay`.
"""

from __future__ import annotations

import secrets
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np
from scipy.ndimage import distance_transform_edt

from soundmap.deskew import deskewed_rays
from soundmap.errors import OutputError, SoundmapError
from soundmap.fuse.accumulate import PowerAccumulator
from soundmap.fuse.power_map import fused_scans
from soundmap.fuse.surroundings import SurroundingsGatherer
from soundmap.geometry import FloatArray, transformed
from soundmap.grid import OccupancyGrid
from soundmap.logs.robot_log import RobotLog, open_log
from soundmap.losses import LossLedger
from soundmap.memory import give_back
from soundmap.outputs.new_folder import writing
from soundmap.outputs.progress import Progress
from soundmap.outputs.recording import (
    RunRecording,
    run_recording,
    write_difference_recording,
)
from soundmap.outputs.stored_run import POWER_RATIO, read_difference, read_run
from soundmap.run import Run
from soundmap.sensors import LaserScan
from soundmap.surroundings import Surroundings

RUN_FILE, DIFFERENCE_FILE = "run.rrd", "diff.rrd"
LASER_INTERVAL_NS = 200_000_000
RAYS_A_SCAN = 540
ON_WALL_M = 0.15
POWER_MAP_BYTES_PER_S = 200_000
LEAST_MAPS, MOST_MAPS = 2, 120


def recording_of(folder: Path, *, progress: Progress) -> tuple[Path, str | None]:
    """The recording of a run folder or a diff folder, which is made if it is missing.

    Returns
    -------
    file : Path
    remark : str or None
        What a person should know about it.

    Raises
    ------
    SoundmapError
        Neither kind of folder, or a damaged one, or it cannot be written to.
    """
    is_difference = (folder / POWER_RATIO).is_file()
    file = folder / (DIFFERENCE_FILE if is_difference else RUN_FILE)
    if file.is_file():
        return file, None
    partial = folder / f".{file.name}.partial-{secrets.token_hex(4)}"
    remark = None
    with writing(folder), progress.stage("record"):
        try:
            if is_difference:
                write_difference_recording(read_difference(folder), partial)
            else:
                remark = write_recording(read_run(folder), partial)
            partial.replace(file)
        finally:
            partial.unlink(missing_ok=True)
    return file, remark


def recorded(run: Run, folder: Path, *, progress: Progress) -> Run:
    """The same run with the time that its recording took, which now lies in the folder."""
    began = perf_counter()
    with writing(folder), progress.stage("record"):
        write_recording(run, folder / RUN_FILE)
    return replace(run, timings_s={**run.timings_s, "record": perf_counter() - began})


def write_recording(run: Run, file: Path) -> str | None:
    """Write a run as a Rerun recording, with what its log tells if the log is still there.

    Returns
    -------
    str or None
        Why the log could not be used; None if it was.
    """
    log: RobotLog | None = None
    why: str | None = None
    try:
        log = _unchanged_log(run)
        give_back(with_cycles=True)
    except SoundmapError as error:
        why = f"{error} The recording shows neither laser points nor how the power map grew."
    with run_recording(run, file) as drawn:
        if log is not None:
            surroundings = _tell_lasers(log, run, drawn)
            del log
            _tell_fusion(surroundings, run, drawn)
    return why


def _unchanged_log(run: Run) -> RobotLog:
    if not run.log.exists():
        raise OutputError(f"{run.log}: the log is no longer there.")
    log = open_log(run.log, run.config)
    if log.fingerprint != run.fingerprint:
        raise OutputError(f"{run.log}: the log is not the one that this run was made of.")
    return log


def _tell_lasers(log: RobotLog, run: Run, drawn: RunRecording) -> Surroundings:
    """Some laser scans of each scanner, and how well they lie on the map's walls.

    What all of them saw around the robot is gathered on the way.
    """
    wall = _WallDistance(run.room)
    gatherer = SurroundingsGatherer(log.odometry)
    shown_ns: dict[int, int] = {}
    for scan in log.lasers():
        gatherer.see(scan)
        time_ns = scan.middle_ns
        if time_ns - shown_ns.get(scan.scanner, time_ns - LASER_INTERVAL_NS) < LASER_INTERVAL_NS:
            continue
        points = _in_map(scan, run, time_ns)
        if len(points) == 0:
            continue
        shown_ns[scan.scanner] = time_ns
        drawn.add_laser(time_ns, scan.scanner, points, wall.share_near(points))
    return gatherer.gathered()


def _tell_fusion(surroundings: Surroundings, run: Run, drawn: RunRecording) -> None:
    """Which bearing was chosen at each scan, and the power map as it grew."""
    mount = run.scans.mount
    if mount is None or len(run.scans) == 0:
        return
    accumulator = PowerAccumulator(run.power_map.frame, run.power_map.reference)
    span_ns = int(run.scans.time_ns[-1] - run.scans.time_ns[0])
    affordable = POWER_MAP_BYTES_PER_S * span_ns * 1e-9 / max(drawn.power_map_bytes, 1)
    step_ns = span_ns / np.clip(affordable, LEAST_MAPS, MOST_MAPS)
    due_ns = float(run.scans.time_ns[0])
    fused = fused_scans(
        run.scans,
        surroundings,
        run.trajectory,
        accumulator,
        mount,
        run.config.fuse,
        losses=LossLedger(),
    )
    for scan in fused:
        if scan.point_m is not None:
            array_m = transformed(scan.pose, mount.translation_m[:2])
            drawn.add_hit(scan.time_ns, array_m, scan.point_m)
        if scan.time_ns >= due_ns:
            drawn.add_power_map(scan.time_ns, accumulator.power_map())
            due_ns += step_ns
    drawn.add_power_map(int(run.scans.time_ns[-1]), run.power_map)


def _in_map(scan: LaserScan, run: Run, time_ns: int) -> FloatArray:
    """Points of a scan in the map frame, shape (P, 2); none where the pose is not known."""
    pose = run.trajectory.at(time_ns)
    if not np.isfinite(pose).all():
        return np.zeros((0, 2))
    return transformed(pose, deskewed_rays(scan, run.trajectory, time_ns, most=RAYS_A_SCAN).end_m)


class _WallDistance:
    """How far places are from the nearest wall of the map."""

    def __init__(self, room: OccupancyGrid) -> None:
        self._frame = room.frame
        self._distance_m = distance_transform_edt(~room.occupied) * room.frame.resolution_m

    def share_near(self, points_m: FloatArray) -> float:
        """Share of points within `ON_WALL_M` of a wall; beyond the map there is none."""
        cells = self._frame.cells(points_m)
        inside = self._frame.contains(cells)
        row, column = cells[inside].T
        return float(np.sum(self._distance_m[row, column] <= ON_WALL_M) / len(points_m))
