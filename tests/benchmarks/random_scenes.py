"""Random scenes with their truth: rooms, corridors and halls with one to six machines.

The same seed gives the same scene. What is drawn spans what a user might meet, not what the
detector likes: sources 0.6 to 6 m apart, up to 10 dB apart in level, at the wall or free-standing,
in and out of the lasers' plane, in dry and in reverberant rooms, with good and bad odometry.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from soundmap.errors import ConfigError
from soundmap.simulate.floor_plan import distance_to_walls, odd_crossings
from soundmap.simulate.scene_file import loaded_scene

Point = tuple[float, float]
SOUNDS = ("air_conditioner", "fan", "server_rack", "pump", "leak", "white")
ROUTE_CLEARANCE_M = 0.55
"""Least distance of a source from the robot's way."""
EARSHOT_M = 4.0
"""Every source comes into view within this distance of the way."""
BESIDE = ("walker", "pauses")
"""What may be unsteady in a scene: someone walks to and fro and sounds, or one of the machines is
silent now and then."""


class NoRoomError(Exception):
    """Nobody can walk in a scene without coming too near to the robot."""


@dataclass(frozen=True)
class Difficulty:
    """What makes a scene hard.

    Attributes
    ----------
    kind : str
        room, corridor or hall.
    level_gap_db : float
        Loudest over weakest source.
    separation_m : float
        Least distance of two sources; inf with fewer than two.
    reverberation_s, ambient_dba : float
    bad_odometry : bool
    """

    kind: str
    level_gap_db: float
    separation_m: float
    reverberation_s: float
    ambient_dba: float
    bad_odometry: bool


def random_scene(
    seed: int, *, silent: bool = False, ways: int = 1, beside: str | None = None
) -> tuple[dict[str, Any], Difficulty]:
    """A scene as a TOML table, and what makes it hard.

    Parameters
    ----------
    seed : int
    silent : bool
        The same machines stand there, but none of them sounds.
    ways : int
        How many times the robot drives its way, there and back in turn.
    beside : str, optional
        One of `BESIDE`.

    Raises
    ------
    NoRoomError
        If nobody can walk there.
    """
    for attempt in range(50):
        drawn = _drawn_scene(np.random.default_rng([seed, attempt]), seed)
        if drawn is None:
            continue
        table, difficulty = drawn
        way = table["robot"]["way_points_m"]
        there, back = way[1:], way[-2::-1]
        more = [back if number % 2 else there for number in range(1, ways)]
        table["robot"]["way_points_m"] = way + [point for leg in more for point in leg]
        if silent:
            table["runs"] = [{"name": "run", "sources": []}]
        rng = np.random.default_rng([seed, 77])
        if beside == "walker":
            _add_walker(rng, table)
        elif beside == "pauses":
            source = table["sources"][int(rng.integers(len(table["sources"])))]
            source["on_s"] = round(float(rng.uniform(1.5, 5.0)), 1)
            source["off_s"] = round(float(rng.uniform(2.0, 6.0)), 1)
        return table, difficulty
    raise RuntimeError(f"seed {seed}: no possible scene in 50 attempts")


def written_scene(
    seed: int, file: Path, *, silent: bool = False, ways: int = 1, beside: str | None = None
) -> Difficulty:
    """Write the first possible scene of a seed, checked by the simulator itself."""
    for offset in range(20):
        table, difficulty = random_scene(
            seed + 100_000 * offset, silent=silent, ways=ways, beside=beside
        )
        file.write_text(tomli_w.dumps(table), encoding="utf-8")
        try:
            loaded_scene(file)
        except ConfigError:
            continue
        return difficulty
    raise RuntimeError(f"seed {seed}: the simulator refuses every scene")


def _drawn_scene(rng: np.random.Generator, seed: int) -> tuple[dict[str, Any], Difficulty] | None:
    kind = str(rng.choice(["room", "room", "corridor", "hall"]))
    outline, way = {"room": _room, "corridor": _corridor, "hall": _hall}[kind](rng)
    reverberation = float(rng.uniform(0.3, 1.2))
    ambient = float(rng.uniform(35.0, 55.0))
    bad = bool(rng.random() < 0.4)
    wanted = int(rng.integers(1, 7)) if kind != "corridor" else int(rng.integers(1, 5))
    sources = _sources(rng, outline, way, wanted)
    if len(sources) < wanted:
        return None
    levels = [source["level_dba_5cm"] for source in sources]
    places = np.array([source["position_m"][:2] for source in sources])
    apart = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
    separation = float(apart[~np.eye(len(places), dtype=bool)].min(initial=np.inf))
    reflection = round(float(np.clip(0.72 + 0.2 * reverberation, 0.75, 0.93)), 3)
    error = 0.012 if bad else 0.003
    table: dict[str, Any] = {
        "name": "run",
        "seed": seed,
        "room": {
            "height_m": round(float(rng.uniform(2.4, 4.5 if kind == "hall" else 3.0)), 2),
            "floor_reflection": round(float(rng.uniform(0.6, 0.9)), 2),
            "ceiling_reflection": round(float(rng.uniform(0.5, 0.8)), 2),
            "image_order": 2,
            "reverberation_s": round(reverberation, 3),
        },
        "walls": [{"name": "outer", "corners_m": outline, "reflection": reflection}],
        "furniture": _furniture(rng, outline, way, places),
        "sources": sources,
        "robot": {
            "way_points_m": way,
            "speed_m_s": round(float(rng.uniform(0.45, 0.7)), 2),
            "turn_radius_m": 0.5,
            "turn_rate_rad_s": 0.8,
            "rest_s": 1.0,
        },
        "array": {
            "mount": [0.0, 0.0, 0.6, 0.0],
            "position_error_m": 0.001,
            "gain_error_db": 0.3,
        },
        "odometry": {
            "left_scale": round(float(1.0 + rng.uniform(-error, error)), 5),
            "right_scale": round(float(1.0 + rng.uniform(-error, error)), 5),
            "wheelbase_scale": round(float(1.0 + 3.0 * rng.uniform(-error, error)), 5),
            "noise_m_per_sqrt_m": 0.006 if bad else 0.002,
        },
        "noise": {"ambient_dba": round(ambient, 1), "drive_dba": round(rng.uniform(35, 45), 1)},
    }
    gap = max(levels) - min(levels)
    return table, Difficulty(kind, gap, separation, reverberation, ambient, bad)


def _room(rng: np.random.Generator) -> tuple[list[Point], list[Point]]:
    """A rectangle, sometimes with a niche, and three legs along its walls."""
    width, depth = rng.uniform(4.5, 7.5), rng.uniform(3.8, 6.0)
    outline: list[Point] = [(0.0, 0.0), (width, 0.0), (width, depth), (0.0, depth)]
    if rng.random() < 0.5:
        niche_x, niche_y = width - rng.uniform(0.5, 0.9), depth - rng.uniform(0.5, 0.9)
        outline[2:3] = [(width, niche_y), (niche_x, niche_y), (niche_x, depth)]
    inset = 1.2
    way = [(inset, inset), (width - inset - 0.3, inset), (width - inset - 0.3, depth - inset - 0.2)]
    way.append((inset, depth - inset - 0.2))
    return _placed(rng, outline, way)


def _corridor(rng: np.random.Generator) -> tuple[list[Point], list[Point]]:
    """Two legs at a right angle, 1.8 to 2.6 m wide."""
    first, second, wide = rng.uniform(6.0, 9.0), rng.uniform(5.0, 8.0), rng.uniform(1.8, 2.6)
    outline: list[Point] = [
        (0.0, 0.0), (first, 0.0), (first, second), (first - wide, second),
        (first - wide, wide), (0.0, wide),
    ]  # fmt: skip
    half = wide / 2.0 + rng.uniform(-0.15, 0.15)
    way = [(0.9, half), (first - wide / 2.0, half), (first - wide / 2.0, second - 0.9)]
    return _placed(rng, outline, way)


def _hall(rng: np.random.Generator) -> tuple[list[Point], list[Point]]:
    """A wide space, crossed on a U."""
    width, depth = rng.uniform(9.0, 14.0), rng.uniform(7.0, 11.0)
    outline: list[Point] = [(0.0, 0.0), (width, 0.0), (width, depth), (0.0, depth)]
    left, low = rng.uniform(1.5, 2.5), rng.uniform(1.5, 2.5)
    reach, rise = rng.uniform(4.5, 6.5), rng.uniform(2.5, 3.5)
    way = [(left, low), (left + reach, low), (left + reach, low + rise), (left + 0.5, low + rise)]
    return _placed(rng, outline, way)


def _placed(
    rng: np.random.Generator, outline: list[Point], way: list[Point]
) -> tuple[list[Point], list[Point]]:
    """Shifted, turned by any angle, and sometimes mirrored."""
    angle, mirror = rng.uniform(-math.pi, math.pi), -1.0 if rng.random() < 0.5 else 1.0
    cos, sin = math.cos(angle), math.sin(angle)
    shift = rng.uniform(-3.0, 3.0, 2)

    def moved(points: list[Point]) -> list[Point]:
        return [
            (
                round(float(cos * x - sin * mirror * y + shift[0]), 4),
                round(float(sin * x + cos * mirror * y + shift[1]), 4),
            )
            for x, y in points
        ]

    outline = moved(outline)
    return (outline if mirror > 0 else outline[::-1]), moved(way)


def _sources(
    rng: np.random.Generator, outline: list[Point], way: list[Point], wanted: int
) -> list[dict[str, Any]]:
    corners = np.array(outline)
    following = np.roll(corners, -1, axis=0)
    route = np.concatenate([np.linspace(a, b, 40) for a, b in pairwise(way)])
    loudest = rng.uniform(76.0, 84.0)
    gap = rng.uniform(0.0, 10.0)
    sources: list[dict[str, Any]] = []
    for _ in range(400):
        if len(sources) == wanted:
            break
        free = rng.random() < 0.2
        place, facing, off = (
            _free_place(rng, corners, route) if free else _wall_place(rng, corners, following)
        )
        taken = [np.hypot(*(np.array(other["position_m"][:2]) - place)) for other in sources]
        to_route = np.hypot(*(route - place).T)
        seen = to_route < EARSHOT_M
        if (
            not odd_crossings(place, corners, following)
            or distance_to_walls(place[None], corners, following)[0] < min(0.95 * off, 0.5)
            or to_route.min() < ROUTE_CLEARANCE_M + 0.15
            or min(taken, default=9.9) < 0.6
            or not seen.any()
            or not _in_view(place, route[seen], corners, following)
        ):
            continue
        number = len(sources)
        drop = 0.0 if number == 0 else gap if number == 1 else rng.uniform(0.0, gap)
        high = rng.random() < 0.1
        source: dict[str, Any] = {
            "id": f"S{number + 1}",
            "position_m": [
                round(float(place[0]), 3),
                round(float(place[1]), 3),
                round(float(rng.uniform(1.2, 1.9) if high else rng.uniform(0.25, 0.8)), 3),
            ],
            "facing_deg": round(math.degrees(facing), 1),
            "front_to_back_db": round(float(rng.uniform(0.0, 12.0)), 1),
            "level_dba_5cm": round(float(loudest - drop), 1),
            "sound": str(rng.choice(SOUNDS)),
        }
        depth = 0.3 if free else off - 0.03
        if not high and depth > 0.04:
            wide = float(rng.uniform(0.2, 0.5))
            source["box_m"] = [round(wide, 3), round(depth, 3), 0.9]
        sources.append(source)
    return sources


def _wall_place(
    rng: np.random.Generator, corners: np.ndarray, following: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """A place 0.05 to 0.5 m off a wall, facing the room."""
    length = np.hypot(*(following - corners).T)
    wall = rng.choice(len(corners), p=length / length.sum())
    along = (following[wall] - corners[wall]) / length[wall]
    normal = np.array([-along[1], along[0]])  # outlines run counter-clockwise
    off = float(rng.uniform(0.05, 0.5))
    spare = min(0.35, 0.45 * length[wall])
    place = corners[wall] + along * rng.uniform(spare, length[wall] - spare) + normal * off
    return place, float(np.arctan2(normal[1], normal[0])), off


def _free_place(
    rng: np.random.Generator, corners: np.ndarray, route: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """A place in the open, facing any way."""
    place = rng.uniform(corners.min(axis=0), corners.max(axis=0))
    nearest = route[np.argmin(np.hypot(*(route - place).T))] - place
    facing = float(np.arctan2(nearest[1], nearest[0]) + rng.uniform(-1.0, 1.0))
    return place, facing, 0.7


def _in_view(
    place: np.ndarray, route: np.ndarray, corners: np.ndarray, following: np.ndarray
) -> bool:
    """Whether no wall stands between a place and enough of the way."""
    steps = np.linspace(0.05, 1.0, 20)
    clear = 0
    for stand in route:
        line = place + steps[:, None] * (stand - place)
        clear += bool(np.all(odd_crossings(line, corners, following)))
    return clear >= 8


def _furniture(
    rng: np.random.Generator, outline: list[Point], way: list[Point], places: np.ndarray
) -> list[dict[str, Any]]:
    """Up to two boxes that no map shows, away from sources and the robot's way."""
    corners = np.array(outline)
    following = np.roll(corners, -1, axis=0)
    route = np.concatenate([np.linspace(a, b, 40) for a, b in pairwise(way)])
    things: list[dict[str, Any]] = []
    for _ in range(60):
        if len(things) == 2 or rng.random() < 0.02:
            break
        place = rng.uniform(corners.min(axis=0), corners.max(axis=0))
        if (
            odd_crossings(place, corners, following)
            and np.hypot(*(route - place).T).min() > 0.85
            and np.hypot(*(places - place).T).min() > 1.0
            and _in_view(place, route, corners, following)
        ):
            things.append(
                {
                    "name": f"thing{len(things) + 1}",
                    "centre_m": [round(float(value), 3) for value in place],
                    "size_m": [round(float(value), 2) for value in rng.uniform(0.3, 0.6, 2)],
                    "yaw_deg": round(float(rng.uniform(0.0, 90.0)), 1),
                }
            )
    return things


def _add_walker(rng: np.random.Generator, table: dict[str, Any]) -> None:
    """Someone who walks to and fro where the robot does not come, and what they sound like."""
    corners = np.array(table["walls"][0]["corners_m"])
    following = np.roll(corners, -1, axis=0)
    way = table["robot"]["way_points_m"]
    route = np.concatenate([np.linspace(a, b, 40) for a, b in pairwise(way)])
    for _ in range(500):
        ends = rng.uniform(corners.min(axis=0), corners.max(axis=0), (2, 2))
        line = np.linspace(*ends, 30)
        if (
            1.2 < np.hypot(*(ends[1] - ends[0])) < 5.0
            and np.all(odd_crossings(line, corners, following))
            and distance_to_walls(line, corners, following).min() >= 0.4
            and np.hypot(*(route[:, None] - line[None]).transpose(2, 0, 1)).min() >= 0.5
            and _in_view(line[15], route, corners, following)
        ):
            break
    else:
        raise NoRoomError
    speed = round(float(rng.uniform(0.3, 1.1)), 2)
    first, last = ([round(float(value), 3) for value in end] for end in ends)
    table["people"] = [{"name": "walker", "way_points_m": [first, last], "speed_m_s": speed}]
    table["sources"].append(
        {
            "id": "walker",
            "position_m": [*first, round(float(rng.uniform(0.6, 1.6)), 2)],
            "way_points_m": [last],
            "speed_m_s": speed,
            "level_dba_5cm": round(float(rng.uniform(74.0, 84.0)), 1),
            "sound": str(rng.choice(["speech_like", "fan", "pump"])),
        }
    )
