"""Scenes from files: read, checked, and refused with the line to mend."""

from __future__ import annotations

import difflib
import math
import tomllib
import types
import typing
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

from soundmap.errors import ConfigError
from soundmap.simulate.floor_plan import FloorPlan, crossings, distance_to_walls, odd_crossings
from soundmap.simulate.path import Motion, driven
from soundmap.simulate.scene import Scene, Source
from soundmap.simulate.toml_lines import Path as Place
from soundmap.simulate.toml_lines import line_of, toml_lines

Fault = tuple[Place, str]
ROBOT_HEIGHT_M = 0.8
"""What begins higher is no obstacle."""


def loaded_scene(path: Path) -> Scene:
    """The scene of a TOML file.

    Raises
    ------
    ConfigError
        The file cannot be read or is not TOML, or the scene is impossible. Every fault is named
        with its line.
    """
    try:
        text = path.read_text(encoding="utf-8")
        table = tomllib.loads(text)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}).") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: not a text file. A scene is a TOML file.") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from None
    faults = list(_unknown_keys(table, Scene, ()))
    if not faults:
        try:
            scene = Scene.model_validate(table)
        except ValidationError as error:
            faults = _wrong_values(error, table)
        else:
            faults = list(scene_faults(scene, folder=path.parent))
    if faults:
        raise ConfigError(_message(path, text, faults))
    return scene


def floor_plan(scene: Scene) -> FloorPlan:
    """The walls of a scene."""
    return FloorPlan.from_rings(
        [wall.corners_m for wall in scene.walls], [wall.reflection for wall in scene.walls]
    )


def motion_of(scene: Scene) -> Motion:
    """The robot's true motion."""
    robot = scene.robot
    return driven(
        robot.way_points_m,
        speed_m_s=robot.speed_m_s,
        acceleration_m_s2=robot.acceleration_m_s2,
        turn_radius_m=robot.turn_radius_m,
        turn_rate_rad_s=robot.turn_rate_rad_s,
        rest_s=robot.rest_s,
        heading_rad=None if robot.heading_deg is None else math.radians(robot.heading_deg),
    )


def scene_faults(scene: Scene, *, folder: Path) -> Iterator[Fault]:
    """What is impossible in a scene whose values are all possible by themselves."""
    yield from _name_faults(scene)
    plan = floor_plan(scene)
    crossing = list(_wall_faults(scene))
    yield from crossing
    if crossing:
        return  # inside and outside mean nothing until the walls are mended
    for index, source in enumerate(scene.sources):
        yield from _source_faults(scene, plan, index, source, folder)
    yield from _route_faults(scene, plan)
    for index, person in enumerate(scene.people):
        for point in person.way_points_m:
            if not plan.contains(point):
                yield (
                    ("people", index, "way_points_m"),
                    f"person {person.name!r} walks to {_shown(point)}, which is not inside the "
                    "room",
                )


def _name_faults(scene: Scene) -> Iterator[Fault]:
    named: list[tuple[str, str, Sequence[str]]] = [
        ("walls", "name", [wall.name for wall in scene.walls]),
        ("furniture", "name", [thing.name for thing in scene.furniture]),
        ("people", "name", [person.name for person in scene.people]),
        ("sources", "id", [source.id for source in scene.sources]),
        ("runs", "name", [run.name for run in scene.runs]),
        ("lasers", "topic", [laser.topic for laser in scene.lasers]),
        ("lasers", "frame", [laser.frame for laser in scene.lasers]),
    ]
    for table, key, names in named:
        for name, count in Counter(names).items():
            if count > 1:
                second = [i for i, other in enumerate(names) if other == name][1]
                yield (table, second, key), f"{key} {name!r} is used {count} times; rename one"
    sources = [source.id for source in scene.sources]
    people = [person.name for person in scene.people]
    for index, run in enumerate(scene.runs):
        wanted = (("sources", run.sources, sources), ("people", run.people or (), people))
        for key, names, known in wanted:
            for name in names:
                if name not in known:
                    yield (
                        ("runs", index, key),
                        f"run {run.name!r} names {name!r}, but {key} are {', '.join(known)}",
                    )


def _wall_faults(scene: Scene) -> Iterator[Fault]:
    """Outlines that cross themselves or each other."""
    rings = [np.array(wall.corners_m) for wall in scene.walls]
    for index, wall in enumerate(scene.walls):
        start, end = rings[index], np.roll(rings[index], -1, axis=0)
        if np.any(np.hypot(*(end - start).T) < 1e-6):
            yield ("walls", index, "corners_m"), f"wall {wall.name!r} has two equal corners"
            continue
        for other in range(index + 1):
            a, b = rings[other], np.roll(rings[other], -1, axis=0)
            crossed = np.any(crossings(start, end, a, b) & crossings(a, b, start, end).T)
            if crossed:
                where = "itself" if other == index else f"wall {scene.walls[other].name!r}"
                yield ("walls", index, "corners_m"), f"wall {wall.name!r} crosses {where}"


def _source_faults(
    scene: Scene, plan: FloorPlan, index: int, source: Source, folder: Path
) -> Iterator[Fault]:
    points = {"position_m": [source.position_m[:2]], "way_points_m": list(source.way_points_m)}
    for key, wanted in points.items():
        for point in wanted:
            if not plan.contains(point):
                where = _place_outside(scene, point)
                yield (
                    ("sources", index, key),
                    f"source {source.id!r} at {_shown(point)} {where}; move it to open floor",
                )
    if not 0.0 < source.position_m[2] < scene.room.height_m:
        yield (
            ("sources", index, "position_m"),
            f"source {source.id!r} is {source.position_m[2]:g} m high, the room "
            f"{scene.room.height_m:g} m",
        )
    if source.wav is not None and not (folder / source.wav).is_file():
        yield ("sources", index, "wav"), f"there is no file {folder / source.wav}"


def _route_faults(scene: Scene, plan: FloorPlan) -> Iterator[Fault]:
    """Way points and legs that are impossible; else places where the robot would bump."""
    place = ("robot", "way_points_m")
    points = scene.robot.way_points_m
    outside = [index for index, point in enumerate(points) if not plan.contains(point)]
    for index in outside:
        where = _place_outside(scene, points[index])
        yield place, f"{_way_point(points, index)} {where}; move it to open floor"
    if outside:
        return
    crossed = [i for i, leg in enumerate(pairwise(points)) if plan.crossed(*leg)]
    for index in crossed:
        yield place, f"the way from way point {index + 1} to {index + 2} crosses a wall"
    if not crossed:
        yield from _bump_faults(scene)


def _bump_faults(scene: Scene) -> Iterator[Fault]:
    """Things that the robot's rounded way comes too near to, each where it is nearest."""
    motion = motion_of(scene).pose[::50, :2]
    things = [(f"wall {wall.name!r}", np.array(wall.corners_m)) for wall in scene.walls]
    things += [
        (f"furniture {thing.name!r}", thing.outline())
        for thing in scene.furniture
        if thing.bottom_m < ROBOT_HEIGHT_M
    ]
    for source in scene.sources:
        outline = source.box_outline()
        if outline is not None and source.position_m[2] < ROBOT_HEIGHT_M:
            things.append((f"the cabinet of source {source.id!r}", outline))
    for name, corners in things:
        following = np.roll(corners, -1, axis=0)
        distance = distance_to_walls(motion, corners, following)
        if not name.startswith("wall"):
            distance = np.where(odd_crossings(motion, corners, following), 0.0, distance)
        nearest = int(np.argmin(distance))
        if distance[nearest] < scene.robot.radius_m:
            yield (
                ("robot", "way_points_m"),
                f"at {_shown(tuple(motion[nearest].round(2)))} the robot comes within "
                f"{distance[nearest]:.2f} m of {name}, its radius is {scene.robot.radius_m:g} m; "
                "move a way point or lessen turn_radius_m",
            )


def _way_point(points: Sequence[tuple[float, float]], index: int) -> str:
    return f"way point {index + 1} at {_shown(points[index])}"


def _place_outside(scene: Scene, point: tuple[float, ...]) -> str:
    for wall in scene.walls[1:]:
        corners = np.array(wall.corners_m)
        if odd_crossings(point, corners, np.roll(corners, -1, axis=0)):
            return f"lies inside wall {wall.name!r}"
    return "lies outside the room"


def _shown(point: tuple[float, ...]) -> str:
    return "(" + ", ".join(f"{value:g}" for value in point) + ")"


def _unknown_keys(
    table: Mapping[str, Any], model: type[BaseModel], where: Place
) -> Iterator[Fault]:
    for key, value in table.items():
        field = model.model_fields.get(key)
        if field is None:
            nearest = difflib.get_close_matches(key, model.model_fields, n=1, cutoff=0.5)
            hint = f"did you mean {nearest[0]!r}? " if nearest else ""
            yield (*where, key), f"{hint}Known here: {', '.join(model.model_fields)}"
            continue
        inner = _inner_model(field.annotation)
        if inner is None:
            continue
        if isinstance(value, dict):
            yield from _unknown_keys(value, inner, (*where, key))
        elif isinstance(value, list):
            for index, entry in enumerate(value):
                if isinstance(entry, dict):
                    yield from _unknown_keys(entry, inner, (*where, key, index))


def _inner_model(annotation: Any) -> type[BaseModel] | None:
    """The table that a field holds, alone or as entries of an array."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if typing.get_origin(annotation) in (tuple, types.UnionType, typing.Union, typing.Annotated):
        for part in typing.get_args(annotation):
            if (model := _inner_model(part)) is not None:
                return model
    return None


def _wrong_values(error: ValidationError, table: Mapping[str, Any]) -> list[Fault]:
    faults: list[Fault] = []
    for fault in error.errors():
        place = _existing(fault["loc"], table)
        given = fault.get("input")
        shown = "" if isinstance(given, dict | BaseModel) else f" (given: {given!r})"
        faults.append((place, fault["msg"].removeprefix("Value error, ") + shown))
    return faults


def _existing(place: Iterable[int | str], table: Any) -> Place:
    """The part of a place that the file itself has; the validator adds names of its own."""
    found: Place = ()
    for part in place:
        known = isinstance(table, dict) and part in table
        if known or (isinstance(table, list) and isinstance(part, int) and part < len(table)):
            table = table[part]
        else:
            return (*found, part) if isinstance(table, dict) and isinstance(part, str) else found
        found = (*found, part)
    return found


def _message(path: Path, text: str, faults: Sequence[Fault]) -> str:
    lines = toml_lines(text)
    shown = [f"{path}: {len(faults)} fault(s) in the scene"]
    for place, what in faults:
        number = line_of(lines, place)
        at = f"line {number}: " if number is not None else ""
        name = ".".join(str(part + 1) if isinstance(part, int) else part for part in place)
        shown.append(f"  {at}{name}: {what}")
    return "\n".join(shown)
