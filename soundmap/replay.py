"""The whole pipeline on one page: log, localize, scan, calibrate, fuse, detect."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numba
import numpy as np
from numpy.typing import NDArray

from soundmap.calibrate.calibration import array_offsets
from soundmap.calibrate.joining import joined_offsets
from soundmap.config import Config, ScanConfig
from soundmap.detect.evidence import Evidence, gathered_evidence, ranged_scans, velocities
from soundmap.detect.fitted_sources import fitted_sources
from soundmap.detect.offset_fit import offsets_by_fit
from soundmap.detect.place_levels import with_level_errors
from soundmap.detect.source_list import detect_sources
from soundmap.errors import ConfigError, NothingUsableError
from soundmap.fuse.accumulate import PowerAccumulator
from soundmap.fuse.bearing_range import ranges_around
from soundmap.fuse.fitted_map import fitted_power_map, mapped_scans
from soundmap.fuse.power_map import fused_scans, level_reference, power_map_frame
from soundmap.fuse.surroundings import SurroundingsGatherer
from soundmap.geometry import FloatArray, Trajectory
from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.localize.trajectory import localized
from soundmap.localize.views import ViewChooser
from soundmap.logs.log_files import log_files
from soundmap.logs.reader import McapLog
from soundmap.logs.robot_log import RobotLog, open_log
from soundmap.losses import LossLedger
from soundmap.map_file import read_map
from soundmap.mapping.geometric_map import BuiltMap, build_map
from soundmap.measured import Measured, MeasuredCache, measured_key
from soundmap.memory import give_back, hold_little
from soundmap.outputs.progress import Progress, Stage
from soundmap.run import Run
from soundmap.scan.audio_scan import audio_scans, kept_scans
from soundmap.scan.spectrum import band_bins
from soundmap.sensors import ArrayOffsets, AudioBlock, LaserScan, MicArray
from soundmap.sound import AudioScans, PowerMap, SourceList
from soundmap.surroundings import NO_SURROUNDINGS, Surroundings

MOST_THREADS = 4
"""Threads that turn sound into audio scans; they keep up with any reading of the log."""
GIVE_BACK_NS = 300_000_000_000
"""Time of the log after which holes are given back that growing results have left."""
LEAST_EXTENT_M = 0.5
"""A robot that stays within this cannot tell where sound comes from, only from which side [m]."""


def process(
    log_path: Path,
    map_path: Path | None,
    config: Config,
    *,
    start_pose: tuple[float, float, float] | None = None,
    cache: MeasuredCache | None = None,
    heard: Callable[[AudioScans, Trajectory], None] | None = None,
    progress: Progress,
) -> Run:
    """Sources, power map and trajectory of one log.

    Parameters
    ----------
    log_path : Path
        An MCAP file or a rosbag2 folder.
    map_path : Path or None
        map_server's YAML file of the geometric map; without it, the map is built from the log, and
        its origin is the first pose.
    config : Config
    start_pose : tuple of float, optional
        x [m], y [m], heading [rad] in the given map; without it, it is found in the map.
    cache : MeasuredCache, optional
        Where the results of the slow stages are kept, and taken from if they are there.
    heard : callable, optional
        Is told the audio scans and the trajectory as soon as they are known for good.
    progress : Progress

    Raises
    ------
    SoundmapError
        The log, the map or the configuration does not do.
    """
    hold_little()
    given = None if map_path is None else read_map(map_path)
    clock = _Stopwatch(progress)
    measured, from_cache = _kept_or_measured(log_path, given, config, start_pose, cache, clock)
    room, trajectory, losses = measured.room, measured.trajectory, LossLedger()
    with clock.stage("calibrate"):
        by_peaks = offsets_by_peaks(measured.scans, trajectory, measured.array, config)
        measured = replace(measured, scans=replace(measured.scans, sharp=None))
        measured, offsets = _calibrated(measured, by_peaks, config)
    scans = measured.scans
    if heard is not None:
        heard(scans, trajectory)
    with clock.stage("fuse"):
        power_map, fused = _fused(measured, config, losses)
        around = _around(measured, config) if config.detect.method == "sparse" else None
        measured = replace(measured, surroundings=NO_SURROUNDINGS)
    with clock.stage("detect"):
        if around is not None:
            sources, power_map = _fitted(measured, around, power_map.frame, config, losses)
        else:
            sources = detect_sources(power_map, config.detect)
    return Run(
        log=log_path,
        fingerprint=measured.fingerprint,
        config=config,
        room=room,
        trajectory=trajectory,
        scans=scans,
        power_map=power_map,
        sources=sources,
        losses=(*measured.losses, *losses),
        counts={
            "laser scanners": measured.scanners,
            "odometry poses": measured.odometry_poses,
            "laser scans used": len(trajectory.of_scans()),
            "audio scans": len(scans),
            "audio scans fused": fused,
        },
        timings_s=clock.timings_s,
        duration_s=measured.duration_s,
        offsets=offsets,
        from_cache=from_cache,
    )


def _calibrated(
    measured: Measured, by_peaks: ArrayOffsets | None, config: Config
) -> tuple[Measured, ArrayOffsets | None]:
    """The same with clock and yaw corrected where they are clearly off, and by how much."""
    if by_peaks is None:
        return measured, None
    scans, array = measured.scans, measured.array
    where = measured.surroundings, measured.trajectory, array
    found = refined_offsets(by_peaks, scans, *where, config)
    mount = array.mount.turned(found.yaw.correction)
    time_ns = scans.time_ns + round(found.clock.correction * 1e9)
    scans = replace(scans, time_ns=time_ns, mount=mount)
    return replace(measured, scans=scans, array=replace(array, mount=mount)), found


def offsets_by_peaks(
    scans: AudioScans, trajectory: Trajectory, array: MicArray, config: Config
) -> ArrayOffsets | None:
    """What the array's clock and yaw lack, by the bearings of peaks alone.

    Parameters
    ----------
    scans : AudioScans
        Without sharp power the array is not asked about.
    trajectory : Trajectory
    array : MicArray
        With its mount as believed.
    config : Config
    """
    if scans.sharp is None:
        return None
    return array_offsets(
        scans.sharp, scans.time_ns, trajectory, array, config.scan, config.calibrate
    )


def refined_offsets(
    by_peaks: ArrayOffsets,
    scans: AudioScans,
    surroundings: Surroundings,
    trajectory: Trajectory,
    array: MicArray,
    config: Config,
) -> ArrayOffsets:
    """The same by the sparse fit to all that was heard, from where the peaks have them.

    Parameters
    ----------
    by_peaks : ArrayOffsets
    scans : AudioScans
    surroundings : Surroundings
    trajectory : Trajectory
    array : MicArray
        With its mount as believed.
    config : Config
    """
    start = np.array(by_peaks.guess or (by_peaks.clock.value, by_peaks.yaw.value))
    if not np.isfinite(start).all():
        return by_peaks
    scan = config.scan

    def heard_at(clock_s: float, yaw_rad: float) -> tuple[Evidence, FloatArray]:
        turned = replace(array, mount=array.mount.turned(yaw_rad))
        stamped = replace(scans, time_ns=scans.time_ns + round(clock_s * 1e9))
        wanted = ranged_scans(stamped, trajectory, turned, scan)
        around = ranges_around(surroundings, trajectory, stamped.time_ns, turned.mount, wanted)
        evidence = gathered_evidence(stamped, around, trajectory, turned, scan)
        return evidence, velocities(stamped, trajectory, turned, scan)

    give_back()
    by_fit = offsets_by_fit(start, heard_at)
    if by_fit is None:
        return by_peaks
    told = by_fit.state, by_fit.covariance, by_fit.explained
    bearings = scans.power.shape[1]
    return joined_offsets(by_peaks, told, array, scan, config.calibrate, bearings=bearings)


def _fused(measured: Measured, config: Config, losses: LossLedger) -> tuple[PowerMap, int]:
    """The power map by Eqs. (3)-(5), and how many audio scans are in it."""
    array = measured.array
    frame = power_map_frame(measured.room, config.fuse.cell_m)
    accumulator = PowerAccumulator(frame, level_reference(array.pascal_per_count))
    fused = fused_scans(
        measured.scans,
        measured.surroundings,
        measured.trajectory,
        accumulator,
        array.mount,
        config.fuse,
        losses=losses,
    )
    count = sum(scan.point_m is not None for scan in fused)
    return accumulator.power_map(), count


def _around(measured: Measured, config: Config) -> NDArray[np.float32]:
    """Laser ranges around the array at those scans that the fit and its map look at."""
    scans, trajectory, array = measured.scans, measured.trajectory, measured.array
    wanted = np.union1d(
        ranged_scans(scans, trajectory, array, config.scan), mapped_scans(scans, trajectory)
    )
    return ranges_around(measured.surroundings, trajectory, scans.time_ns, array.mount, wanted)


def _fitted(
    measured: Measured,
    around: NDArray[np.float32],
    frame: GridFrame,
    config: Config,
    losses: LossLedger,
) -> tuple[SourceList, PowerMap]:
    """Sources of the fit to all scans, and the power map that goes with them."""
    room, trajectory = measured.room, measured.trajectory
    scans, array = measured.scans, measured.array
    if trajectory.extent_m() < LEAST_EXTENT_M:
        losses.remark(
            "robot hardly moves",
            "detect",
            effect="from one place bearings do not cross: hardly a source can be told",
        )
    sources = fitted_sources(
        scans, around, trajectory, array, config.scan, config.detect, room=room
    )
    sources = with_level_errors(sources, scans, trajectory, array, room, config.scan)
    power_map = fitted_power_map(
        sources, scans, around, trajectory, array, frame, config.scan, config.fuse
    )
    return sources, power_map


def _kept_or_measured(
    log_path: Path,
    given: OccupancyGrid | None,
    config: Config,
    start_pose: tuple[float, float, float] | None,
    cache: MeasuredCache | None,
    clock: _Stopwatch,
) -> tuple[Measured, bool]:
    """What the slow stages yield, and whether it comes from an earlier run."""
    if cache is None:
        return _measured(log_path, given, config, start_pose, clock), False
    with clock.stage("earlier run"):
        files = log_files(log_path)
        fingerprint = McapLog(log_path, files, LossLedger()).fingerprint()
        key = measured_key(files, fingerprint, config, given, start_pose)
        kept = cache.get(key)
    if kept is not None:
        return kept, True
    measured = _measured(log_path, given, config, start_pose, clock)
    if measured.fingerprint == fingerprint:  # else the log has changed in the meantime
        cache.put(key, measured)
    return measured, False


def _measured(
    log_path: Path,
    given: OccupancyGrid | None,
    config: Config,
    start_pose: tuple[float, float, float] | None,
    clock: _Stopwatch,
) -> Measured:
    """One pass over the log: audio scans and surroundings; and the trajectory in the map."""
    with clock.stage("read"):
        log = open_log(log_path, config)
    losses, odometry = log.losses, log.odometry
    with losses.told_with_errors():
        if log.array is None:
            raise ValueError("the log was opened without audio")
        array, scanners = log.array, len(log.scanners)
        fingerprint, duration_s = log.fingerprint, log.duration_s
        _check_band(log, config.scan)
        built = _built_map(log, config, clock) if given is None else None
        gatherer = SurroundingsGatherer(odometry)
        chooser = ViewChooser(odometry, config.localize, losses)
        watchers = [gatherer.see] if built is not None else [gatherer.see, chooser.see]
        scans = _heard(log, array, watchers, config, clock)
        del log  # with the times of all its messages
        give_back(with_cycles=True)
        surroundings = gatherer.gathered()
        if built is not None:
            room, trajectory = built.room, built.trajectory
        elif given is not None:
            with clock.stage("localize"):
                room, views = given, chooser.views()
                trajectory = localized(
                    views, odometry, room, config.localize, start_pose=start_pose, losses=losses
                )
    return Measured(
        room=room,
        trajectory=trajectory,
        scans=scans,
        surroundings=surroundings,
        array=array,
        losses=tuple(losses),
        scanners=scanners,
        odometry_poses=len(odometry),
        fingerprint=fingerprint,
        duration_s=duration_s,
    )


def _heard(
    log: RobotLog,
    array: MicArray,
    watchers: Sequence[Callable[[LaserScan], None]],
    config: Config,
    clock: _Stopwatch,
) -> AudioScans:
    """All audio scans of the log, whose laser scans are shown to the watchers."""
    with clock.stage("scan", log.duration_s) as stage:
        blocks = _audio_of(_watched(log, stage), watchers)
        scans = kept_scans(
            audio_scans(
                blocks,
                array,
                config.scan,
                losses=log.losses,
                threads=min(numba.get_num_threads(), MOST_THREADS),
                sharp=config.calibrate.mode != "off",
            ),
            level_reference(array.pascal_per_count),
            array.mount,
            config.scan.sub_band_hz,
        )
    if not len(scans):
        raise NothingUsableError(
            f"{log.path}: the audio is too short or too broken for one audio scan of "
            f"{config.scan.frames} windows."
        )
    return scans


def _built_map(log: RobotLog, config: Config, clock: _Stopwatch) -> BuiltMap:
    with clock.stage("map", 1.0) as stage:
        return build_map(
            log.lasers, log.odometry, config.map, losses=log.losses, report=stage.advance_to
        )


def _check_band(log: RobotLog, scan: ScanConfig) -> None:
    """The band must be one that the log's sample rate holds."""
    window = round(scan.window_s * log.sample_rate_hz)
    try:
        band_bins(log.sample_rate_hz, window, low_hz=scan.low_hz, high_hz=scan.high_hz)
    except ValueError as error:
        raise ConfigError(f"{log.path}: {error} in [scan].") from None


def _audio_of(
    measured: Iterable[AudioBlock | LaserScan], watchers: Sequence[Callable[[LaserScan], None]]
) -> Iterator[AudioBlock]:
    """The audio among what was measured; laser scans are shown to the watchers as they come by."""
    for item in measured:
        if isinstance(item, LaserScan):
            for see in watchers:
                see(item)
        else:
            yield item


class _Stopwatch:
    """Times the stages while it shows their progress."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self.timings_s: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str, total_s: float | None = None) -> Iterator[Stage]:
        began = perf_counter()
        with self._progress.stage(name, total_s) as stage:
            yield stage
        give_back()
        self.timings_s[name] = perf_counter() - began


def _watched(log: RobotLog, stage: Stage) -> Iterator[AudioBlock | LaserScan]:
    """What was measured, with the progress reported once a second of the log."""
    start_ns = reported_ns = given_back_ns = int(log.odometry.time_ns[0])
    for item in log.measurements():
        if item.time_ns - reported_ns > 1_000_000_000:
            stage.advance_to((item.time_ns - start_ns) * 1e-9)
            reported_ns = item.time_ns
        if item.time_ns - given_back_ns > GIVE_BACK_NS:
            give_back()
            given_back_ns = item.time_ns
        yield item
