"""Evaluation: how near to the truth a run came. Table 2."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from soundmap.errors import LogError
from soundmap.geometry import FloatArray, Trajectory, composed, transformed, wrapped_angle

if TYPE_CHECKING:
    from rich.console import RenderableType

MATCH_M = 0.5
"""A source counts as detected when something was found within this distance."""
SHOWN_NAMES = 8


@dataclass(frozen=True)
class Place:
    """A source where it is, or where it was found.

    Attributes
    ----------
    id : str
    x_m, y_m : float
        In the map frame.
    """

    id: str
    x_m: float
    y_m: float


@dataclass(frozen=True)
class Match:
    """One true source and what became of it.

    Attributes
    ----------
    id : str
        Of the true source.
    found : str or None
        The row of the run that it was matched with; None if it was missed.
    error_m : float or None
        Distance between the two.
    """

    id: str
    found: str | None
    error_m: float | None


@dataclass(frozen=True)
class TrajectoryError:
    """How far the estimated poses are from the true ones at the same times.

    Attributes
    ----------
    poses : int
        How many were compared.
    median_m, p95_m : float
        Of the distances.
    heading_mean_deg : float
        Mean absolute difference of the headings.
    """

    poses: int
    median_m: float
    p95_m: float
    heading_mean_deg: float


@dataclass(frozen=True)
class Evaluation:
    """A run against its truth.

    Attributes
    ----------
    run : str
    matches : tuple of Match
        One a true source, in the order of the truth.
    false_alarms : tuple of str
        Rows of the run that match no source.
    trajectory : TrajectoryError or None
        None if there is no true trajectory to compare with.
    """

    run: str
    matches: tuple[Match, ...]
    false_alarms: tuple[str, ...]
    trajectory: TrajectoryError | None

    @property
    def errors_m(self) -> list[float]:
        """Errors of the detected sources [m]."""
        return [match.error_m for match in self.matches if match.error_m is not None]

    def as_dict(self) -> dict[str, Any]:
        """As one JSON object; errors are null where nothing was detected."""
        errors, way = self.errors_m, self.trajectory
        return {
            "sources": [
                {"id": match.id, "detected": match.found is not None, "error_m": match.error_m}
                for match in self.matches
            ],
            "mean_error_m": sum(errors) / len(errors) if errors else None,
            "max_error_m": max(errors) if errors else None,
            "false_alarms": len(self.false_alarms),
            "trajectory": None
            if way is None
            else {
                "median_m": way.median_m,
                "p95_m": way.p95_m,
                "heading_mean_deg": way.heading_mean_deg,
            },
        }


def evaluation(
    run: Path, sources: Path, trajectory: Path | None = None, *, align: bool = False
) -> Evaluation:
    """A run folder compared with its truth.

    Parameters
    ----------
    run : Path
        A run folder or a folder of a difference: its ``sources.csv`` and, if a true trajectory
        is given, its ``trajectory.tum`` are read.
    sources : Path
        CSV with at least the columns ``id,x_m,y_m``.
    trajectory : Path, optional
        True poses in TUM format, in the same map frame.
    align : bool
        The run has a map frame of its own: first lay its trajectory on the true one, by the motion
        with the least squares, and its sources with it.

    Raises
    ------
    LogError
        One of the files cannot be read or does not hold what it should, or the true trajectory
        that a run is aligned by is not given.
    """
    truth, found = read_places(sources), read_places(run / "sources.csv")
    if align and trajectory is None:
        raise LogError("a run is aligned by its trajectory: give the true one with --trajectory.")
    error = None
    if trajectory is not None:
        estimate_file = run / "trajectory.tum"
        estimate, true_way = read_tum(estimate_file), read_tum(trajectory)
        if align:
            frame = frame_in_truth(estimate, true_way)
            estimate = replace(estimate, pose=composed(frame, estimate.pose))
            found = [moved(place, frame) for place in found]
        error = trajectory_error(estimate, true_way)
        if error is None:
            raise LogError(
                f"{estimate_file}: no pose lies within the times of {trajectory}. "
                "Give the trajectory of the same log."
            )
    matches, left_over = matched(truth, found)
    return Evaluation(run.resolve().name, matches, left_over, error)


def frame_in_truth(estimate: Trajectory, truth: Trajectory) -> FloatArray:
    """Pose of a run's map frame in that of the truth, shape (3,), by the places of both.

    The motion with the least squares (Umeyama, PAMI 1991, without scale); none where no times meet.
    """
    true = truth.at(estimate.time_ns)
    inside = np.isfinite(true[:, 0])
    if not inside.any():
        return np.zeros(3)
    own, true = estimate.pose[inside, :2], true[inside, :2]
    a, b = own - own.mean(axis=0), true - true.mean(axis=0)
    turn = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    shift = true.mean(axis=0) - transformed([0.0, 0.0, turn], own.mean(axis=0))
    return np.array([*shift, turn])


def moved(place: Place, frame: FloatArray) -> Place:
    """A place of the frame at some pose, in the frame that the pose is given in."""
    x, y = transformed(frame, [place.x_m, place.y_m])
    return Place(place.id, float(x), float(y))


def matched(
    truth: Sequence[Place], found: Sequence[Place], *, within_m: float = MATCH_M
) -> tuple[tuple[Match, ...], tuple[str, ...]]:
    """Each true source with the nearest row that no source before it took.

    Pairs are made in order of their distance, so that the result does not depend on the order of
    the sources: of two sources near one row the nearer gets it.

    Returns
    -------
    matches : tuple of Match
        In the order of ``truth``.
    left_over : tuple of str
        Ids of the rows that no source took: false alarms.

    Examples
    --------
    >>> truth = [Place("A", 0.0, 0.0), Place("B", 5.0, 0.0)]
    >>> found = [Place("1", 0.1, 0.0), Place("2", 5.0, 0.6)]
    >>> matched(truth, found)[1]
    ('2',)
    """
    distance = np.array(
        [[math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) for b in found] for a in truth]
    ).reshape(len(truth), len(found))
    partner: dict[int, int] = {}
    for flat in np.argsort(distance, axis=None, kind="stable"):
        source, row = divmod(int(flat), len(found))
        if distance[source, row] > within_m:
            break
        if source not in partner and row not in partner.values():
            partner[source] = row
    matches = tuple(
        Match(place.id, found[partner[i]].id, float(distance[i, partner[i]]))
        if i in partner
        else Match(place.id, None, None)
        for i, place in enumerate(truth)
    )
    taken = set(partner.values())
    return matches, tuple(place.id for j, place in enumerate(found) if j not in taken)


def trajectory_error(estimate: Trajectory, truth: Trajectory) -> TrajectoryError | None:
    """Errors of the poses at times that the truth spans; None if there is no such pose."""
    true_pose = truth.at(estimate.time_ns)
    inside = np.isfinite(true_pose[:, 0])
    if not inside.any():
        return None
    gap: FloatArray = estimate.pose[inside] - true_pose[inside]
    distance = np.hypot(gap[:, 0], gap[:, 1])
    heading = np.degrees(np.abs(wrapped_angle(gap[:, 2])))
    return TrajectoryError(
        int(inside.sum()),
        float(np.median(distance)),
        float(np.percentile(distance, 95)),
        float(np.mean(heading)),
    )


def evaluation_view(result: Evaluation) -> RenderableType:
    """A table as the paper's Table 2, and what is not in it."""
    from rich import box
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in ("Run", "Active sources", "Detected sources"):
        table.add_column(heading)
    table.add_column("Error (m)", justify="right")
    for number, match in enumerate(result.matches):
        error = "" if match.error_m is None else f"{match.error_m:.3f}"
        run = result.run if number == 0 else ""
        table.add_row(run, match.id, match.id if match.found is not None else "missed", error)
    if not result.matches:
        table.add_row(result.run, "none", "", "")
    lines = []
    if errors := result.errors_m:
        mean = sum(errors) / len(errors)
        lines.append(f"Error         mean {mean:.3f} m, greatest {max(errors):.3f} m")
    names = ", ".join(result.false_alarms[:SHOWN_NAMES])
    if len(result.false_alarms) > SHOWN_NAMES:
        names += ", ..."
    names = f" ({names})" if names else ""
    lines.append(f"False alarms  {len(result.false_alarms)}{names}")
    if (way := result.trajectory) is not None:
        lines.append(
            f"Trajectory    median {way.median_m:.3f} m, 95 % within {way.p95_m:.3f} m, "
            f"heading {way.heading_mean_deg:.2f} deg on average"
        )
    return Group(table, *(Text(line) for line in lines))


def read_places(path: Path) -> list[Place]:
    """Sources of a CSV file with at least the columns ``id,x_m,y_m``.

    Raises
    ------
    LogError
        The file cannot be read, lacks a column, or holds what is no number.
    """
    places = []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = csv.DictReader(file, skipinitialspace=True)
            missing = {"id", "x_m", "y_m"} - set(rows.fieldnames or ())
            if missing:
                raise LogError(
                    f"{path}: lacks the column(s) {', '.join(sorted(missing))}. "
                    "The first line must name at least id,x_m,y_m."
                )
            for row in rows:
                place = Place(row["id"], float(row["x_m"]), float(row["y_m"]))
                if not (math.isfinite(place.x_m) and math.isfinite(place.y_m)):
                    raise ValueError("not finite")
                places.append(place)
    except OSError as error:
        raise LogError(
            f"{path}: cannot be read ({error.strerror}). Give a run folder and its truth."
        ) from None
    except (ValueError, TypeError, csv.Error):
        line = len(places) + 2
        raise LogError(f"{path}: line {line}: x_m and y_m should be numbers in metres.") from None
    return places


def read_tum(path: Path) -> Trajectory:
    """Trajectory of a file in TUM format: ``timestamp tx ty tz qx qy qz qw``.

    Times are read to the nanosecond. Poses are projected on the floor.

    Raises
    ------
    LogError
        The file cannot be read, or a line of it is no pose.
    """
    times: list[int] = []
    poses: list[tuple[float, float, float]] = []
    number = 0
    try:
        for line in path.read_text(encoding="utf-8").splitlines():
            number += 1
            words = line.split()
            if not words or words[0].startswith("#"):
                continue
            x, y, _, qx, qy, qz, qw = (float(word) for word in words[1:])
            whole, _, part = words[0].partition(".")
            time_ns = int(whole) * 1_000_000_000 + int((part + "0" * 9)[:9])
            heading = math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
            if not times or time_ns > times[-1]:
                times.append(time_ns)
                poses.append((x, y, heading))
        return Trajectory(
            np.array(times, dtype=np.int64),
            np.array(poses, dtype=np.float64).reshape(-1, 3),
            np.ones(len(times), dtype=bool),
        )
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror}).") from None
    except ValueError:
        raise LogError(
            f"{path}: line {number} is no pose. Expected: timestamp tx ty tz qx qy qz qw."
        ) from None
