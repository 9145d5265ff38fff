r"""Steadiness: whether the whole way tells that a component sounds, or some of it only.

The misfit that a component explains takes errors of neighbouring scans for independent. They are
not: a reflection that no path of the fit stands for pulls the same way for half a metre. Stretches
of the way each say *for themselves* how loud a component is, and their scatter knows of all that.
With the columns X of the components and the residual r, stretch c pulls at the strengths q of a
sub-band by

.. math:: \psi_c = G^{-1} \sum_{s \in c} X_s^T \Sigma_s^{-1} r_s, \quad
          G = \sum_s X_s^T \Sigma_s^{-1} X_s,

and :math:`\sum_c \psi_c \psi_c^T` is their covariance (the cluster-robust estimate of Liang and
Zeger, "Longitudinal data analysis using generalized linear models", Biometrika 1986). Sub-bands
are joined with weights :math:`\lambda = q_k / (G^{-1})_{kk}`: they err together.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from soundmap.detect.sparse_fit import SparseFit
from soundmap.geometry import FloatArray

RIDGE = 1e-6
"""Share of its own energy by which a component may seem to differ from all others together."""


def steadiness(fit: SparseFit, stretch: NDArray[np.int64]) -> FloatArray:
    """Strength of each component over its standard error, shape (K,).

    Parameters
    ----------
    fit : SparseFit
    stretch : ndarray of int, shape (S,)
        Number of the stretch of the way that each scan was taken in.
    """
    stretches = int(stretch.max()) + 1
    strengths = np.array([component.strength for component in fit.components])
    pulls = fit.pulls()
    total = np.zeros(len(pulls))
    pulled = np.zeros((len(pulls), stretches))
    edges = pairwise(fit.evidence.table.starts)
    for (start, stop), gram, strength in zip(edges, fit.gram, strengths.T, strict=True):
        pull = pulls[:, :, start:stop].sum(axis=2, dtype=np.float64)
        of_stretches = np.stack([np.bincount(stretch, each, stretches) for each in pull])
        inverse = _inverse(gram)
        weight = strength / np.maximum(np.diag(inverse), 1e-300)
        total += weight * strength
        pulled += weight[:, None] * (inverse @ of_stretches)
    error = np.sqrt(np.sum(pulled**2, axis=1))
    return np.asarray(total / np.maximum(error, 1e-300))


def _inverse(gram: FloatArray) -> FloatArray:
    scale = 1.0 / np.sqrt(np.diag(gram) + 1e-30)
    scaled = gram * np.outer(scale, scale) + RIDGE * np.eye(len(gram))
    return np.asarray(np.linalg.inv(scaled) * np.outer(scale, scale))
