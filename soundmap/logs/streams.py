"""How each stream of a log is to be read: what the survey and the configuration settle together."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from soundmap.config import Config
from soundmap.errors import ConfigError, NothingUsableError
from soundmap.geometry import Mount, Trajectory
from soundmap.logs.messages import Kind
from soundmap.logs.mounts import FrameTree, Mounts
from soundmap.logs.odometry import OdometryRecord, odometry_trajectory
from soundmap.logs.stamps import DAMAGED, Times, increasing, on_common_clock, stream_times
from soundmap.logs.survey import AudioRecord, LaserRecord, Survey, Topic
from soundmap.logs.topics import laser_topics, nothing_of, odometry_topic
from soundmap.losses import LossLedger
from soundmap.sensors import TILT_WARNING_RAD


@dataclass(frozen=True)
class OdometryStream:
    """The base in the odometry frame, and where that comes from.

    ``source`` is "pose", "twist" or "transform"; ``ahead_ns`` how far the stamps are ahead of the
    log's own time; ``span_ns`` when the first and the last message were logged.
    """

    topic: str
    trajectory: Trajectory
    source: str
    parent: str
    child: str
    ahead_ns: int
    span_ns: tuple[int, int]
    counts_gaps = False

    @property
    def name(self) -> str:
        """The topic."""
        return self.topic

    @property
    def logged_ns(self) -> Times:
        """When the sound messages were logged but for their delays, shape (K,), rising."""
        return np.clip(self.trajectory.time_ns - self.ahead_ns, *self.span_ns)


@dataclass(frozen=True)
class LaserStream:
    """How to read one scanner.

    Attributes
    ----------
    topic : Topic
    time_ns : ndarray of int64, shape (M,)
        Time of the first ray of every message of the topic; ``DAMAGED`` where it is left out.
    ray_interval_is_sound : bool
    range_max_m : float
        For messages that do not tell.
    mounts : dict
        By frame.
    """

    topic: Topic
    record: LaserRecord
    time_ns: Times
    ray_interval_is_sound: bool
    range_max_m: float
    mounts: dict[str, Mount]
    counts_gaps = False

    @property
    def name(self) -> str:
        """The topic."""
        return self.topic.name

    @property
    def logged_ns(self) -> Times:
        """When the sound scans were logged, rising."""
        logged = np.array(self.record.log_time_ns, dtype=np.int64)
        return np.sort(logged[self.time_ns != DAMAGED])


def odometry_stream(
    survey: Survey, config: Config, log_name: str, losses: LossLedger
) -> OdometryStream:
    """The base by its own account, from an odometry topic, else from the transform that moves.

    Raises
    ------
    ConfigError, NothingUsableError
        The topic is not settled; there is none; or nothing in it is sound.
    """
    topic = odometry_topic(survey, config, log_name)
    if topic is None:
        name, record = _moving_transform(survey, config, log_name)
    else:
        if not isinstance(topic.record, OdometryRecord):
            raise NothingUsableError(f"{log_name}: {topic.name} cannot be read ({topic.problem}).")
        name, record = topic.name, topic.record
    times, ahead_ns = stream_times(record.stamp_ns, record.log_time_ns, name, losses)
    whole = times != DAMAGED
    logged_ns = np.array(record.log_time_ns, dtype=np.int64)
    trajectory, source = odometry_trajectory(
        times[whole], record.table()[whole], name, losses, logged_ns=logged_ns[whole]
    )
    if len(trajectory) < 2:
        raise NothingUsableError(
            f"{log_name}: no usable odometry on {name}: {len(record)} messages, "
            f"{len(trajectory)} of them sound. Check the robot's odometry."
        )
    source = "transform" if topic is None else source
    span_ns = int(logged_ns.min()), int(logged_ns.max())
    return OdometryStream(name, trajectory, source, record.parent, record.child, ahead_ns, span_ns)


def _moving_transform(survey: Survey, config: Config, log_name: str) -> tuple[str, OdometryRecord]:
    """The transform that carries the sensors: the first that moves on the way up from them."""
    moving = survey.transforms.moving()
    still = {
        names: edge
        for names, edge in survey.transforms.edges.items()
        if not edge.static and edge.count > 1
    }
    wanted = config.topics.odometry
    for edges in (moving, still):
        candidates = {n: e for n, e in edges.items() if wanted in (None, e.topic)}
        if not candidates:
            continue
        fixed = {n: m for n, m in survey.transforms.fixed().items() if n not in candidates}
        tree = FrameTree(fixed)
        roots = Counter(tree.root(frame) for frame in _sensor_frames(survey))
        children = {child: edge for (_, child), edge in candidates.items()}
        for root, _ in roots.most_common():
            if root in children:
                return children[root].topic, children[root].record
        if len(candidates) == 1:
            edge = next(iter(candidates.values()))
            return edge.topic, edge.record
        if edges is moving:
            names = ", ".join(f"{p} -> {c}" for p, c in candidates)
            raise ConfigError(
                f"{log_name}: no odometry topic, and several transforms move ({names}), none of "
                "them the root of a sensor's frame. Record odometry, or the transforms in between."
            )
    raise NothingUsableError(nothing_of(survey, Kind.ODOMETRY, log_name))


def _sensor_frames(survey: Survey) -> list[str]:
    frames: list[str] = []
    for topic in survey.of_kind(Kind.LASER) + survey.of_kind(Kind.AUDIO):
        if isinstance(topic.record, LaserRecord | AudioRecord):
            frames += [frame for frame in topic.record.frame_ids if frame]
    return frames


def base_mounts(
    survey: Survey, config: Config, odometry: OdometryStream, log_name: str, losses: LossLedger
) -> Mounts:
    """Where all frames are in the frame whose motion the odometry tells."""
    fixed = {
        names: mount
        for names, mount in survey.transforms.fixed().items()
        if names != (odometry.parent, odometry.child)
    }
    tree = FrameTree(fixed)
    _count_bad_transforms(survey, tree, (odometry.parent, odometry.child), losses)
    base = odometry.child
    if fixed and base not in tree:
        roots = [root for root in tree.roots if root != odometry.parent]
        if len(roots) == 1:
            losses.remark(
                f"odometry frame {base!r} is not among the transforms",
                odometry.topic,
                effect=f"taken to be {roots[0]!r}, their root",
            )
            base = roots[0]
    return Mounts(tree, base, config.mounts, log_name)


def _count_bad_transforms(
    survey: Survey, tree: FrameTree, driven: tuple[str, str], losses: LossLedger
) -> None:
    """Count what was said of the robot's frames and cannot be right."""
    for (parent, child), edge in survey.transforms.edges.items():
        if (parent, child) == driven:
            continue  # is odometry, and judged as such
        losses.add(
            f"transform from {parent!r} to {child!r} is not finite",
            edge.topic,
            count=edge.not_finite,
            effect="left out",
        )
        losses.add(
            f"mount of {child!r} in {parent!r} is told anew, and otherwise",
            edge.topic,
            count=len(edge.changed_ns),
            effect="the latest counts, for the whole log",
            time_ns=edge.changed_ns,
        )
    for parent, child in tree.contradictions:
        losses.add(
            f"transform from {parent!r} to {child!r} contradicts others",
            survey.transforms.edges[parent, child].topic,
            effect="not used: check where the sensors are said to be",
        )


def laser_streams(
    survey: Survey,
    config: Config,
    mounts: Mounts,
    ahead_ns: int | None,
    log_name: str,
    losses: LossLedger,
) -> tuple[LaserStream, ...]:
    """How to read every scanner.

    ``ahead_ns`` is how far the odometry's stamps are ahead of the log's time, if there are any.

    Raises
    ------
    ConfigError
        A topic is not settled, or a mount unknown.
    NothingUsableError
        There are no scans, or not one return in them.
    """
    topics = laser_topics(survey, config, log_name)
    streams = [
        _laser_stream(topic, mounts, ahead_ns, log_name, losses)
        for topic in topics
        if isinstance(topic.record, LaserRecord)
    ]
    if not any(stream.record.any_return for stream in streams):
        names = ", ".join(topic.name for topic in topics)
        raise NothingUsableError(
            f"{log_name}: no laser returns: every range on {names} is missing or out of the "
            "scanner's limits. Check the scanner."
        )
    return tuple(streams)


def _laser_stream(
    topic: Topic, mounts: Mounts, ahead_ns: int | None, log_name: str, losses: LossLedger
) -> LaserStream:
    record = topic.record
    if not isinstance(record, LaserRecord):
        raise NothingUsableError(f"{log_name}: {topic.name} cannot be read ({topic.problem}).")
    times, own_ahead_ns = stream_times(
        record.stamp_ns,
        record.log_time_ns,
        topic.name,
        losses,
        reference_ahead_ns=ahead_ns,
    )
    if ahead_ns is not None:
        times = on_common_clock(times, own_ahead_ns, ahead_ns, topic.name, losses)
    _leave_out_odd_scans(record, times, losses)
    log_time_ns = np.array(record.log_time_ns, dtype=np.int64)
    sound = np.flatnonzero(times != DAMAGED)
    rising = increasing(times[sound])
    losses.add(
        "laser stamp runs backward or repeats",
        topic.name,
        count=int(np.count_nonzero(~rising)),
        effect="scan left out",
        time_ns=log_time_ns[sound[~rising]],
    )
    times[sound[~rising]] = DAMAGED
    if record.any_return:
        losses.add(
            "laser scan without a single return",
            topic.name,
            count=len(record.empty_ns),
            effect="tells nothing",
            time_ns=record.empty_ns,
        )
    found = {frame: mounts.mount(frame, f"laser {topic.name}") for frame in record.frame_ids}
    for frame, mount in found.items():
        if mount.tilt_rad > TILT_WARNING_RAD:
            losses.remark(
                f"laser frame {frame!r} is tilted by {np.degrees(mount.tilt_rad):.1f} degrees",
                topic.name,
                effect="its rays are projected on the floor",
            )
    return LaserStream(
        topic,
        record,
        times,
        _ray_interval_is_sound(record, times[times != DAMAGED], losses),
        record.longest_m,
        found,
    )


def _leave_out_odd_scans(record: LaserRecord, times: Times, losses: LossLedger) -> None:
    """Mark scans whose count of ranges fits their angles worse than is usual on the topic.

    Many drivers tell the last angle wrong, always in the same way; so what is usual is right.
    """
    surplus = np.array(record.surplus, dtype=np.int64)
    whole = times != DAMAGED
    if not np.any(whole):
        return
    values, counts = np.unique(surplus[whole], return_counts=True)
    odd = whole & (np.abs(surplus - values[np.argmax(counts)]) > 1)
    losses.add(
        "laser scan with more or fewer ranges than its angles tell",
        record.topic,
        count=int(np.count_nonzero(odd)),
        effect="scan left out",
        time_ns=np.array(record.log_time_ns, dtype=np.int64)[odd],
    )
    times[odd] = DAMAGED


def _ray_interval_is_sound(record: LaserRecord, times: Times, losses: LossLedger) -> bool:
    """Whether the rays of a sweep fit into the time from one sweep to the next."""
    if record.first is None or record.first.ray_interval_s == 0.0:
        return True
    sweep_s = record.first.ray_interval_s * (record.beams - 1)
    period_s = float(np.median(np.diff(times))) * 1e-9 if len(times) > 1 else np.inf
    if 0.0 <= sweep_s <= 1.1 * period_s:
        return True
    losses.remark(
        f"a sweep claims to take {sweep_s:.3g} s, but one comes every {period_s:.3g} s",
        record.topic,
        effect="all its rays are used at the time of the first",
    )
    return False
