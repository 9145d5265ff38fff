r"""Sparse fit: the few places whose sounds together explain what all scans have heard.

.. math:: y_s = \sum_k q_k \, a_{k,s} + A_s f + e_s, \quad e_s \sim N(0, \Sigma_s)

y are the evened-out harmonics of a scan, a what a source of strength 1 adds to them along all its
paths, q its strength in each sub-band, f the far field (`soundmap.detect.far_field`), and
:math:`\Sigma` the covariance of noise and model errors. Strengths are those of generalised least
squares, not negative. Places move in `soundmap.detect.steps`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from soundmap.detect.component import ASSUMED, EVEN, Component, Share
from soundmap.detect.evidence import Evidence
from soundmap.detect.far_field import FarField
from soundmap.detect.harmonics import Single
from soundmap.detect.model_errors import USUAL_ERRORS, Precision
from soundmap.detect.sound_paths import (
    Kind,
    Path,
    Paths,
    departures,
    sound_paths,
    waves_heard,
)
from soundmap.detect.weighted_products import KnownProducts, Products, weighted_products
from soundmap.geometry import FloatArray

LEAST_NOISE = 0.5
"""What is explained counts in units of no less than this of the noise that was expected."""
BEHIND_M = 0.8
"""A wall no farther from a source than this may reflect a share of its own of that source's sound:
cabinets radiate little to their backs."""


class SparseFit:
    """Components, their strengths, and what they leave unexplained.

    Attributes
    ----------
    evidence : Evidence
    walls : ndarray, shape (W, 3)
    components : list of Component
    errors : ComponentErrors
        What the precision takes of them.
    directed : bool
        Whether sources may be louder on one side.
    residual : ndarray of float32, shape (S, D)
    precision : Precision
    far_harmonics : ndarray, shape (D,)
        Of the far field, as fitted.
    far_heard : ndarray of float32, shape (S, D), or None
        What it adds to the scans; None before the first fit.
    gram : ndarray, shape (B, K, K)
        Products of the components' columns with each other in each sub-band, in units of the noise.
    product : ndarray, shape (B, K)
        Theirs with what was heard; in both, the far field is taken out.
    coupling : ndarray, shape (K, D)
        Products of the components' columns with those of the far field.
    far_inverse : ndarray, shape (D, D)
        Inverse of the far field's own normal equations.
    far_pull : ndarray, shape (D,)
        Products of its columns with what was heard.
    """

    def __init__(self, evidence: Evidence, walls: FloatArray) -> None:
        self.evidence, self.walls = evidence, walls
        self.components: list[Component] = []
        self.errors, self.directed = USUAL_ERRORS, False
        self.residual = evidence.heard
        self.far_field = FarField(evidence)
        self.far_heard: Single | None = None
        self.far_harmonics = np.zeros(int(evidence.table.starts[-1]))
        self._weigh(Precision(evidence, []))
        self.gram, self.product = self._known.gram, self._known.heard
        self.coupling = self._known.far

    @property
    def misfit(self) -> float:
        """What is left unexplained, in units of the noise."""
        return self._misfit(list(range(len(self.components))))

    @property
    def noise(self) -> float:
        """Mean square of what is left, over what was expected; `LEAST_NOISE` at least.

        What is explained counts in units of it.
        """
        return max(self.misfit / self.evidence.heard.size, LEAST_NOISE)

    @property
    def strengths(self) -> FloatArray:
        """Of all components, shape (K, B)."""
        return np.array([component.strength for component in self.components])

    def add(
        self, place_m: FloatArray, height_m: float, kind: Kind, directivity: FloatArray = EVEN
    ) -> Component:
        """One component more, its strength still 0."""
        nothing = np.zeros(self.evidence.sub_bands)
        place_m, directivity = np.array(place_m, dtype=np.float64), directivity.copy()
        paths = self._paths(place_m, height_m, kind, directivity)
        component = Component(
            place_m, height_m, kind, dict(ASSUMED), nothing, paths, self.residual[:0], directivity
        )
        self._hear(component)
        self.components.append(component)
        return component

    def hear_anew(self, component: Component) -> None:
        """Paths and column of a component whose place, height or shares have changed."""
        component.paths = self._paths(
            component.place_m, component.height_m, component.kind, component.directivity
        )
        if component.sounding is not None:
            gain = component.paths.gain * component.sounding
            component.paths = replace(component.paths, gain=gain)
        self._hear(component)

    def gain(self, index: int) -> float:
        """Rise of the misfit if a component were not there, others' strengths fitted anew."""
        others = [i for i in range(len(self.components)) if i != index]
        return self._misfit(others) - self.misfit

    def sound(self, component: Component) -> Single:
        """What a component adds to the scans, shape (S, D)."""
        strength = component.strength[self.evidence.table.part].astype(np.float32)
        return np.asarray(component.column * strength)

    def energy(self, component: Component) -> float:
        """Of all that a component adds to the scans."""
        return float(np.sum(self.sound(component) ** 2))

    def weighted_column(self, index: int) -> Single:
        r""":math:`\Sigma^{-1}` times the column of a component, shape (S, D)."""
        return self.precision.times(self.components[index].column)

    def products(self, columns: Callable[[slice], Single], others: Sequence[Single]) -> Products:
        """`weighted_products` as this fit weighs scans."""
        return weighted_products(self.precision, self.far_field, columns, others)

    def pulls(self) -> Single:
        """What each number heard says for more strength of each component, shape (K, S, D).

        The far field follows the strengths, and its harmonics stand for D there.
        """
        held = (self.coupling @ self.far_inverse).astype(np.float32)
        far = self.far_field.pulls(self.precision.times(self.residual))
        columns = np.stack([component.column for component in self.components])
        return self.precision.times(columns) * self.residual - held[:, None] * far

    def misfit_of(self, components: list[Component]) -> float:
        """What would be left if there were only some of the components."""
        return self._misfit([i for i, each in enumerate(self.components) if each in components])

    def renew(self) -> None:
        """Model errors as of the present strengths, and strengths as of these errors."""
        del self.precision  # it is large: the next one takes its room
        self._weigh(Precision(self.evidence, self.components, self.far_heard, self.errors))
        self.refit()

    def refit(self) -> None:
        """All strengths anew; silent components go."""
        self._fit_strengths()
        kept = [c for c in self.components if c.strength.any() and c.column.any()]
        if len(kept) < len(self.components):
            self.components = kept
            self._fit_strengths()

    def strengths_along(
        self, index: int, stretch: NDArray[np.int64]
    ) -> tuple[FloatArray, FloatArray]:
        """Strength of a component in each stretch of the way, and how much the scans tell of it.

        Parameters
        ----------
        index : int
        stretch : ndarray of int, shape (S,)

        Returns
        -------
        strength, told : ndarray, shape (stretches, B)
            NaN where nothing is told.
        """
        component = self.components[index]
        own = self.residual + self.sound(component)
        weighted = self.weighted_column(index)
        starts = self.evidence.table.starts[:-1]
        product = np.add.reduceat(weighted * own, starts, axis=1)
        energy = np.add.reduceat(weighted * component.column, starts, axis=1)
        count = int(stretch.max()) + 1
        match = np.stack([np.bincount(stretch, each, count) for each in product.T], axis=-1)
        told = np.stack([np.bincount(stretch, each, count) for each in energy.T], axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            strength = np.where(told > 0.0, match / told, np.nan)
        return np.asarray(strength, dtype=np.float64), np.asarray(told, dtype=np.float64)

    def _weigh(self, precision: Precision) -> None:
        """Take a precision, and with it all that does not hang on components."""
        heard, starts = self.evidence.heard, self.evidence.table.starts[:-1]
        self.precision = precision
        self._known = KnownProducts.none(self.evidence.sub_bands, heard.shape[1])
        weighted = precision.times(heard)
        self.far_inverse = self.far_field.inverse(precision)
        self.far_pull = self.far_field.pull(weighted)
        by_far_field = self.far_pull * (self.far_inverse @ self.far_pull)
        self._energy = self._bands(heard, weighted) - np.add.reduceat(by_far_field, starts)

    def _explain(self) -> None:
        """Fit the far field beside the components as they are, and see what is left."""
        part, pull = self.evidence.table.part, self.far_pull
        self.residual = self.evidence.heard.copy()
        for component, coupling in zip(self.components, self.coupling, strict=True):
            self.residual -= self.sound(component)
            pull = pull - component.strength[part] * coupling
        self.far_harmonics = self.far_inverse @ pull
        self.far_heard = self.far_field.heard(self.far_harmonics)
        self.residual -= self.far_heard

    def _paths(
        self, place_m: FloatArray, height_m: float, kind: Kind, directivity: FloatArray
    ) -> Paths:
        """Paths with the directivity in their gains."""
        paths = sound_paths(self.evidence, self.walls, place_m, height_m, kind)
        if not directivity.any():
            return paths
        toward = departures(self.walls, place_m, self.evidence.place_m)
        return replace(paths, gain=paths.gain * np.exp(toward @ directivity))

    def _hear(self, component: Component) -> None:
        """Ways and column of a component that has new paths."""
        component.ways = self._ways(component)
        chosen, share = component.taken()
        paths = component.paths
        component.column = waves_heard(
            self.evidence,
            paths.wave[chosen],
            paths.aperture[chosen],
            share[:, None] * paths.gain[chosen],
        )

    def _ways(self, component: Component) -> dict[Share, list[int]]:
        """Paths that have a share, as far as any scan hears them."""
        if component.kind == Kind.IMAGE:
            return {}
        off = self.walls[:, :2] @ component.place_m - self.walls[:, 2]
        near = np.asarray(np.abs(off) < BEHIND_M)
        ways: dict[Share, list[int]] = {
            Share.CLOSE_WALLS: [Path.WALLS + int(wall) for wall in np.flatnonzero(near)],
            Share.ROOM: [Path.FLOOR] + [Path.WALLS + int(wall) for wall in np.flatnonzero(~near)],
            Share.HIDDEN: [Path.HIDDEN],
        }
        heard = np.asarray(component.paths.gain.max(axis=1, initial=0.0) > 0.0)
        told = {share: [path for path in paths if heard[path]] for share, paths in ways.items()}
        return {share: paths for share, paths in told.items() if paths}

    def _bands(self, left: Single, right: Single) -> FloatArray:
        """Sum of products of two columns in each sub-band."""
        product = np.einsum("sd,sd->d", left, right, dtype=np.float64)
        return np.asarray(np.add.reduceat(product, self.evidence.table.starts[:-1]))

    def _fit_strengths(self) -> None:
        from scipy.optimize import nnls

        columns = [component.column for component in self.components]
        self._known = known = self._known.of(columns, self.evidence.heard, self.products)
        by_far = known.far @ self.far_inverse
        self.coupling, self.gram, self.product = known.far, known.gram.copy(), known.heard.copy()
        for band, (start, stop) in enumerate(pairwise(self.evidence.table.starts)):
            held = by_far[:, start:stop]
            self.gram[band] -= held @ self.coupling[:, start:stop].T
            self.product[band] -= held @ self.far_pull[start:stop]
        self.gram = 0.5 * (self.gram + self.gram.swapaxes(1, 2))
        strengths = np.zeros((len(self.components), self.evidence.sub_bands))
        for band, (gram, product) in enumerate(zip(self.gram, self.product, strict=True)):
            if not len(gram):
                continue
            root, scale = _scaled_root(gram)
            solved, _ = nnls(root.T, np.linalg.solve(root, product * scale))
            strengths[:, band] = solved * scale
        for component, strength in zip(self.components, strengths, strict=True):
            component.strength = strength
        self._explain()

    def _misfit(self, kept: list[int]) -> float:
        """Misfit with some components only, their strengths as fits best."""
        from scipy.optimize import nnls

        misfit = float(self._energy.sum())
        if not kept:
            return misfit
        for gram, product in zip(self.gram, self.product, strict=True):
            own, match = gram[np.ix_(kept, kept)], product[kept]
            root, scale = _scaled_root(own)
            strength = nnls(root.T, np.linalg.solve(root, match * scale))[0] * scale
            misfit += float(strength @ own @ strength - 2.0 * strength @ match)
        return misfit


def _scaled_root(gram: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cholesky root of a Gram matrix whose diagonal is scaled to 1, and that scale."""
    scale = np.asarray(1.0 / np.sqrt(np.diag(gram) + 1e-30))
    scaled = gram * np.outer(scale, scale) + 1e-6 * np.eye(len(gram))
    return np.asarray(np.linalg.cholesky(scaled), dtype=np.float64), scale
