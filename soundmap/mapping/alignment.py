r"""How one laser scan lies on another: point-to-line ICP.

A return :math:`p` of one scan, taken by the relative pose :math:`z` to the frame of the other,
should lie on the surface line through the nearest return :math:`q` there, with normal :math:`n`:

.. math:: r = n^T (z \oplus p - q)

Both surfaces must face the same way, so that the two sides of a wall are not taken for one
(iterative closest point: the paper's [8]; point to line: Censi, ICRA 2008).

Normals err, and their scatter :math:`\sigma_n` seems to tell the place along a bare wall:
:math:`\sum n n^T` holds :math:`\sigma_n^2` a return in that direction. The normals :math:`m` that
the other scan gives the same surfaces err independently, so :math:`\sum (n m^T + m n^T) / 2` does
not. What is lacking there is in doubt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from soundmap.along_walls import without_hearsay
from soundmap.geometry import FloatArray, composed, relative
from soundmap.mapping.key_scans import STRIP_M, KeyScan

SIGMA_M = 0.03
"""Standard deviation of a residual [m]: range noise of usual scanners."""
ROBUST_M = 0.05
"""Residuals beyond this count less and less (Cauchy) [m]."""
CORRELATION = 0.1
"""Neighbouring residuals are alike: so many of them weigh as much as one independent."""
SAME_SIDE = 0.7
"""Least cosine of the angle between the normals of two returns from one surface."""
CONVERGED = 1e-4
DAMPING = 1e-9


@dataclass(frozen=True)
class PointStore:
    """Returns of many key scans one after the other.

    Attributes
    ----------
    end_m, normal : ndarray of float32, shapes (P, 2)
        In the base frame of their scan, in `strip_order` within it.
    first : ndarray of int64, shape (K + 1,)
        Scan k owns the returns first[k] to first[k + 1].
    """

    end_m: NDArray[np.float32]
    normal: NDArray[np.float32]
    first: NDArray[np.int64]

    @classmethod
    def of(cls, scans: Sequence[KeyScan]) -> PointStore:
        """The returns of these scans."""
        first = np.concatenate([[0], np.cumsum([len(scan) for scan in scans])]).astype(np.int64)
        end = np.concatenate([scan.end_m for scan in scans])
        return cls(end, np.concatenate([scan.normal for scan in scans]), first)


@dataclass(frozen=True)
class PairFits:
    r"""Normal equations of pairs of scans in their relative poses.

    Attributes
    ----------
    information : ndarray, shape (M, 3, 3)
        :math:`\sum w J^T J / \sigma^2`, of x [1/m^2], y, heading [1/rad^2].
    gradient : ndarray, shape (M, 3)
        :math:`\sum w J^T r / \sigma^2`.
    matched : ndarray of int64, shape (M,)
        Returns that met a surface of the other scan.
    """

    information: FloatArray
    gradient: FloatArray
    matched: NDArray[np.int64]


def pair_fits(
    store: PointStore,
    pose: FloatArray,
    pairs: NDArray[np.int64],
    *,
    gate_m: float,
    stride: int = 1,
) -> PairFits:
    """Normal equations of each pair of scans at the given poses, without what is in doubt.

    Parameters
    ----------
    store : PointStore
    pose : ndarray, shape (K, 3)
        Of every scan, in one frame.
    pairs : ndarray of int64, shape (M, 2)
        Returns of the first scan are matched to surfaces of the second.
    gate_m : float
        Returns farther apart than this do not belong together [m].
    stride : int
        Only every so many-th return is matched, and counts so many times.
    """
    between = relative(pose[pairs[:, 1]], pose[pairs[:, 0]])
    information, gradient, doubt, matched = _pair_equations(
        store.end_m, store.normal, store.first, np.ascontiguousarray(between), pairs, gate_m, stride
    )
    scale = stride * CORRELATION / SIGMA_M**2
    information, gradient = without_hearsay(scale * information, scale * gradient, scale * doubt)
    return PairFits(information, gradient, stride * matched)


@dataclass(frozen=True)
class Alignment:
    """A scan laid on others.

    Attributes
    ----------
    pose : ndarray, shape (3,)
    matched : float
        Share of the scan's returns that lie on a surface of the others.
    iterations : int
    """

    pose: FloatArray
    matched: float
    iterations: int


def aligned_scan(
    store: PointStore,
    pose: FloatArray,
    *,
    moving: int,
    prior: FloatArray,
    prior_information: FloatArray,
    gates_m: Sequence[float],
    most_iterations: int = 12,
) -> Alignment:
    """Pose of one scan from which it fits all others, whose poses are held.

    Parameters
    ----------
    store : PointStore
    pose : ndarray, shape (K, 3)
        Starting poses in one frame.
    moving : int
        Index of the scan to be moved.
    prior : ndarray, shape (3,)
        Where it is expected.
    prior_information : ndarray, shape (3, 3)
        Of the prior, in the frame of the poses.
    gates_m : sequence of float
        Gates, wide to narrow [m]; the iteration goes on with the next once it converges.
    """
    others = np.delete(np.arange(len(pose)), moving)
    pairs = np.stack([np.full(len(others), moving), others], axis=-1)
    moved = pose.copy()
    iteration = 0
    for gate in gates_m:
        for _ in range(most_iterations):
            iteration += 1
            fits = pair_fits(store, moved, pairs, gate_m=gate)
            off = moved[moving] - prior
            off[2] = (off[2] + np.pi) % (2 * np.pi) - np.pi
            jacobian = _rotations(-moved[others, 2])
            hessian = prior_information + np.einsum(
                "kji,kjl,klm->im", jacobian, fits.information, jacobian
            )
            gradient = prior_information @ off + np.einsum("kji,kj->i", jacobian, fits.gradient)
            step = -np.linalg.solve(hessian + DAMPING * np.eye(3), gradient)
            moved[moving] += step
            if np.abs(step).max() < CONVERGED:
                break
    matched = matched_share(store, moved, moving=moving, gate_m=gates_m[-1])
    return Alignment(composed(moved[moving], np.zeros(3)), matched, iteration)


def matched_share(store: PointStore, pose: FloatArray, *, moving: int, gate_m: float) -> float:
    """Share of the returns of a scan, normals known, that lie on a surface of any other scan."""
    others = np.delete(np.arange(len(pose)), moving)
    start, end = store.first[moving], store.first[moving + 1]
    hit = np.zeros(end - start, dtype=np.bool_)
    between = np.ascontiguousarray(relative(pose[others], pose[moving]))
    _mark_matched(store.end_m, store.normal, store.first, between, moving, others, gate_m, hit)
    oriented = np.any(store.normal[start:end] != 0.0, axis=1)
    return float(np.mean(hit[oriented])) if oriented.any() else 0.0


def _rotations(angle: FloatArray) -> FloatArray:
    """Rotations of x, y that leave the heading as it is, shape (K, 3, 3)."""
    cos, sin = np.cos(angle), np.sin(angle)
    matrix = np.zeros((len(angle), 3, 3))
    matrix[:, 0, 0], matrix[:, 0, 1] = cos, -sin
    matrix[:, 1, 0], matrix[:, 1, 1] = sin, cos
    matrix[:, 2, 2] = 1.0
    return matrix


@njit(cache=True, nogil=True)
def nearest_return(
    end: NDArray[np.float32],
    normal: NDArray[np.float32],
    first: int,
    last: int,
    point: tuple[float, float],
    facing: tuple[float, float],
    gate: float,
) -> int:
    """Index of the nearest return, of those from first to last, whose surface faces the same way.

    -1 if none lies within the gate. The strip of the point is searched first; its neighbours
    seldom hold anything nearer.
    """
    x, y = point
    best, nearest = gate * gate, -1
    middle = int(np.floor(y / STRIP_M))
    reach = int(np.ceil(gate / STRIP_M))
    for offset in range(2 * reach + 1):
        strip = middle + ((offset + 1) // 2 if offset % 2 else -(offset // 2))
        away = max(strip * STRIP_M - y, y - (strip + 1) * STRIP_M, 0.0)
        if away * away >= best:
            continue
        width = np.sqrt(best - away * away)
        k = _first_beyond(end, first, last, strip, x - width)
        top = (strip + 1) * STRIP_M
        while k < last:
            dx, dy = end[k, 0] - x, end[k, 1] - y
            if dx > width or end[k, 1] >= top:
                break
            square = dx * dx + dy * dy
            same = normal[k, 0] * facing[0] + normal[k, 1] * facing[1] > SAME_SIDE
            if square < best and same:
                best, nearest = square, k
            k += 1
    return nearest


@njit(cache=True, nogil=True)
def _first_beyond(end: NDArray[np.float32], first: int, last: int, strip: int, x: float) -> int:
    """Index of the first return in a strip that is not left of x, or of one after the strip."""
    bottom = strip * STRIP_M
    while first < last:
        middle = (first + last) // 2
        y = end[middle, 1]
        if y < bottom or (y < bottom + STRIP_M and end[middle, 0] < x):
            first = middle + 1
        else:
            last = middle
    return first


@njit(cache=True, nogil=True)
def _pair_equations(
    end: NDArray[np.float32],
    normal: NDArray[np.float32],
    first: NDArray[np.int64],
    between: FloatArray,
    pairs: NDArray[np.int64],
    gate: float,
    stride: int,
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.int64]]:
    information = np.zeros((len(pairs), 3, 3))
    gradient = np.zeros((len(pairs), 3))
    doubt = np.zeros((len(pairs), 2, 2))
    matched = np.zeros(len(pairs), dtype=np.int64)
    for m in range(len(pairs)):
        i, j = pairs[m]
        zx, zy, turn = between[m]
        cos, sin = np.cos(turn), np.sin(turn)
        for k in range(first[i], first[i + 1], stride):
            if normal[k, 0] == 0.0 and normal[k, 1] == 0.0:
                continue
            rx = cos * end[k, 0] - sin * end[k, 1]
            ry = sin * end[k, 0] + cos * end[k, 1]
            facing = (
                cos * normal[k, 0] - sin * normal[k, 1],
                sin * normal[k, 0] + cos * normal[k, 1],
            )
            near = nearest_return(
                end, normal, first[j], first[j + 1], (rx + zx, ry + zy), facing, gate
            )
            if near < 0:
                continue
            nx, ny = np.float64(normal[near, 0]), np.float64(normal[near, 1])
            residual = nx * (rx + zx - end[near, 0]) + ny * (ry + zy - end[near, 1])
            weight = 1.0 / (1.0 + (residual / ROBUST_M) ** 2)
            lever = ny * rx - nx * ry
            row = (nx, ny, lever)
            matched[m] += 1
            for a in range(3):
                gradient[m, a] += weight * row[a] * residual
                for b in range(3):
                    information[m, a, b] += weight * row[a] * row[b]
            for a in range(2):
                for b in range(2):
                    borne_out = 0.5 * (row[a] * facing[b] + facing[a] * row[b])
                    doubt[m, a, b] += weight * (row[a] * row[b] - borne_out)
    return information, gradient, doubt, matched


@njit(cache=True, nogil=True)
def _mark_matched(
    end: NDArray[np.float32],
    normal: NDArray[np.float32],
    first: NDArray[np.int64],
    between: FloatArray,
    moving: int,
    others: NDArray[np.int64],
    gate: float,
    hit: NDArray[np.bool_],
) -> None:
    for m in range(len(others)):
        j = others[m]
        zx, zy, turn = between[m]
        cos, sin = np.cos(turn), np.sin(turn)
        for k in range(first[moving], first[moving + 1]):
            if hit[k - first[moving]] or (normal[k, 0] == 0.0 and normal[k, 1] == 0.0):
                continue
            x = zx + cos * end[k, 0] - sin * end[k, 1]
            y = zy + sin * end[k, 0] + cos * end[k, 1]
            facing = (
                cos * normal[k, 0] - sin * normal[k, 1],
                sin * normal[k, 0] + cos * normal[k, 1],
            )
            near = nearest_return(end, normal, first[j], first[j + 1], (x, y), facing, gate)
            hit[k - first[moving]] = near >= 0
