"""How the base moved by its own account: poses where they are sound, the twist where they are not.

Some drivers fill only one of the two, and some publish NaN for the pose while the twist is fine.
"""

from __future__ import annotations

from array import array
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, Trajectory, composed, inverted, relative, wrapped_angle
from soundmap.logs.messages import frame_name, ros_stamp_ns
from soundmap.logs.stamps import increasing
from soundmap.losses import LossLedger

MIN_QUATERNION_NORM = 1e-3
"""A quaternion shorter than this was never set."""

JUMP_M, JUMP_RAD = 0.05, 0.1
"""A step must exceed this, beyond what the robot can drive in its time, to be a jump ..."""

MAX_SPEED, MAX_TURN_RATE = 3.0, 6.0
"""... at this speed [m/s] and turn rate [rad/s], or thrice those that it usually has ..."""

FEW_JUMPS = 0.05
"""... and steps that are too long must be rare."""


class OdometryReading(NamedTuple):
    """One odometry message.

    Attributes
    ----------
    stamp_ns : int
        0 if there is none.
    parent, child : str
        Frames.
    numbers : tuple of float
        Eleven: x, y, z [m], quaternion x, y, z, w, velocity x, y, z [m/s] and turn rate [rad/s] in
        the base frame.
    """

    stamp_ns: int
    parent: str
    child: str
    numbers: tuple[float, ...]


def odometry_reading(message: Any) -> OdometryReading:
    """What a decoded odometry message tells."""
    p, q = message.pose.pose.position, message.pose.pose.orientation
    v, w = message.twist.twist.linear, message.twist.twist.angular
    return OdometryReading(
        ros_stamp_ns(message.header.stamp),
        frame_name(message.header.frame_id),
        frame_name(message.child_frame_id),
        (p.x, p.y, p.z, q.x, q.y, q.z, q.w, v.x, v.y, v.z, w.z),
    )


class OdometryRecord:
    """Odometry messages of one topic as they come, compactly.

    Attributes
    ----------
    stamp_ns, log_time_ns : array of int
    numbers : array of float
        Eleven a message: those of `OdometryReading`.
    parent, child : str
        Frames named by the first message.
    """

    def __init__(self, parent: str = "", child: str = "") -> None:
        self.stamp_ns = array("q")
        self.log_time_ns = array("q")
        self.numbers = array("d")
        self.parent, self.child = parent, child

    def add(self, reading: OdometryReading, log_time_ns: int) -> None:
        """Take in an odometry message."""
        if not self.stamp_ns:
            self.parent, self.child = reading.parent, reading.child
        self._add(reading.stamp_ns, log_time_ns, reading.numbers)

    def add_transform(self, stamp_ns: int, log_time_ns: int, pose: tuple[float, ...]) -> None:
        """Take in a transform: x, y, z and quaternion; there is no twist."""
        self._add(stamp_ns, log_time_ns, (*pose, np.nan, np.nan, np.nan, np.nan))

    def _add(self, stamp_ns: int, log_time_ns: int, numbers: tuple[float, ...]) -> None:
        self.stamp_ns.append(stamp_ns)
        self.log_time_ns.append(log_time_ns)
        self.numbers.extend(numbers)

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def table(self) -> FloatArray:
        """The numbers, shape (K, 11)."""
        return np.frombuffer(self.numbers, dtype=np.float64).reshape(-1, 11).copy()


def odometry_trajectory(
    time_ns: NDArray[np.int64],
    numbers: FloatArray,
    topic: str,
    losses: LossLedger,
    *,
    logged_ns: NDArray[np.int64],
) -> tuple[Trajectory, str]:
    """The base in the odometry frame, and whether that is by "pose" or "twist".

    Parameters
    ----------
    time_ns : ndarray of int64, shape (K,)
        As recorded [ns since epoch].
    numbers : ndarray, shape (K, 11)
        As :class:`OdometryRecord` has them.
    topic : str
        For the losses.
    losses : LossLedger
        Where messages left out and poses replaced are counted.
    logged_ns : ndarray of int64, shape (K,)
        When the messages were logged: the times of losses.
    """
    rising = increasing(time_ns)
    losses.add(
        "odometry stamp runs backward or repeats",
        topic,
        count=int(np.count_nonzero(~rising)),
        effect="message left out",
        time_ns=logged_ns[~rising],
    )
    time_ns, numbers, logged_ns = time_ns[rising], numbers[rising], logged_ns[rising]
    pose, sound = _planar_poses(numbers)
    twist = numbers[:, [7, 8, 10]]
    moving = np.all(np.isfinite(twist), axis=1)
    if _never_filled(pose, sound, twist, moving):
        moving[:] = False
    bad = ~sound
    by_twist = bad & moving
    losses.add(
        "odometry pose is not finite",
        topic,
        count=int(np.count_nonzero(by_twist)),
        effect="motion taken from the twist",
        time_ns=logged_ns[by_twist],
    )
    losses.add(
        "odometry pose is not finite, nor is the twist usable",
        topic,
        count=int(np.count_nonzero(bad & ~moving)),
        effect="message left out",
        time_ns=logged_ns[bad & ~moving],
    )
    keep = sound | moving
    time_ns, pose, sound, twist = time_ns[keep], pose[keep], sound[keep], twist[keep]
    twist = np.where(moving[keep][:, None], twist, np.nan)
    if not np.all(sound):
        pose = _bridged(time_ns, pose, sound, twist)
    pose, jumps = _without_jumps(time_ns, pose, twist)
    losses.add(
        "odometry jumps",
        topic,
        count=len(jumps),
        effect="taken for a reset: motion as before it",
        time_ns=logged_ns[keep][jumps],
    )
    source = "twist" if np.count_nonzero(by_twist) > np.count_nonzero(sound) else "pose"
    return Trajectory(time_ns, pose, np.ones(len(time_ns), dtype=bool)), source


def _planar_poses(numbers: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """x, y, heading, shape (K, 3), and whether they are sound, shape (K,)."""
    x, y, z, w = numbers[:, 3:7].T
    with np.errstate(invalid="ignore", over="ignore"):
        norm = np.sqrt(x * x + y * y + z * z + w * w)
        heading = np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
        pose = np.stack([numbers[:, 0], numbers[:, 1], heading], axis=-1)
        sound = np.all(np.isfinite(pose), axis=1) & (norm > MIN_QUATERNION_NORM)
        sound &= np.isfinite(norm) & np.all(np.abs(pose) < 1e7, axis=1)
    return pose, sound


def _never_filled(
    pose: FloatArray, sound: NDArray[np.bool_], twist: FloatArray, finite: NDArray[np.bool_]
) -> bool:
    """Whether the twist is nought all along although the poses move: the driver leaves it out."""
    if np.any(twist[finite] != 0.0):
        return False
    reached = pose[sound]
    return len(reached) > 1 and bool(np.any(np.ptp(reached, axis=0)[:2] > 0.01))


def _bridged(
    time_ns: NDArray[np.int64], pose: FloatArray, sound: NDArray[np.bool_], twist: FloatArray
) -> FloatArray:
    """Poses with every interval that touches an unsound one replaced by motion from the twist.

    All messages have a sound pose or a finite twist. Where sound poses return, what the twist
    missed on the way is spread over the gap, unless it is so much that the pose was reset.
    """
    dt = np.diff(time_ns) * 1e-9
    driven = _driven(twist, dt)
    good = np.flatnonzero(sound)
    if not len(good):
        return _path(driven)
    result = pose.copy()
    first = int(good[0])
    # Before the first sound pose: drive backward from it.
    path = _path(driven[:first])
    result[: first + 1] = composed(composed(pose[first], inverted(path[-1])), path)
    shift = np.zeros(3)  # From the frame of the recorded poses to that of the result.
    for a, b in zip(good.tolist(), [*good[1:].tolist(), len(pose)], strict=True):
        result[a] = composed(shift, pose[a])
        if b == a + 1:
            continue
        path = _path(driven[a : min(b, len(pose) - 1)])
        reached = composed(result[a], path)
        result[a : a + len(path)] = reached
        if b == len(pose):
            break
        wanted = composed(shift, pose[b])
        miss = relative(reached[-1], wanted)
        length = float(np.sum(np.hypot(*np.diff(path[:, :2], axis=0).T)))
        if np.hypot(miss[0], miss[1]) < 0.1 + 0.2 * length and abs(miss[2]) < 0.3:
            share = ((time_ns[a : b + 1] - time_ns[a]) / (time_ns[b] - time_ns[a]))[:, None]
            moved = reached[:, :2] + share * (wanted - reached[-1])[:2]
            heading = wrapped_angle(reached[:, 2] + share[:, 0] * miss[2])
            result[a : b + 1] = np.concatenate([moved, heading[:, None]], axis=1)
        else:
            shift = composed(reached[-1], inverted(pose[b]))
    return result


def _without_jumps(
    time_ns: NDArray[np.int64], pose: FloatArray, twist: FloatArray
) -> tuple[FloatArray, NDArray[np.intp]]:
    """Poses with steps that no robot makes replaced, and the indices of the poses after them.

    Odometry that was reset goes on from elsewhere: what follows is moved so that the robot, over
    the jump, drives by its twist, else as in the step before.
    """
    if len(pose) < 3:
        return pose, np.zeros(0, dtype=np.intp)
    step = relative(pose[:-1], pose[1:])
    dt = np.diff(time_ns) * 1e-9
    # A stamp that came late makes the next step look fast.
    lasted = np.maximum(dt, np.quantile(dt, 0.95))
    distance, turn = np.hypot(step[:, 0], step[:, 1]), np.abs(step[:, 2])
    usual = [float(np.quantile(size / lasted, 0.95)) for size in (distance, turn)]
    jumps = np.flatnonzero(
        (distance > JUMP_M + np.maximum(MAX_SPEED, 3.0 * usual[0]) * lasted)
        | (turn > JUMP_RAD + np.maximum(MAX_TURN_RATE, 3.0 * usual[1]) * lasted)
    )
    if len(jumps) > FEW_JUMPS * len(step):
        return pose, np.zeros(0, dtype=np.intp)  # that is how this odometry is
    driven = _driven(twist, dt)
    told = np.all(np.isfinite(twist), axis=1)
    known: NDArray[np.bool_] = np.asarray(told[:-1] | told[1:])
    result = pose.copy()
    for i in jumps.tolist():
        before = max(i - 1, 0)
        coasting = step[before] * (dt[i] / lasted[before]) if before not in jumps else np.zeros(3)
        wanted = composed(result[i], driven[i] if known[i] else coasting)
        shift = composed(wanted, inverted(result[i + 1]))
        result[i + 1 :] = composed(shift, result[i + 1 :])
    return result, jumps + 1


def _driven(twist: FloatArray, dt: FloatArray) -> FloatArray:
    """Motion between neighbours, shape (K - 1, 3): along an arc at the mean of both twists."""
    before, after = twist[:-1], twist[1:]
    mean = np.where(
        np.isnan(before), after, np.where(np.isnan(after), before, 0.5 * (before + after))
    )
    mean = np.nan_to_num(mean, nan=0.0)
    turn = mean[:, 2] * dt
    chord = np.sinc(turn / (2.0 * np.pi)) * dt  # of an arc of unit speed
    cos, sin = np.cos(0.5 * turn) * chord, np.sin(0.5 * turn) * chord
    x = cos * mean[:, 0] - sin * mean[:, 1]
    y = sin * mean[:, 0] + cos * mean[:, 1]
    return np.stack([x, y, turn], axis=-1)


def _path(steps: FloatArray) -> FloatArray:
    """Poses from the origin along the steps, shape (K + 1, 3)."""
    heading = np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    cos, sin = np.cos(heading[:-1]), np.sin(heading[:-1])
    x = np.cumsum(cos * steps[:, 0] - sin * steps[:, 1])
    y = np.cumsum(sin * steps[:, 0] + cos * steps[:, 1])
    return np.stack(
        [np.concatenate([[0.0], x]), np.concatenate([[0.0], y]), wrapped_angle(heading)], axis=-1
    )
