r"""The whole trajectory at once: odometry between poses, laser points on the map.

Maximises over all poses together what the particle filter weighs one scan at a time. Both kinds of
evidence are linearised about the present poses; since each pose is tied only to its neighbours, the
normal equations are block-tridiagonal, and solving them costs the same per pose however long the
run is (Lu and Milios, Autonomous Robots 4, 1997, for a chain of poses).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, composed, relative, wrapped_angle

STEPS = 6
"""Most Gauss-Newton steps; poses a decimetre off take three or four."""
SETTLED_M = 0.0005
SYSTEMATIC = (0.03, 0.03, 0.01)
"""Standard deviations of what stays unknown of the odometry's scale [m/m], scale of turns [rad/rad]
and turn per way [rad/m] after both have been learnt from the run."""
SLIP_CHI2 = 3.0
"""A step this surprising, as a squared Mahalanobis distance, has half its weight."""

ScanEvidence = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""What the laser scans say about poses (K, 3): information (K, 3, 3) and pull (K, 3)."""


@dataclass(frozen=True)
class SmoothedPoses:
    """Poses in the map frame, shape (K, 3), and their covariances, shape (K, 3, 3)."""

    pose: FloatArray
    covariance: FloatArray


def smoothed_poses(
    step: FloatArray, weight: FloatArray, pose: FloatArray, scans: ScanEvidence
) -> SmoothedPoses:
    """Most likely poses given all odometry and laser scans.

    The covariance includes what `SYSTEMATIC` errors of the odometry would do: along a featureless
    corridor they add up, where independent errors of the steps would cancel.

    Parameters
    ----------
    step : ndarray, shape (K - 1, 3)
        Motion from each pose to the next according to the odometry, in the frame of the first.
    weight : ndarray, shape (K - 1, 3, 3)
        Information of the steps, in the same frame.
    pose : ndarray, shape (K, 3)
        First guess, in the map frame.
    scans : ScanEvidence
    """
    guess = pose.copy()
    for _ in range(STEPS):
        information, pull = scans(guess)
        chain = _linearised(guess, step, weight)
        diagonal = chain.diagonal + information
        change = _solved(diagonal, chain.coupling, chain.pull(chain.error) + pull)
        guess = guess + change
        guess[:, 2] = wrapped_angle(guess[:, 2])
        if np.abs(change[:, :2]).max() < SETTLED_M:
            break
    covariance = _marginal_covariance(diagonal, chain.coupling)
    for error in _systematic_errors(step):
        shift = _solved(diagonal, chain.coupling, chain.pull(error))
        covariance += shift[:, :, None] * shift[:, None, :]
    return SmoothedPoses(guess, covariance)


def _systematic_errors(step: FloatArray) -> list[FloatArray]:
    """What each of the `SYSTEMATIC` errors adds to the steps, shapes (K - 1, 3)."""
    scale, turn_scale, turn_per_metre = SYSTEMATIC
    way_m = np.hypot(step[:, 0], step[:, 1])
    return [
        scale * step * [1.0, 1.0, 0.0],
        turn_scale * step * [0.0, 0.0, 1.0],
        turn_per_metre * way_m[:, None] * [0.0, 0.0, 1.0],
    ]


@dataclass(frozen=True)
class _Chain:
    """The odometry's part of the normal equations.

    Attributes
    ----------
    error : ndarray, shape (K - 1, 3)
        Steps between the poses less those of the odometry.
    diagonal : ndarray, shape (K, 3, 3)
    coupling : ndarray, shape (K - 1, 3, 3)
        The blocks beside the diagonal.
    before, after : ndarray, shapes (K - 1, 3, 3)
        Transposed Jacobians by the pose at either end of a step, times its information.
    """

    error: FloatArray
    diagonal: FloatArray
    coupling: FloatArray
    before: FloatArray
    after: FloatArray

    def pull(self, error: FloatArray) -> FloatArray:
        """The right-hand side that errors of the steps, shape (K - 1, 3), make, shape (K, 3)."""
        right = np.zeros((len(self.diagonal), 3))
        right[:-1] -= np.einsum("kij,kj->ki", self.before, error)
        right[1:] -= np.einsum("kij,kj->ki", self.after, error)
        return right


def _linearised(pose: FloatArray, step: FloatArray, weight: FloatArray) -> _Chain:
    before, after = pose[:-1], pose[1:]
    error = relative(before, after) - step
    error[:, 2] = wrapped_angle(error[:, 2])
    # Cauchy's weights: wheels that slip once must not bend the poses around.
    surprise = np.einsum("ki,kij,kj->k", error, weight, error)
    weight = weight / (1.0 + surprise / SLIP_CHI2)[:, None, None]
    cos, sin = np.cos(before[:, 2]), np.sin(before[:, 2])
    dx, dy = (after - before)[:, 0], (after - before)[:, 1]
    by_after = np.zeros((len(step), 3, 3))
    by_after[:, 0, 0] = by_after[:, 1, 1] = cos
    by_after[:, 0, 1], by_after[:, 1, 0] = sin, -sin
    by_after[:, 2, 2] = 1.0
    by_before = -by_after
    by_before[:, 0, 2] = -sin * dx + cos * dy
    by_before[:, 1, 2] = -cos * dx - sin * dy
    left_before = by_before.swapaxes(1, 2) @ weight
    left_after = by_after.swapaxes(1, 2) @ weight
    diagonal = np.tile(1e-9 * np.eye(3), (len(pose), 1, 1))
    diagonal[:-1] += left_before @ by_before
    diagonal[1:] += left_after @ by_after
    return _Chain(error, diagonal, left_before @ by_after, left_before, left_after)


def _solved(diagonal: FloatArray, coupling: FloatArray, right: FloatArray) -> FloatArray:
    """Solution of the block-tridiagonal system, shape (K, 3)."""
    from scipy.linalg import solveh_banded

    count = len(diagonal)
    band = np.zeros((6, 3 * count))  # lower form: band[i - j, j] = matrix[i, j]
    for row in range(3):
        for column in range(row + 1):
            band[row - column, column::3] = diagonal[:, row, column]
        for column in range(3):  # matrix[3 (k + 1) + row, 3 k + column] = coupling[k, column, row]
            band[3 + row - column, column : 3 * count - 3 : 3] = coupling[:, column, row]
    return solveh_banded(band, right.ravel(), lower=True).reshape(-1, 3)


@njit(cache=True, nogil=True)
def _marginal_covariance(diagonal: FloatArray, coupling: FloatArray) -> FloatArray:
    """Covariance of each pose, shape (K, 3, 3): the diagonal blocks of the system's inverse."""
    forward, backward = diagonal.copy(), diagonal.copy()
    for k in range(len(coupling)):
        _eliminate(forward[k], coupling[k], forward[k + 1])
    for k in range(len(coupling) - 1, -1, -1):
        _eliminate(backward[k + 1], coupling[k].T, backward[k])
    covariance = np.empty(diagonal.shape)
    for k in range(len(diagonal)):
        covariance[k] = _inverse(forward[k] + backward[k] - diagonal[k])
    return covariance


@njit(cache=True, nogil=True)
def _eliminate(own, coupling, other):  # type: ignore[no-untyped-def]
    """Takes from a neighbour's block what a pose's own unknowns, (3, 3) each, explain of it."""
    inverse = _inverse(own)
    for i in range(3):
        for j in range(3):
            for a in range(3):
                for b in range(3):
                    other[i, j] -= coupling[a, i] * inverse[a, b] * coupling[b, j]


@njit(cache=True, nogil=True)
def _inverse(matrix):  # type: ignore[no-untyped-def]
    """Inverse of a matrix (3, 3) by cofactors: linear algebra takes seconds to compile."""
    cofactor = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            k, m, p, q = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            cofactor[j, i] = matrix[k, p] * matrix[m, q] - matrix[k, q] * matrix[m, p]
    volume = 0.0
    for j in range(3):
        volume += matrix[0, j] * cofactor[j, 0]
    return cofactor / volume


def carried(pose: FloatArray, step: FloatArray, trusted: NDArray[np.bool_]) -> FloatArray:
    """Poses with the untrusted ones replaced by odometry from the nearest trusted one.

    Parameters
    ----------
    pose : ndarray, shape (K, 3)
    step : ndarray, shape (K - 1, 3)
        Motion from each pose to the next.
    trusted : ndarray of bool, shape (K,)
        Nothing changes where no pose is trusted.
    """
    known = np.flatnonzero(trusted)
    if len(known) == 0:
        return pose
    odometry = chained(step)
    index = np.arange(len(pose))
    right = np.searchsorted(known, index).clip(0, len(known) - 1)
    left = (np.searchsorted(known, index, side="right") - 1).clip(0, len(known) - 1)
    nearer_left = np.abs(index - known[left]) <= np.abs(known[right] - index)
    anchor = np.where(nearer_left, known[left], known[right])
    return composed(pose[anchor], relative(odometry[anchor], odometry))


def chained(step: FloatArray) -> FloatArray:
    """Poses to which steps lead from the origin, shape (K, 3) from (K - 1, 3)."""
    heading = np.concatenate([[0.0], np.cumsum(step[:, 2])])
    cos, sin = np.cos(heading[:-1]), np.sin(heading[:-1])
    ahead_x = np.cumsum(cos * step[:, 0] - sin * step[:, 1])
    ahead_y = np.cumsum(sin * step[:, 0] + cos * step[:, 1])
    x, y = np.concatenate([[0.0], ahead_x]), np.concatenate([[0.0], ahead_y])
    return np.stack([x, y, wrapped_angle(heading)], axis=-1)
