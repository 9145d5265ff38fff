"""Poses in the plane and where the robot was when. SE(2), metres and radians."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
CHI_SQUARED_95 = 5.991
"""95 % of a normal distribution in the plane lie within this squared distance (2 degrees of
freedom)."""


def wrapped_angle(angle: ArrayLike) -> FloatArray:
    """Angle in [-pi, pi) [rad], any shape.

    Examples
    --------
    >>> float(wrapped_angle(np.pi * 1.5)) == -np.pi / 2
    True
    """
    return (np.asarray(angle, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi


def composed(first: ArrayLike, second: ArrayLike) -> FloatArray:
    """Pose ``first`` followed by ``second`` given in the frame of ``first``.

    Parameters
    ----------
    first, second : array_like, shapes (..., 3)
        Poses x [m], y [m], heading [rad]; broadcast against each other.

    Returns
    -------
    ndarray, shape (..., 3)
        Heading in [-pi, pi).

    Examples
    --------
    >>> composed([1.0, 0.0, np.pi / 2], [2.0, 0.0, 0.0]).round(6).tolist()
    [1.0, 2.0, 1.570796]
    """
    first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    cos, sin = np.cos(first[..., 2]), np.sin(first[..., 2])
    return np.stack(
        [
            first[..., 0] + cos * second[..., 0] - sin * second[..., 1],
            first[..., 1] + sin * second[..., 0] + cos * second[..., 1],
            wrapped_angle(first[..., 2] + second[..., 2]),
        ],
        axis=-1,
    )


def inverted(pose: ArrayLike) -> FloatArray:
    """Inverse of poses, shape (..., 3): ``composed(inverted(p), p)`` is the identity."""
    pose = np.asarray(pose, dtype=np.float64)
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    return np.stack(
        [
            -cos * pose[..., 0] - sin * pose[..., 1],
            sin * pose[..., 0] - cos * pose[..., 1],
            wrapped_angle(-pose[..., 2]),
        ],
        axis=-1,
    )


def relative(origin: ArrayLike, pose: ArrayLike) -> FloatArray:
    """``pose`` as seen from ``origin``, both given in one frame; shapes (..., 3)."""
    return composed(inverted(origin), pose)


def transformed(pose: ArrayLike, points: ArrayLike) -> FloatArray:
    """Points of the frame at ``pose`` taken to the frame that ``pose`` is given in.

    Parameters
    ----------
    pose : array_like, shape (..., 3)
    points : array_like, shape (..., 2)
        [m]; leading axes broadcast against those of ``pose``.
    """
    pose, points = np.asarray(pose, dtype=np.float64), np.asarray(points, dtype=np.float64)
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    return np.stack(
        [
            pose[..., 0] + cos * points[..., 0] - sin * points[..., 1],
            pose[..., 1] + sin * points[..., 0] + cos * points[..., 1],
        ],
        axis=-1,
    )


@dataclass(frozen=True)
class Mount:
    """Where a sensor sits on the robot: the rigid transform from its frame to the base frame.

    Attributes
    ----------
    rotation : ndarray, shape (3, 3)
        Rotation matrix, sensor axes in the base frame.
    translation_m : ndarray, shape (3,)
        Origin of the sensor in the base frame [m].
    """

    rotation: FloatArray
    translation_m: FloatArray

    def __post_init__(self) -> None:
        if self.rotation.shape != (3, 3) or self.translation_m.shape != (3,):
            raise ValueError("a mount is a (3, 3) rotation and a (3,) translation")
        if not np.allclose(self.rotation @ self.rotation.T, np.eye(3), atol=1e-6):
            raise ValueError("the rotation of a mount must be orthonormal")

    @classmethod
    def planar(cls, x_m: float, y_m: float, z_m: float, yaw_rad: float) -> Mount:
        """A mount that is level: position [m] and yaw [rad] in the base frame."""
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return cls(rotation, np.array([x_m, y_m, z_m], dtype=np.float64))

    @classmethod
    def from_quaternion(cls, translation_m: ArrayLike, quaternion_xyzw: ArrayLike) -> Mount:
        """A mount from a translation [m] and a quaternion x, y, z, w (normalised here)."""
        x, y, z, w = np.asarray(quaternion_xyzw, dtype=np.float64)
        norm = np.sqrt(x * x + y * y + z * z + w * w)
        if not norm > 1e-9:
            raise ValueError("a quaternion of zero length is no rotation")
        x, y, z, w = x / norm, y / norm, z / norm, w / norm
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        return cls(rotation, np.asarray(translation_m, dtype=np.float64))

    def __matmul__(self, inner: Mount) -> Mount:
        """The mount of a frame whose mount in this sensor's frame is ``inner``."""
        return Mount(
            self.rotation @ inner.rotation,
            self.rotation @ inner.translation_m + self.translation_m,
        )

    def turned(self, yaw_rad: float) -> Mount:
        """The mount turned about the vertical, counter-clockwise seen from above [rad]."""
        turn = Mount.planar(0.0, 0.0, 0.0, yaw_rad)
        return Mount(turn.rotation @ self.rotation, self.translation_m)

    def inverse(self) -> Mount:
        """The transform from the base frame to the sensor's."""
        return Mount(self.rotation.T, -self.rotation.T @ self.translation_m)

    @property
    def yaw_rad(self) -> float:
        """Direction of the sensor's x axis, projected on the floor [rad]."""
        return float(np.arctan2(self.rotation[1, 0], self.rotation[0, 0]))

    @property
    def handedness(self) -> int:
        """+1 if the sensor stands upright, -1 if it hangs upside down (bearings run clockwise)."""
        return 1 if self.rotation[2, 2] >= 0 else -1

    @property
    def tilt_rad(self) -> float:
        """Angle between the sensor's plane and the floor [rad], 0 for upright or upside down."""
        return float(np.arccos(np.clip(abs(self.rotation[2, 2]), 0.0, 1.0)))

    def base_bearing(self, bearing_rad: ArrayLike) -> FloatArray:
        """Bearings in the sensor's plane [rad] as bearings in the base frame [rad]."""
        bearing = np.asarray(bearing_rad, dtype=np.float64)
        direction = self.rotation[:2, 0, None] * np.cos(bearing.ravel())
        direction = direction + self.rotation[:2, 1, None] * np.sin(bearing.ravel())
        return np.arctan2(direction[1], direction[0]).reshape(bearing.shape)

    def base_points(self, bearing_rad: ArrayLike, range_m: ArrayLike) -> FloatArray:
        """Points at bearing and range in the sensor's plane, projected on the floor.

        Returns
        -------
        ndarray, shape (..., 2)
            x, y in the base frame [m].
        """
        bearing = np.asarray(bearing_rad, dtype=np.float64)
        ranges = np.asarray(range_m, dtype=np.float64)
        x, y = ranges * np.cos(bearing), ranges * np.sin(bearing)
        r, t = self.rotation, self.translation_m
        return np.stack([r[0, 0] * x + r[0, 1] * y + t[0], r[1, 0] * x + r[1, 1] * y + t[1]], -1)


@dataclass(frozen=True)
class Trajectory:
    """Where the robot's base was, at increasing times.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (K,)
        Strictly increasing [ns since epoch].
    pose : ndarray, shape (K, 3)
        x [m], y [m], heading [rad] of the base in the frame of the trajectory (map or odometry).
    usable : ndarray of bool, shape (K,)
        Whether the pose may be trusted: particles concentrated and laser scans matching the map.
    covariance : ndarray, shape (K, 3, 3), or None
        Of x, y [m] and heading [rad], where it is known.
    is_scan : ndarray of bool, shape (K,), or None
        Which poses are those of laser scans; where scans are rare, odometry carries others between
        them. None: all.
    """

    time_ns: NDArray[np.int64]
    pose: FloatArray
    usable: NDArray[np.bool_]
    covariance: FloatArray | None = None
    is_scan: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        count = len(self.time_ns)
        if self.is_scan is not None and self.is_scan.shape != (count,):
            raise ValueError("a trajectory needs to say of each pose whether it is a scan's")
        if self.covariance is not None and self.covariance.shape != (count, 3, 3):
            raise ValueError("a trajectory needs one covariance (3, 3) a time")
        if self.pose.shape != (count, 3) or self.usable.shape != (count,):
            raise ValueError("a trajectory needs one pose (3,) and one flag a time")
        if count and not (np.all(np.diff(self.time_ns) > 0) and np.all(np.isfinite(self.pose))):
            raise ValueError("a trajectory needs increasing times and finite poses")

    def __len__(self) -> int:
        return len(self.time_ns)

    def at(self, time_ns: ArrayLike) -> FloatArray:
        """Pose at any time, between the two neighbours; the heading takes the short way round.

        Parameters
        ----------
        time_ns : array_like of int, shape (...)

        Returns
        -------
        ndarray, shape (..., 3)
            NaN outside the time that the trajectory spans.
        """
        wanted = np.asarray(time_ns, dtype=np.int64)
        if len(self) == 0:
            return np.full((*wanted.shape, 3), np.nan)
        left = np.clip(np.searchsorted(self.time_ns, wanted, side="right") - 1, 0, len(self) - 1)
        right = np.minimum(left + 1, len(self) - 1)
        step = np.maximum(self.time_ns[right] - self.time_ns[left], 1)
        share = ((wanted - self.time_ns[left]) / step)[..., None]
        start, end = self.pose[left], self.pose[right]
        pose = start + share * (end - start)
        turn = wrapped_angle(end[..., 2] - start[..., 2])
        pose[..., 2] = wrapped_angle(start[..., 2] + share[..., 0] * turn)
        outside = (wanted < self.time_ns[0]) | (wanted > self.time_ns[-1])
        return np.where(outside[..., None], np.nan, pose)

    def of_scans(self) -> Trajectory:
        """The poses of laser scans alone."""
        if self.is_scan is None:
            return self
        covariance = None if self.covariance is None else self.covariance[self.is_scan]
        kept = self.is_scan
        return Trajectory(self.time_ns[kept], self.pose[kept], self.usable[kept], covariance)

    def driven_m(self) -> FloatArray:
        """Distance driven from the first pose to each, along the poses [m], shape (K,)."""
        step = np.diff(self.pose[:, :2], axis=0)
        return np.concatenate([np.zeros(min(len(self), 1)), np.cumsum(np.hypot(*step.T))])

    def extent_m(self) -> float:
        """Diagonal of the smallest upright rectangle that holds all poses to be trusted [m]."""
        place = self.pose[self.usable, :2]
        return float(np.hypot(*np.ptp(place, axis=0))) if len(place) else 0.0

    def usable_at(self, time_ns: ArrayLike) -> NDArray[np.bool_]:
        """Whether the poses on both sides of each time may be trusted; False outside the span."""
        wanted = np.asarray(time_ns, dtype=np.int64)
        if len(self) == 0:
            return np.zeros(wanted.shape, dtype=bool)
        left = np.clip(np.searchsorted(self.time_ns, wanted, side="right") - 1, 0, len(self) - 1)
        right = np.minimum(left + 1, len(self) - 1)
        inside = (wanted >= self.time_ns[0]) & (wanted <= self.time_ns[-1])
        return inside & self.usable[left] & self.usable[right]
