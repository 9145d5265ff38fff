"""What a drive leaves in the log besides sound: laser scans, odometry, transforms."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import radians

import numpy as np

from soundmap.geometry import FloatArray
from soundmap.simulate.clocks import arrivals_ns, kept, measurement_times, stamps_ns
from soundmap.simulate.lasers import (
    leg_circles,
    measured_ranges,
    ray_origins,
    ray_ranges,
    scan_bearings,
)
from soundmap.simulate.log_writer import Message
from soundmap.simulate.messages import laser_message, odometry_message, transform_message
from soundmap.simulate.odometry import wheel_odometry
from soundmap.simulate.path import Motion, walked
from soundmap.simulate.scene import Laser, Person, Scene
from soundmap.simulate.scene_file import floor_plan


@dataclass(frozen=True)
class Drive:
    """One run of a scene: the motion, and who and what takes part.

    Attributes
    ----------
    scene : Scene
    motion : Motion
        True motion of the base.
    active : tuple of str
        Sources that sound.
    people : tuple of Person
        Who walks about.
    start_ns : int
        Time of the start [ns since epoch].
    """

    scene: Scene
    motion: Motion
    active: tuple[str, ...]
    people: tuple[Person, ...]
    start_ns: int


def surfaces(scene: Scene, height_m: float) -> tuple[FloatArray, FloatArray]:
    """Both ends of everything straight that a ray at some height can hit, shapes (W, 2) [m]."""
    plan = floor_plan(scene)
    outlines = [
        thing.outline() for thing in scene.furniture if thing.bottom_m <= height_m <= thing.top_m
    ]
    for source in scene.sources:
        outline = source.box_outline()
        if outline is None or source.box_m is None or source.way_points_m:
            continue
        if abs(source.position_m[2] - height_m) <= 0.5 * source.box_m[2]:
            outlines.append(outline)
    starts = [plan.start_m, *outlines]
    ends = [plan.end_m, *(np.roll(outline, -1, axis=0) for outline in outlines)]
    return np.concatenate(starts), np.concatenate(ends)


def laser_messages(drive: Drive, laser: Laser, rng: np.random.Generator) -> Iterator[Message]:
    """Scans of one scanner, in order of arrival."""
    bearing = scan_bearings(radians(laser.field_deg), radians(laser.step_deg))
    interval = 1.0 / laser.rate_hz
    # A full turn takes one interval; the rays of the field of view take their share of it.
    ray_interval = interval * radians(laser.step_deg) / (2.0 * np.pi)
    clock = laser.clock
    times = measurement_times(
        drive.motion.duration_s, interval, drift_ppm=clock.drift_ppm, first_s=laser.phase_s
    )
    stamps = stamps_ns(times, clock, drive.start_ns, rng)
    arrivals = arrivals_ns(times + ray_interval * len(bearing), clock, drive.start_ns, rng)
    walls = surfaces(drive.scene, laser.mount[2])
    for i in np.flatnonzero(kept(times, clock)):
        ray_time = times[i] + ray_interval * np.arange(len(bearing))
        origin, direction = ray_origins(drive.motion.at(ray_time), laser.mount, bearing)
        true = ray_ranges(origin, direction, *walls, _legs(drive.people, ray_time))
        ranges = measured_ranges(
            true,
            rng,
            noise_m=laser.noise_m,
            noise_per_m=laser.noise_per_m,
            dropout_share=laser.dropout_share,
            range_min_m=laser.range_min_m,
            range_max_m=laser.range_max_m,
        )
        data = laser_message(
            int(stamps[i]),
            laser.frame,
            bearing,
            ranges,
            ray_interval_s=ray_interval,
            scan_interval_s=interval,
            range_min_m=laser.range_min_m,
            range_max_m=laser.range_max_m,
        )
        yield Message(int(arrivals[i]), int(stamps[i]), data)


def odometry_messages(
    drive: Drive, rng: np.random.Generator
) -> tuple[list[Message], list[Message]]:
    """Odometry and, if published, the transforms that say the same; in order of arrival."""
    odometry, base = drive.scene.odometry, drive.scene.robot.base_frame
    clock, interval = odometry.clock, 1.0 / odometry.rate_hz
    # The last message ends the log: every sweep lies between two.
    end_s = drive.motion.duration_s + 2.0 * interval
    times = measurement_times(end_s, interval, drift_ppm=clock.drift_ppm)
    poses, twists = wheel_odometry(
        drive.motion.at(times),
        interval,
        rng,
        wheelbase_m=odometry.wheelbase_m,
        left_scale=odometry.left_scale,
        right_scale=odometry.right_scale,
        wheelbase_scale=odometry.wheelbase_scale,
        noise_m_per_sqrt_m=odometry.noise_m_per_sqrt_m,
    )
    stamps = stamps_ns(times, clock, drive.start_ns, rng)
    arrivals = arrivals_ns(times, clock, drive.start_ns, rng)
    said, transforms = [], []
    for i in np.flatnonzero(kept(times, clock)):
        log, stamp, pose = int(arrivals[i]), int(stamps[i]), poses[i]
        data = odometry_message(stamp, odometry.frame, base, pose, twists[i])
        said.append(Message(log, stamp, data))
        place = (float(pose[0]), float(pose[1]), 0.0, float(pose[2]))
        data = transform_message([(stamp, odometry.frame, base, place)])
        transforms.append(Message(log, stamp, data))
    return said, transforms if odometry.publish_tf else []


def mount_message(drive: Drive) -> Message:
    """The one message of /tf_static: where every sensor sits."""
    scene = drive.scene
    mounts = [(laser.frame, laser.mount) for laser in scene.lasers]
    mounts.append((scene.array.frame, scene.array.mount))
    base = scene.robot.base_frame
    data = transform_message([(drive.start_ns, base, frame, mount) for frame, mount in mounts])
    return Message(drive.start_ns, drive.start_ns, data)


def _legs(people: Sequence[Person], time_s: FloatArray) -> FloatArray:
    """Everyone's legs at the time of each ray, shape (R, 2 * people, 3)."""
    legs = [np.zeros((len(time_s), 0, 3))]
    for person in people:
        pose = walked(person.way_points_m, speed_m_s=person.speed_m_s, time_s=time_s)
        legs.append(leg_circles(pose, time_s, person.leg_radius_m))
    return np.concatenate(legs, axis=1)
