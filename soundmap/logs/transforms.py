"""Transforms between frames as they come: fixed ones become mounts, one that moves is odometry."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from soundmap.geometry import Mount
from soundmap.logs.messages import Form, frame_name, ros_stamp_ns, timestamp_ns
from soundmap.logs.odometry import MIN_QUATERNION_NORM, OdometryRecord

STILL_M = 1e-6
"""A transform whose numbers vary by no more than this is fixed."""

Transform = tuple[str, str, int, tuple[float, ...]]
"""Parent, child, stamp [ns], and x, y, z, qx, qy, qz, qw."""


def _pose(translation: Any, rotation: Any) -> tuple[float, ...]:
    t, r = translation, rotation
    return (t.x, t.y, t.z, r.x, r.y, r.z, r.w)


def _stamped_transform(item: Any) -> Transform:
    return (
        frame_name(item.header.frame_id),
        frame_name(item.child_frame_id),
        ros_stamp_ns(item.header.stamp),
        _pose(item.transform.translation, item.transform.rotation),
    )


def _frame_transform(item: Any) -> Transform:
    return (
        frame_name(item.parent_frame_id),
        frame_name(item.child_frame_id),
        timestamp_ns(item.timestamp),
        _pose(item.translation, item.rotation),
    )


TRANSFORM_READERS: dict[Form, Callable[[Any], list[Transform]]] = {
    Form.STAMPED_TRANSFORMS: lambda message: [_stamped_transform(t) for t in message.transforms],
    Form.FRAME_TRANSFORM: lambda message: [_frame_transform(message)],
    Form.FRAME_TRANSFORMS: lambda message: [_frame_transform(t) for t in message.transforms],
}
"""What turns a decoded message of each layout into transforms."""


@dataclass
class Edge:
    """Transforms from one child to one parent.

    Attributes
    ----------
    first : tuple of float
        x, y, z and quaternion of the first sound one, or of the latest on a static topic.
    count : int
        Sound ones.
    moves : bool
        Whether they vary.
    not_finite : int
        Others.
    changed_ns : list of int
        When a static topic told otherwise than before [ns since epoch].
    topic : str
        Where the first came from.
    record : OdometryRecord
        All of them, unless they come from a static topic.
    """

    topic: str
    first: tuple[float, ...] = ()
    count: int = 0
    moves: bool = False
    not_finite: int = 0
    changed_ns: list[int] = field(default_factory=list)
    static: bool = False
    record: OdometryRecord = field(default_factory=OdometryRecord)


class TransformRecord:
    """All transforms of a log."""

    def __init__(self) -> None:
        self.edges: dict[tuple[str, str], Edge] = {}

    def add(
        self, topic: str, transforms: Iterable[Transform], log_time_ns: int, *, static: bool
    ) -> None:
        """Take in the transforms of one message."""
        for parent, child, stamp_ns, pose in transforms:
            edge = self.edges.get((parent, child))
            if edge is None:
                edge = self.edges[parent, child] = Edge(topic)
            if not static:
                edge.record.parent, edge.record.child = parent, child
                edge.record.add_transform(stamp_ns, log_time_ns, pose)
            if not _sound(pose):
                edge.not_finite += 1
                continue
            if static or not edge.count:
                if edge.count and _differ(pose, edge.first):
                    edge.changed_ns.append(log_time_ns)
                edge.first = pose
                edge.static |= static
            elif not edge.moves:
                edge.moves = _differ(pose, edge.first)
            edge.count += 1

    def fixed(self) -> dict[tuple[str, str], Mount]:
        """Mounts of all children that never move in their parent's frame."""
        return {
            names: Mount.from_quaternion(edge.first[:3], edge.first[3:])
            for names, edge in self.edges.items()
            if edge.count and (edge.static or not edge.moves) and names[0] != names[1]
        }

    def moving(self) -> dict[tuple[str, str], Edge]:
        """Transforms that vary."""
        return {n: e for n, e in self.edges.items() if e.count and e.moves and not e.static}


def _differ(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return any(abs(x - y) > STILL_M for x, y in zip(a, b, strict=True))


def _sound(pose: tuple[float, ...]) -> bool:
    return all(map(math.isfinite, pose)) and sum(q * q for q in pose[3:]) > MIN_QUATERNION_NORM**2
