r"""Weighted products: what columns have in common in units of the noise, :math:`c^T \Sigma^{-1} d`.

They make up the normal equations of a fit. Of its components few change at a time, and products of
all others stay as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from soundmap.detect.far_field import FarField
from soundmap.detect.harmonics import Single
from soundmap.detect.model_errors import Precision, parts
from soundmap.geometry import FloatArray
from soundmap.side_by_side import side_by_side

Products = tuple[FloatArray, FloatArray, FloatArray]


def weighted_products(
    precision: Precision,
    far_field: FarField,
    columns: Callable[[slice], Single],
    others: Sequence[Single],
) -> Products:
    """Products of some columns, the far field not taken out.

    Parameters
    ----------
    precision : Precision
    far_field : FarField
    columns : callable
        Gives C columns of some scans, (C, s, D).
    others : sequence of ndarray of float32, length O
        Columns (S, D), at least one.

    Returns
    -------
    own, across : ndarray, shape (B, C, C) and (B, C, O)
        Of the columns with each other and with the others, in each sub-band.
    far : ndarray, shape (C, D)
        With the columns of the far field.
    """

    def of_some(scans: slice) -> tuple[list[Single], list[Single], list[Single]]:
        own, across, far = [], [], []
        some = columns(scans)
        for band, (start, stop) in enumerate(pairwise(precision.starts)):
            left = np.ascontiguousarray(some[:, :, start:stop])
            right = np.stack([each[scans, start:stop] for each in others])
            weighted = np.empty_like(left)
            inverse = precision.inverse[band][scans]  # it is symmetric
            np.matmul(left.swapaxes(0, 1), inverse, out=weighted.swapaxes(0, 1))
            flat = weighted.reshape(len(left), -1)
            own.append(flat @ left.reshape(len(left), -1).T)
            across.append(flat @ right.reshape(len(right), -1).T)
            far.append(far_field.pull_band(band, weighted, scans))
        return own, across, far

    pieces = side_by_side(of_some, parts(len(others[0])))
    own, across, far = (
        [np.sum(of_band, axis=0, dtype=np.float64) for of_band in zip(*kind, strict=True)]
        for kind in zip(*pieces, strict=True)
    )
    return np.array(own), np.array(across), np.hstack(far)


@dataclass(frozen=True)
class KnownProducts:
    """Products of a fit's columns, known for as long as its precision is the same.

    Attributes
    ----------
    columns : sequence of ndarray of float32, length K
        Each (S, D).
    gram : ndarray, shape (B, K, K)
        Of the columns with each other, in each sub-band.
    heard : ndarray, shape (B, K)
        With what was heard.
    far : ndarray, shape (K, D)
        With the columns of the far field.
    """

    columns: Sequence[Single]
    gram: FloatArray
    heard: FloatArray
    far: FloatArray

    @staticmethod
    def none(bands: int, size: int) -> KnownProducts:
        """Those of no columns of so many numbers in so many sub-bands."""
        gram, heard = np.zeros((bands, 0, 0)), np.zeros((bands, 0))
        return KnownProducts((), gram, heard, np.zeros((0, size)))

    def of(
        self,
        columns: Sequence[Single],
        heard: Single,
        products: Callable[[Callable[[slice], Single], Sequence[Single]], Products],
    ) -> KnownProducts:
        """Those of other columns; of arrays that were among the columns before they are known.

        Parameters
        ----------
        columns : sequence of ndarray of float32, length K
            Each (S, D).
        heard : ndarray of float32, shape (S, D)
        products : callable
            `weighted_products` of columns of some scans and others.
        """
        number = {id(column): index for index, column in enumerate(self.columns)}
        place = np.array([number.get(id(column), -1) for column in columns], dtype=np.int64)
        old, new, was = np.flatnonzero(place >= 0), np.flatnonzero(place < 0), place[place >= 0]
        bands, size, count = len(self.gram), self.far.shape[1], len(columns)
        gram, match, far = (
            np.zeros(n) for n in ((bands, count, count), (bands, count), (count, size))
        )
        gram[:, old[:, None], old] = self.gram[:, was[:, None], was]
        match[:, old], far[old] = self.heard[:, was], self.far[was]
        if len(new):
            fresh, known = [columns[int(i)] for i in new], [columns[int(i)] for i in old]
            own, across, far[new] = products(
                lambda scans: np.stack([column[scans] for column in fresh]), [*known, heard]
            )
            gram[:, new[:, None], new] = own
            gram[:, new[:, None], old] = across[:, :, :-1]
            gram[:, old[:, None], new] = across[:, :, :-1].swapaxes(1, 2)
            match[:, new] = across[:, :, -1]
        return KnownProducts(columns, gram, match, far)
