"""From a log to the map of its site, or to the trajectory in a map: what needs no audio."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from time import perf_counter

from soundmap.config import Config
from soundmap.localize.trajectory import estimate_trajectory
from soundmap.logs.robot_log import open_log
from soundmap.map_file import read_map
from soundmap.mapping.geometric_map import MapFacts, build_map
from soundmap.outputs.progress import Progress
from soundmap.run import MapRun


def mapped(log_path: Path, config: Config, *, progress: Progress) -> MapRun:
    """Geometric map and trajectory of one log, from laser scans and odometry alone.

    Parameters
    ----------
    log_path : Path
        An MCAP file or a rosbag2 folder.
    config : Config
    progress : Progress

    Raises
    ------
    SoundmapError
        The log or the configuration does not do.
    """
    timings_s = {}
    began = perf_counter()
    with progress.stage("read"):
        log = open_log(log_path, config, need_audio=False)
    timings_s["read"] = perf_counter() - began
    began = perf_counter()
    with progress.stage("map", 1.0) as stage:
        built = build_map(
            log.lasers, log.odometry, config.map, losses=log.losses, report=stage.advance_to
        )
    timings_s["map"] = perf_counter() - began
    return MapRun(
        log=log_path,
        fingerprint=log.fingerprint,
        config=config,
        room=built.room,
        trajectory=built.trajectory,
        facts=map_facts(built.facts),
        losses=tuple(log.losses),
        counts={
            "laser scanners": len(log.scanners),
            "odometry poses": len(log.odometry),
            "key scans": built.facts.key_scans,
            "loops closed": built.facts.loops_closed,
        },
        timings_s=timings_s,
        duration_s=log.duration_s,
    )


def localized(
    log_path: Path,
    map_path: Path,
    config: Config,
    *,
    start_pose: tuple[float, float, float] | None = None,
    progress: Progress,
) -> MapRun:
    """Trajectory of one log in a given map, as `soundmap.replay.process` finds it.

    Parameters
    ----------
    log_path : Path
        An MCAP file or a rosbag2 folder.
    map_path : Path
        map_server's YAML file.
    config : Config
    start_pose : tuple of float, optional
        x [m], y [m], heading [rad] in the map; without it, it is found in the map.
    progress : Progress

    Raises
    ------
    SoundmapError
        The log, the map or the configuration does not do.
    """
    room = read_map(map_path)
    timings_s = {}
    began = perf_counter()
    with progress.stage("read"):
        log = open_log(log_path, config, need_audio=False)
    timings_s["read"] = perf_counter() - began
    began = perf_counter()
    with progress.stage("localize"):
        trajectory = estimate_trajectory(
            log.lasers(),
            log.odometry,
            room,
            config.localize,
            start_pose=start_pose,
            losses=log.losses,
        )
    timings_s["localize"] = perf_counter() - began
    return MapRun(
        log=log_path,
        fingerprint=log.fingerprint,
        config=config,
        room=room,
        trajectory=trajectory,
        facts={},
        losses=tuple(log.losses),
        counts={
            "laser scanners": len(log.scanners),
            "odometry poses": len(log.odometry),
            "laser scans used": len(trajectory.of_scans()),
        },
        timings_s=timings_s,
        duration_s=log.duration_s,
    )


def map_facts(facts: MapFacts) -> dict[str, float]:
    """How a map came about, by name: what a report holds of it."""
    named = {
        field.name: getattr(facts, field.name)
        for field in dataclasses.fields(facts)
        if field.name != "odometry"
    }
    odometry = dataclasses.asdict(facts.odometry)
    return {**named, **{f"odometry_{name}": value for name, value in odometry.items()}}
