r"""Poses that agree best with what was measured between them: the pose graph.

A link from pose :math:`x_j` to :math:`x_i` says that the second, seen from the first, was
:math:`z` with information :math:`\Omega`; with :math:`e = (x_j^{-1} x_i) - z` the poses minimise
:math:`\sum e^T \Omega e`. The first pose is held. Solved by
damped Gauss-Newton steps (Levenberg-Marquardt).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, relative, wrapped_angle

MOST_ITERATIONS = 20
LEAST_GAIN = 1e-4
"""Relative fall of the cost at which the solution has converged."""
FIRST_DAMPING = 1e-6
MOST_DAMPING = 1e6


@dataclass(frozen=True)
class Links:
    r"""Relative poses measured between pairs of poses.

    Attributes
    ----------
    pairs : ndarray of int64, shape (M, 2)
        The pose measured and the one from which it was seen.
    measured : ndarray, shape (M, 3)
        :math:`z` [m, m, rad].
    information : ndarray, shape (M, 3, 3)
        :math:`\Omega`, symmetric and not negative.
    """

    pairs: NDArray[np.int64]
    measured: FloatArray
    information: FloatArray

    def __post_init__(self) -> None:
        count = len(self.pairs)
        if self.measured.shape != (count, 3) or self.information.shape != (count, 3, 3):
            raise ValueError("links need one relative pose and one information matrix a pair")

    def __len__(self) -> int:
        return len(self.pairs)

    @classmethod
    def joined(cls, links: Sequence[Links]) -> Links:
        """All of several sets of links."""
        return cls(
            np.concatenate([link.pairs for link in links]),
            np.concatenate([link.measured for link in links]),
            np.concatenate([link.information for link in links]),
        )


def link_errors(pose: FloatArray, links: Links) -> FloatArray:
    """Relative poses less their measurements, shape (M, 3)."""
    error = relative(pose[links.pairs[:, 1]], pose[links.pairs[:, 0]]) - links.measured
    error[:, 2] = wrapped_angle(error[:, 2])
    return error


def link_costs(pose: FloatArray, links: Links) -> FloatArray:
    r""":math:`e^T \Omega e` of each link, shape (M,)."""
    error = link_errors(pose, links)
    return np.einsum("mi,mij,mj->m", error, links.information, error)


def told_errors(pose: FloatArray, links: Links) -> tuple[FloatArray, FloatArray]:
    """How far poses lie from where links tell [m], and how far they are turned [rad], shapes (M,).

    Across the direction in which a link tells most a metre counts as such, along others by the
    square root of its share of the information: a corridor does not tell the place along it.
    """
    error = link_errors(pose, links)
    place, place_information = error[:, :2], links.information[:, :2, :2]
    most = np.maximum(np.linalg.eigvalsh(place_information)[:, -1], 1e-12)
    square = np.einsum("mi,mij,mj->m", place, place_information, place)
    return np.sqrt(np.maximum(square, 0.0) / most), np.abs(error[:, 2])


@dataclass(frozen=True)
class Solution:
    """Poses of a graph, and how they were reached.

    Attributes
    ----------
    pose : ndarray, shape (K, 3)
    cost : float
    iterations : int
    """

    pose: FloatArray
    cost: float
    iterations: int


def solved_graph(
    pose: FloatArray,
    links: Links,
    *,
    most_iterations: int = MOST_ITERATIONS,
    robust_scale: float | None = None,
) -> Solution:
    """Poses that fit the links best, starting from ``pose``, shape (K, 3); the first is held.

    Parameters
    ----------
    pose : ndarray, shape (K, 3)
    links : Links
        They must connect every pose to the first.
    robust_scale : float, optional
        Links whose error exceeds so many standard deviations count less and less (Cauchy).
    """
    pose = pose.copy()
    if len(pose) < 2:
        return Solution(pose, 0.0, 0)
    cost, damping = _total_cost(pose, links, robust_scale), FIRST_DAMPING
    for iteration in range(1, most_iterations + 1):
        hessian, gradient = _normal_equations(pose, links, robust_scale)
        while True:
            trial = _stepped(pose, hessian, gradient, damping)
            trial_cost = _total_cost(trial, links, robust_scale)
            if trial_cost <= cost or damping > MOST_DAMPING:
                break
            damping *= 10.0
        if trial_cost > cost:
            return Solution(pose, cost, iteration)
        gain, pose, cost = cost - trial_cost, trial, trial_cost
        damping = max(0.1 * damping, FIRST_DAMPING)
        if gain <= LEAST_GAIN * max(cost, 1e-12):
            return Solution(pose, cost, iteration)
    return Solution(pose, cost, most_iterations)


def _total_cost(pose: FloatArray, links: Links, robust_scale: float | None) -> float:
    cost = link_costs(pose, links)
    if robust_scale is None:
        return float(cost.sum())
    return float(np.sum(robust_scale**2 * np.log1p(cost / robust_scale**2)))


def _jacobians(pose: FloatArray, links: Links) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the relative poses by the measured poses and by those they are seen from."""
    measured, seen_from = pose[links.pairs[:, 0]], pose[links.pairs[:, 1]]
    cos, sin = np.cos(seen_from[:, 2]), np.sin(seen_from[:, 2])
    dx, dy = (measured - seen_from)[:, :2].T
    by_measured = np.zeros((len(links), 3, 3))
    by_measured[:, 0, 0], by_measured[:, 0, 1] = cos, sin
    by_measured[:, 1, 0], by_measured[:, 1, 1] = -sin, cos
    by_measured[:, 2, 2] = 1.0
    by_seen_from = -by_measured
    by_seen_from[:, 0, 2] = -sin * dx + cos * dy
    by_seen_from[:, 1, 2] = -cos * dx - sin * dy
    return by_measured, by_seen_from


def _normal_equations(
    pose: FloatArray, links: Links, robust_scale: float | None
) -> tuple[object, FloatArray]:
    from scipy.sparse import bsr_array

    error = link_errors(pose, links)
    omega = links.information
    if robust_scale is not None:
        cost = np.einsum("mi,mij,mj->m", error, omega, error)
        omega = omega / (1.0 + cost / robust_scale**2)[:, None, None]
    by_pose = _jacobians(pose, links)
    count = len(pose)
    gradient = np.zeros((count, 3))
    blocks, rows, columns = [], [], []
    for a in range(2):
        weighted = np.einsum("mji,mjk->mik", by_pose[a], omega)
        np.add.at(gradient, links.pairs[:, a], np.einsum("mij,mj->mi", weighted, error))
        for b in range(2):
            blocks.append(np.einsum("mij,mjk->mik", weighted, by_pose[b]))
            rows.append(links.pairs[:, a])
            columns.append(links.pairs[:, b])
    row, column = np.concatenate(rows), np.concatenate(columns)
    order = np.lexsort((column, row))
    row, column, block = row[order], column[order], np.concatenate(blocks)[order]
    new = np.append(True, (np.diff(row) != 0) | (np.diff(column) != 0))
    summed = np.add.reduceat(block, np.flatnonzero(new), axis=0)
    first = np.searchsorted(row[new], np.arange(count + 1))
    matrix = bsr_array((summed, column[new], first), shape=(3 * count, 3 * count))
    return matrix, gradient.ravel()


def _stepped(pose: FloatArray, hessian: object, gradient: FloatArray, damping: float) -> FloatArray:
    from scipy.sparse import csc_array, diags_array
    from scipy.sparse.linalg import splu

    matrix = csc_array(hessian)[3:, 3:]
    diagonal = matrix.diagonal()
    damped = matrix + diags_array(damping * diagonal + 1e-9)
    step = splu(
        csc_array(damped),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    ).solve(-gradient[3:])
    moved = pose.copy()
    moved[1:] += step.reshape(-1, 3)
    moved[:, 2] = wrapped_angle(moved[:, 2])
    return moved
