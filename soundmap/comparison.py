"""Two finished runs compared: what appeared, went, got louder or quieter from one to the other."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from soundmap.change import Change, ChangeKind, PowerRatio
from soundmap.config import DetectConfig, DiffConfig
from soundmap.detect.difference import (
    CellLevels,
    cell_levels,
    chance,
    changed_cells,
    power_ratio,
    seen_from_the_other_side,
)
from soundmap.detect.place_levels import PlaceLevels, images_apart, place_levels
from soundmap.detect.source_changes import matched_sources, paired_places, source_changes
from soundmap.errors import OutputError
from soundmap.geometry import FloatArray, inverted, transformed
from soundmap.grid import OccupancyGrid
from soundmap.losses import Loss, LossLedger
from soundmap.map_file import read_map
from soundmap.mapping.map_match import matched_maps
from soundmap.outputs.stored_run import read_power_map, read_run, tells_of_sources
from soundmap.run import Run
from soundmap.sensors import MicArray
from soundmap.sound import PowerMap, SourceList

STAGE = "diff"


@dataclass(frozen=True)
class Comparison:
    """The results of ``soundmap diff``.

    Attributes
    ----------
    ratio : PowerRatio
    room : OccupancyGrid
        The geometric map of the run.
    run, background : Path
        The two run folders.
    notes : tuple of Loss
        Why the two may not compare like with like.
    """

    ratio: PowerRatio
    room: OccupancyGrid
    run: Path
    background: Path
    notes: tuple[Loss, ...]


def compared(run: Path, background: Path, diff: DiffConfig, detect: DetectConfig) -> Comparison:
    """Difference in dB of the power maps of two run folders, Sect. 4, and of their sources.

    Where both runs have sources of a fit, the changes are those of sources; otherwise they are
    local extrema of the difference of the maps, as in the paper.

    Raises
    ------
    SoundmapError
        One of them is no run folder, or the two cannot be compared.
    """
    loud, loud_share = read_power_map(run)
    quiet, quiet_share = read_power_map(background)
    if loud.reference != quiet.reference:
        raise OutputError(
            f"{run} is in {loud.reference}, {background} in {quiet.reference}: process both with "
            "the same pascal_per_count."
        )
    if not quiet.visits.any():
        raise OutputError(f"{background}: the power map holds no measurement to compare with.")
    room, other_room = read_map(run / "map.yaml"), read_map(background / "map.yaml")
    notes = LossLedger()
    pose = _pose_of_background(room, other_room, notes)
    if (loud.is_limit is None) != (quiet.is_limit is None):
        what = "the power maps of the two runs were made by different methods"
        notes.remark(what, STAGE, effect="the levels of their cells cannot be compared")
    here = cell_levels(loud, min_visit_share=loud_share)
    there = cell_levels(quiet, min_visit_share=quiet_share)
    ratio, measured = power_ratio(here, loud.frame, there, quiet.frame, inverted(pose))
    if tells_of_sources(run) and tells_of_sources(background):
        changes = _changes_of_sources(read_run(run), read_run(background), pose, diff)
    else:
        changes = _changes_of_cells(loud, here, quiet, there, pose, diff, detect)
    scatter_known = loud.square_sum is not None and quiet.square_sum is not None
    return Comparison(
        PowerRatio(
            loud.frame,
            ratio.level_db,
            loud.visits,
            measured,
            _ordered(changes),
            chance(ratio) if scatter_known else None,
        ),
        room,
        run,
        background,
        tuple(notes),
    )


def _pose_of_background(room: OccupancyGrid, other: OccupancyGrid, notes: LossLedger) -> FloatArray:
    """Pose of the background's map frame in that of the run, from the walls of both maps."""
    if room.frame == other.frame and np.array_equal(room.occupied, other.occupied):
        return np.zeros(3)
    match = matched_maps(room, other)
    what = "the two runs were made in different maps"
    if match is None:
        effect = "compared as if both had one origin; process both with one --map"
        notes.remark(what + ", which cannot be laid on each other", STAGE, effect=effect)
        return np.zeros(3)
    x, y, turn = match.pose.tolist()
    effect = (
        f"background moved by {x:z.2f}, {y:z.2f} m and turned by {np.degrees(turn):z.1f} degrees: "
        f"{100 * match.agreeing:.0f} % of the walls agree"
    )
    notes.remark(what, STAGE, effect=effect)
    return match.pose


def _changes_of_sources(
    run: Run, background: Run, pose: FloatArray, diff: DiffConfig
) -> tuple[Change, ...]:
    others = _moved(background.sources, pose)
    pairs = matched_sources(run.sources, others)
    here_m, there_m = paired_places(pairs, run.sources, others)
    images_m = images_apart([run.sources, others], here_m)
    visits = [
        run.sources.sources[i].visits if i is not None else _visits(run.power_map, place_m)
        for (i, _), place_m in zip(pairs, here_m, strict=True)
    ]
    back = inverted(pose)
    return source_changes(
        pairs,
        here_m,
        visits,
        _levels(run, here_m, images_m),
        _levels(background, transformed(back, there_m), transformed(back, images_m)),
        diff,
    )


def _moved(sources: SourceList, pose: FloatArray) -> SourceList:
    """Sources and mirror images of a frame, in the frame in which it has a pose."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[cos, -sin], [sin, cos]])
    moved = []
    for source in sources:
        x, y = transformed(pose, (source.x_m, source.y_m)).tolist()
        fit = source.fit
        if fit is not None:
            fit = replace(fit, covariance_m2=turn @ fit.covariance_m2 @ turn.T)
        moved.append(replace(source, x_m=x, y_m=y, fit=fit))
    images = []
    for image in sources.reflections:
        x, y = transformed(pose, (image.x_m, image.y_m)).tolist()
        images.append(replace(image, x_m=x, y_m=y))
    return replace(sources, sources=tuple(moved), reflections=tuple(images))


def _changes_of_cells(
    loud: PowerMap,
    here: CellLevels,
    quiet: PowerMap,
    there: CellLevels,
    pose: FloatArray,
    diff: DiffConfig,
    detect: DetectConfig,
) -> tuple[Change, ...]:
    """Maxima of the ratio, and of that the other way round, which are what got quieter."""
    separation_m, least_db = detect.separation_m, diff.min_ratio_db
    changes: list[Change] = []
    back = inverted(pose)
    for one, its, other, others, seen_from in (
        (loud, here, quiet, there, back),
        (quiet, there, loud, here, pose),
    ):
        if np.isnan(others.level_db).all():
            continue
        ratio, measured = power_ratio(its, one.frame, others, other.frame, seen_from)
        found = changed_cells(
            ratio,
            one.visits,
            measured,
            one.frame,
            separation_m=separation_m,
            min_ratio_db=least_db,
        )
        changes += (
            found if one is loud else [seen_from_the_other_side(each, pose) for each in found]
        )
    return tuple(changes)


def _levels(run: Run, places_m: FloatArray, images_m: FloatArray) -> PlaceLevels:
    if run.scans.mount is None:
        raise ValueError("the run does not tell where its array was")
    array = MicArray(run.config.array.microphone_positions(), run.scans.mount, None)
    return place_levels(
        places_m,
        run.scans,
        run.trajectory,
        array,
        run.room,
        run.config.scan,
        images_m=images_m,
    )


def _ordered(changes: tuple[Change, ...]) -> tuple[Change, ...]:
    """Louder ones first, then quieter ones, the greatest first; then the rest."""

    def rank(change: Change) -> tuple[int, float]:
        if change.kind.is_louder:
            return 0, -change.ratio_db
        if change.kind.is_quieter:
            return 1, change.ratio_db
        return 2 + (change.kind == ChangeKind.UNTOLD), -change.ratio_db

    return tuple(sorted(changes, key=rank))


def _visits(power_map: PowerMap, place_m: FloatArray) -> int:
    cell = power_map.frame.cells(place_m)
    return int(power_map.visits[tuple(cell)]) if power_map.frame.contains(cell) else 0
