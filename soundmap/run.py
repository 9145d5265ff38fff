"""One run: everything that processing a log yields, before any of it is written."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from soundmap.config import Config
from soundmap.geometry import Trajectory
from soundmap.grid import OccupancyGrid
from soundmap.losses import Loss
from soundmap.sensors import ArrayOffsets
from soundmap.sound import AudioScans, PowerMap, SourceList


@dataclass(frozen=True)
class Run:
    """The results of ``soundmap process`` for one log.

    Attributes
    ----------
    log : Path
        The log as the user named it.
    fingerprint : str
        Identifies the log's content.
    config : Config
        As resolved.
    room : OccupancyGrid
        The geometric map used (Sect. 2.1).
    trajectory : Trajectory
        Base frame in the map frame, one pose a laser scan used (Sect. 2.2).
    scans : AudioScans
        Sect. 2.3.
    power_map : PowerMap
        Sect. 2.4.
    sources : SourceList
        Sects. 2.4 and 4.
    losses : tuple of Loss
        What had to be left out.
    counts : dict
        How much of what was used, by name.
    timings_s : dict
        Wall time of each stage [s].
    duration_s : float
        Time from the first to the last message of the log [s].
    offsets : ArrayOffsets or None
        How far the array's clock and yaw were off; scans and mount are corrected by what was clear.
        None if it was not asked for.
    from_cache : bool
        Whether everything up to the trajectory is what an earlier run has kept.
    """

    log: Path
    fingerprint: str
    config: Config
    room: OccupancyGrid
    trajectory: Trajectory
    scans: AudioScans
    power_map: PowerMap
    sources: SourceList
    losses: tuple[Loss, ...]
    counts: dict[str, int]
    timings_s: dict[str, float]
    duration_s: float
    offsets: ArrayOffsets | None = None
    from_cache: bool = False


@dataclass(frozen=True)
class MapRun:
    """The results of ``soundmap map`` or ``soundmap localize`` for one log.

    Attributes
    ----------
    log : Path
        The log as the user named it.
    fingerprint : str
        Identifies the log's content.
    config : Config
        As resolved.
    room : OccupancyGrid
        The geometric map (Sect. 2.1): built, with its origin at the first pose, or given.
    trajectory : Trajectory
        Base frame in the map frame.
    facts : dict
        How the map came about: loops, residuals, errors of the odometry, by name; empty for a map
        that was given.
    losses : tuple of Loss
        What had to be left out.
    counts : dict
        How much of what was used, by name.
    timings_s : dict
        Wall time of each stage [s].
    duration_s : float
        Time from the first to the last message of the log [s].
    """

    log: Path
    fingerprint: str
    config: Config
    room: OccupancyGrid
    trajectory: Trajectory
    facts: dict[str, float]
    losses: tuple[Loss, ...]
    counts: dict[str, int]
    timings_s: dict[str, float]
    duration_s: float
