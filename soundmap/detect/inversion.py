"""Inverses of many small covariance matrices at once.

numpy calls its solver for general matrices, through buffers of its own, once for each: of matrices
with some dozen rows that takes several times as long as the sums themselves.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from soundmap.detect.harmonics import Single


@njit(cache=True, nogil=True)
def invert(covariance: Single) -> None:
    r"""Put the inverse of each symmetric positive definite matrix in its place, shape (S, d, d).

    Every pivot is swept in turn, on the lower triangle and in double precision (Goodnight, "A
    tutorial on the SWEEP operator", The American Statistician 33, 1979).
    """
    size = covariance.shape[1]
    swept, pivot_row = np.empty((size, size)), np.empty(size)
    for s in range(len(covariance)):
        for i in range(size):
            for j in range(i + 1):
                swept[i, j] = covariance[s, i, j]
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
                covariance[s, i, j] = covariance[s, j, i] = -swept[i, j]
