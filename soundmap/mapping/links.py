"""From how scans lie on one another, and from odometry, to links of the pose graph."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, relative
from soundmap.mapping.alignment import PairFits
from soundmap.mapping.key_scans import KeyScan
from soundmap.mapping.pose_graph import Links
from soundmap.odometry_model import OdometryModel

PAIR_SIGMA = np.array([0.01, 0.01, np.radians(0.2)])
"""No two scans tell their relative pose better than this [m, m, rad]: mounts, tilt, timing."""
WEAKEST = 1.0
"""Information added where surfaces say nothing, so that a corridor stays loose but solvable."""
MOST_STEP_M = 0.3
SLIP_M_PER_RAD = 0.05
"""A turn moves the base by so much unawares: wheels slip, and stamps are late [m/rad]."""


def scan_links(
    pose: FloatArray, pairs: NDArray[np.int64], fits: PairFits, *, least_matched: int
) -> Links:
    """Links of the pairs of scans that lie on one another well enough.

    Parameters
    ----------
    pose : ndarray, shape (K, 3)
        At which the pairs were fitted.
    pairs : ndarray of int64, shape (M, 2)
    fits : PairFits
    least_matched : int
        Returns that must have met a surface.
    """
    hessian = fits.information + WEAKEST * np.eye(3)
    step = -np.linalg.solve(hessian, fits.gradient[..., None])[..., 0]
    good = (fits.matched >= least_matched) & (np.hypot(step[:, 0], step[:, 1]) < MOST_STEP_M)
    measured = relative(pose[pairs[:, 1]], pose[pairs[:, 0]]) + step
    return Links(pairs[good], measured[good], _limited(fits.information[good]))


def odometry_links(scans: Sequence[KeyScan], model: OdometryModel, first: int = 0) -> Links:
    """Links between consecutive key scans, from number ``first`` on."""
    index = np.arange(first + 1, len(scans))
    pairs = np.stack([index, index - 1], axis=-1)
    if len(index) == 0:
        return Links(pairs.reshape(0, 2), np.empty((0, 3)), np.empty((0, 3, 3)))
    odometry = np.array([scan.odometry for scan in scans])
    driven = np.array([scan.driven_m for scan in scans])
    turned = np.array([scan.turned_rad for scan in scans])
    way, turn = driven[index] - driven[index - 1], turned[index] - turned[index - 1]
    information = model.information(way, turn)
    slip = 1.0 / (1.0 + information[:, 0, 0] * (SLIP_M_PER_RAD * turn) ** 2)
    information[:, [0, 1], [0, 1]] *= slip[:, None]
    step = model.corrected(relative(odometry[index - 1], odometry[index]))
    return Links(pairs, step, information)


def _limited(information: FloatArray) -> FloatArray:
    """Information with `PAIR_SIGMA` added to the errors."""
    floor = np.diag(PAIR_SIGMA**-2.0)
    return floor - floor @ np.linalg.solve(
        information + floor, np.broadcast_to(floor, information.shape)
    )
