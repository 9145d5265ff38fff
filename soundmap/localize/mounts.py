r"""How far the laser scanners sit from where the log says, by the scans and the odometry of a run.

Each scanner's returns lie a little off the walls that all of them draw together; that tells the
scanners' mounts relative to one another. What all of them share moves the whole trajectory instead,
and shows in the odometry: with the base at :math:`P_k X` where the scans put it at :math:`P_k`, a
step :math:`B` between two of these poses is :math:`X^{-1} B X` for the wheels (the equation
:math:`A X = X B` of hand-eye calibration). Turns tell the place of X and straight ways its heading.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, composed, inverted, relative, transformed, wrapped_angle
from soundmap.localize.smoothing import ScanEvidence
from soundmap.localize.views import Views

PIECE_M, PIECE_RAD = 0.5, 0.5
"""Way and turn of the steps that are compared with the odometry."""
STEP_SIGMA_M = 0.02
"""Standard deviation of such a step, scans and odometry together [m]."""
USUAL_M, USUAL_RAD = 0.1, np.radians(5.0)
"""How wrong mounts usually are at most; holds what a run does not tell near zero."""


@dataclass(frozen=True)
class MountOffset:
    """By how much a scanner's mount differs from the one in the log.

    Attributes
    ----------
    scanner : int
    offset : ndarray, shape (3,)
        x, y [m] and yaw [rad] in the base frame: the true mount is this motion after the log's.
    """

    scanner: int
    offset: FloatArray

    def __str__(self) -> str:
        x, y, yaw = self.offset
        return (
            f"laser {self.scanner + 1} seems to sit {100 * x:+.1f} cm ahead, {100 * y:+.1f} cm "
            f"left and {np.degrees(yaw):+.1f} degrees from where the log says"
        )


def mount_offsets(
    views: Views, pose: FloatArray, trusted: NDArray[np.bool_], evidence: ScanEvidence
) -> tuple[list[MountOffset], FloatArray]:
    """What the mounts are still off by, to first order; and the poses of the base with that undone.

    Parameters
    ----------
    views : Views
    pose : ndarray, shape (K, 3)
        Of the base in the map frame.
    trusted : ndarray of bool, shape (K,)
    evidence : ScanEvidence
        What the scans say about poses.
    """
    information, pull = _in_base_frame(*evidence(pose), pose)
    shared = _shared_offset(views, pose, trusted)
    found = []
    for scanner in np.unique(views.scanner):
        own = trusted & (views.scanner == scanner)
        held = np.diag([USUAL_M, USUAL_M, USUAL_RAD]) ** 2
        matrix = information[own].sum(axis=0) + np.linalg.inv(held)
        offset = np.linalg.solve(matrix, pull[own].sum(axis=0))
        found.append(MountOffset(int(scanner), composed(inverted(shared), offset)))
    return found, composed(pose, shared)


def remounted(views: Views, offsets: list[MountOffset]) -> Views:
    """The views with every scanner's rays moved by the offset of its mount."""
    origin, end = views.origin_m.copy(), views.end_m.copy()
    of_ray = np.repeat(views.scanner, np.diff(views.first))
    for each in offsets:
        own = of_ray == each.scanner
        origin[own] = transformed(each.offset, origin[own])
        end[own] = transformed(each.offset, end[own])
    return replace(views, origin_m=origin, end_m=end)


def added(before: list[MountOffset], more: list[MountOffset]) -> list[MountOffset]:
    """Offsets of all scanners after others were found on top of them."""
    if not before:
        return more
    return [
        MountOffset(old.scanner, composed(new.offset, old.offset))
        for old, new in zip(before, more, strict=True)
    ]


def _in_base_frame(
    information: FloatArray, pull: FloatArray, pose: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Normal equations of moving each pose along its own axes instead of the map's."""
    cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    turn = np.zeros((len(pose), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = cos
    turn[:, 0, 1], turn[:, 1, 0] = -sin, sin
    turn[:, 2, 2] = 1.0
    back = turn.swapaxes(1, 2)
    return back @ information @ turn, np.einsum("kij,kj->ki", back, pull)


def _shared_offset(views: Views, pose: FloatArray, trusted: NDArray[np.bool_]) -> FloatArray:
    """X, shape (3,): the base by odometry as seen from the base by the scans."""
    known = np.flatnonzero(trusted)
    turned = np.cumsum(np.abs(np.diff(np.unwrap(views.odometry[:, 2]), prepend=0.0)))
    piece = np.floor(views.driven_m / PIECE_M + turned / PIECE_RAD)[known]
    ends = known[np.flatnonzero(np.append(True, np.diff(piece) > 0))]
    if len(ends) < 2:
        return np.zeros(3)
    scans = relative(pose[ends[:-1]], pose[ends[1:]])
    wheels = relative(views.odometry[ends[:-1]], views.odometry[ends[1:]])
    # A turn that the wheels did not notice bends the way by half of it.
    bend = 0.5 * wrapped_angle(scans[:, 2] - wheels[:, 2])
    wheels = composed(np.column_stack([np.zeros((len(bend), 2)), bend]), wheels)
    # wheels = scans + (R - 1) place - heading * (scans turned left) - scale * scans, to first order
    cos, sin = np.cos(scans[:, 2]), np.sin(scans[:, 2])
    along = np.column_stack([cos - 1.0, -sin, scans[:, 1], -scans[:, 0]])
    across = np.column_stack([sin, cos - 1.0, -scans[:, 0], -scans[:, 1]])
    matrix = np.concatenate([along, across])
    off = (wheels[:, :2] - scans[:, :2]).T.ravel()
    prior = (STEP_SIGMA_M / np.array([USUAL_M, USUAL_M, USUAL_RAD, 0.1])) ** 2
    robust = np.ones(len(off))
    for _ in range(5):  # wheels slip: Cauchy's weights
        weighted = matrix * robust[:, None]
        found = np.linalg.solve(weighted.T @ matrix + np.diag(prior), weighted.T @ off)
        left = (off - matrix @ found).reshape(2, -1) / STEP_SIGMA_M
        robust = np.tile(1.0 / (1.0 + np.sum(left**2, axis=0)), 2)
    return found[:3]
