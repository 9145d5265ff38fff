"""Inverses of many small covariance matrices at once: modes, and noise that is independent."""

from __future__ import annotations

import numpy as np
from numba import njit

from soundmap.detect.harmonics import Single


def inverse_covariances(modes: Single, variance: Single, out: Single) -> None:
    r"""Inverses of :math:`N_s + \sum_m u_{ms} u_{ms}^T` with diagonal N, in double precision.

    Parameters
    ----------
    modes : ndarray of float32, shape (M, S, d)
    variance : ndarray of float32, shape (S, d)
        The diagonals of N, positive.
    out : ndarray of float32, shape (S, d, d)
    """
    few = 2 * len(modes) < variance.shape[1]
    (_invert_by_modes if few else _invert_by_pivots)(modes, variance, out)


@njit(cache=True, nogil=True)
def _invert_by_modes(modes: Single, variance: Single, out: Single) -> None:
    r"""By the identity of Woodbury: as much work as there are modes.

    With the modes scaled to unit noise, :math:`(I + U U^T)^{-1} = I - V^T V`, where
    :math:`V = D^{-1/2} L^{-1} U^T` and :math:`L D L^T = I + U^T U`.
    """
    count, scans, size = modes.shape
    row, gram = np.empty((count, size)), np.empty((count, count))
    single, other = np.empty((count, size), np.float32), np.empty((size, count), np.float32)
    scale = np.empty(size)
    for s in range(scans):
        for i in range(size):
            scale[i] = 1.0 / np.sqrt(variance[s, i])
        for m in range(count):
            for i in range(size):
                row[m, i] = modes[m, s, i] * scale[i]
        np.dot(row, row.T, gram)
        for m in range(count):
            gram[m, m] += 1.0
        for k in range(count):
            for m in range(k + 1, count):
                share = gram[k, m] / gram[k, k]
                for j in range(m, count):
                    gram[m, j] -= share * gram[k, j]
                for i in range(size):
                    row[m, i] -= share * row[k, i]
        for m in range(count):
            root = np.sqrt(gram[m, m])
            for i in range(size):
                single[m, i] = row[m, i] * scale[i] / root
                other[i, m] = -single[m, i]
        np.dot(other, single, out[s])
        for i in range(size):
            out[s, i, i] += scale[i] * scale[i]


@njit(cache=True, nogil=True)
def _invert_by_pivots(modes: Single, variance: Single, out: Single) -> None:
    """By sweeping every pivot in turn, on the lower triangle: as much work as there are rows.

    Goodnight, "A tutorial on the SWEEP operator", The American Statistician 33, 1979.
    """
    count, scans, size = modes.shape
    row, swept, pivot_row = np.empty((count, size)), np.empty((size, size)), np.empty(size)
    for s in range(scans):
        for m in range(count):
            for i in range(size):
                row[m, i] = modes[m, s, i]
        np.dot(row.T, row, swept)
        for i in range(size):
            swept[i, i] += variance[s, i]
        for k in range(size):
            for j in range(size):
                pivot_row[j] = swept[k, j] if j <= k else swept[j, k]
            for i in range(size):
                share = pivot_row[i] / pivot_row[k]
                for j in range(i + 1):
                    swept[i, j] -= share * pivot_row[j]
            for j in range(k):
                swept[k, j] = pivot_row[j] / pivot_row[k]
            for i in range(k + 1, size):
                swept[i, k] = pivot_row[i] / pivot_row[k]
            swept[k, k] = -1.0 / pivot_row[k]
        for i in range(size):
            for j in range(i + 1):
                out[s, i, j] = out[s, j, i] = -swept[i, j]
