"""Inverses of many small covariance matrices at once: few modes, and noise that is independent."""

from __future__ import annotations

import numpy as np
from numba import njit

from soundmap.detect.harmonics import Single


@njit(cache=True, nogil=True)
def inverse_covariances(modes: Single, variance: Single, out: Single) -> None:
    r"""Inverses of :math:`N_s + \sum_m u_{ms} u_{ms}^T` with diagonal N.

    By the identity of Woodbury, in double precision: with the modes scaled to unit noise,
    :math:`(I + U U^T)^{-1} = I - V^T V`, where :math:`V = L^{-1} U^T` and
    :math:`L L^T = I + U^T U`, which has only as many rows as there are modes.

    Parameters
    ----------
    modes : ndarray of float32, shape (M, S, d)
    variance : ndarray of float32, shape (S, d)
        The diagonals of N, positive.
    out : ndarray of float32, shape (S, d, d)
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
            for k in range(m):
                rest = gram[m, k]
                for j in range(k):
                    rest -= gram[m, j] * gram[k, j]
                rest /= gram[k, k]
                gram[m, k] = rest
                for i in range(size):
                    row[m, i] -= rest * row[k, i]
            rest = 1.0 + gram[m, m]
            for j in range(m):
                rest -= gram[m, j] ** 2
            gram[m, m] = np.sqrt(rest)
            for i in range(size):
                row[m, i] /= gram[m, m]
        for m in range(count):
            for i in range(size):
                single[m, i] = row[m, i] * scale[i]
                other[i, m] = -single[m, i]
        np.dot(other, single, out[s])
        for i in range(size):
            out[s, i, i] += scale[i] * scale[i]
