r"""Sparse fit: the few places whose sounds together explain what all scans have heard.

.. math:: y_s = \sum_k q_k \, a_{k,s} + A_s f + e_s, \quad e_s \sim N(0, \Sigma_s)

y are the evened-out harmonics of a scan, a what a source of strength 1 adds to them along all its
paths, q its strength in each sub-band, f the far field (`soundmap.detect.far_field`), and
:math:`\Sigma` the covariance of noise and model errors. Strengths are those of generalised least
squares, not negative. Places move by their bearings alone:
how strengths change along the way is the business of reflections and directivity as much as of
distance, and would pull them off.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from soundmap.detect.component import ASSUMED, EVEN, SHARE_SIGMA, Component, Share
from soundmap.detect.evidence import Evidence
from soundmap.detect.far_field import FarField
from soundmap.detect.harmonics import Single
from soundmap.detect.model_errors import Precision, bearing_derivative, parts
from soundmap.detect.sound_paths import (
    NEAREST_M,
    Kind,
    Path,
    Paths,
    departures,
    sound_paths,
    waves_heard,
)
from soundmap.geometry import FloatArray
from soundmap.side_by_side import side_by_side

BEHIND_M = 0.8
"""A wall no farther from a source than this may reflect a share of its own of that source's sound:
cabinets radiate little to their backs."""
LEAST_SHARE, GREATEST_SHARE = 0.0, 1.0
HOLD = 100.0
"""How firmly a place is held where it is while it moves [1/m^2]."""
MAY_BE_BEHIND_M, HOLD_BEHIND = 0.03, 3000.0
"""A source farther behind a surface than this [m] is drawn back to it so firmly [1/m^2]: what the
lasers see hides what lies behind, and reflections in the wall pull sources into it."""


class SparseFit:
    """Components, their strengths, and what they leave unexplained.

    Attributes
    ----------
    evidence : Evidence
    walls : ndarray, shape (W, 3)
    components : list of Component
    residual : ndarray of float32, shape (S, D)
    precision : Precision
    far_harmonics : ndarray, shape (D,)
        Of the far field, as fitted.
    far_heard : ndarray of float32, shape (S, D), or None
        What it adds to the scans; None before the first fit.
    gram : ndarray, shape (B, K, K)
        Products of the components' columns with each other in each sub-band, in units of the noise.
    """

    def __init__(self, evidence: Evidence, walls: FloatArray) -> None:
        self.evidence, self.walls = evidence, walls
        self.components: list[Component] = []
        self.residual = evidence.heard
        self.far_field = FarField(evidence)
        self.far_heard: Single | None = None
        self.far_harmonics = np.zeros(int(evidence.table.starts[-1]))
        self._weigh(Precision(evidence, []))
        self.gram = np.zeros((evidence.sub_bands, 0, 0))
        self._product = np.zeros((evidence.sub_bands, 0))

    @property
    def misfit(self) -> float:
        """What is left unexplained, in units of the noise."""
        return self._misfit(list(range(len(self.components))))

    @property
    def noise(self) -> float:
        """Mean square of what is left, over what was expected."""
        return self.misfit / self.evidence.heard.size

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

    def weighted_columns(self) -> Single:
        r""":math:`\Sigma^{-1}` times the columns of all components, shape (K, S, D)."""
        new = [each for each in self.components if each.weighted_by is not self.precision]
        if new:
            weighted = self.precision.times(np.stack([each.column for each in new]))
            couplings = self.far_field.pull(weighted)
            for component, own, coupling in zip(new, weighted, couplings, strict=True):
                component.weighted, component.weighted_by = own, self.precision
                component.coupling = coupling
        return np.stack([each.weighted for each in self.components if each.weighted is not None])

    def pulls(self) -> Single:
        """What each number heard says for more strength of each component, shape (K, S, D).

        The far field follows the strengths, and its harmonics stand for D there.
        """
        held = (self._couplings() @ self._far_inverse).astype(np.float32)
        far = self.far_field.pulls(self.precision.times(self.residual))
        return self.weighted_columns() * self.residual - held[:, None] * far

    def misfit_of(self, components: list[Component]) -> float:
        """What would be left if there were only some of the components."""
        return self._misfit([i for i, each in enumerate(self.components) if each in components])

    def renew(self) -> None:
        """Model errors as of the present strengths, and strengths as of these errors."""
        for component in self.components:
            component.weighted = component.weighted_by = component.coupling = None
        del self.precision  # it is large: the next one takes its room
        self._weigh(Precision(self.evidence, self.components, self.far_heard))
        self.refit()

    def refit(self) -> None:
        """All strengths anew; silent components go."""
        self._fit_strengths()
        kept = [c for c in self.components if c.strength.any() and c.column.any()]
        if len(kept) < len(self.components):
            self.components = kept
            self._fit_strengths()

    def move(
        self,
        chosen: list[Component] | None = None,
        *,
        most_m: float = 0.1,
        share: float = 1.0,
    ) -> None:
        """One step of some (by default all) components to where bearings point, and a refit.

        Only a ``share`` of the step is taken: reflections turn along with what they reflect, which
        is left out, so that whole ones may go too far in the end.
        """
        chosen = self.components if chosen is None else chosen
        hessian, gradient, owners = self._system(chosen)
        if not owners:
            return
        scale = np.sqrt(np.diag(hessian)) + 1e-12
        scaled = hessian / np.outer(scale, scale) + 1e-4 * np.eye(len(scale))
        step = share * np.linalg.solve(scaled, gradient / scale) / scale
        for position, (component, axis) in enumerate(owners):
            if axis < 2:
                component.place_m[axis] += np.clip(step[position], -most_m, most_m)
            else:
                taken = component.shares[Share(axis)] + np.clip(step[position], -0.2, 0.2)
                component.shares[Share(axis)] = float(np.clip(taken, LEAST_SHARE, GREATEST_SHARE))
        for component in {id(owner): owner for owner, _ in owners}.values():
            self._place(component)
        self.refit()

    def choose_height(self, component: Component, heights_m: tuple[float, ...]) -> None:
        """The height at which a component explains most, all else as it is."""
        starts = self.evidence.table.starts[:-1]
        target = self.residual + self.sound(component)
        best, value, columns = component.height_m, -np.inf, []
        for height in heights_m:
            component.height_m = height
            self._place(component)
            columns.append(component.column)
        weighted = self.precision.times(np.stack(columns))
        for height, column, right in zip(heights_m, columns, weighted, strict=True):
            match = np.add.reduceat(np.einsum("sd,sd->d", right, target), starts)
            energy = np.add.reduceat(np.einsum("sd,sd->d", right, column), starts)
            explained = np.sum(np.maximum(match, 0.0) ** 2 / np.maximum(energy, 1e-30))
            if explained > value:
                best, value = height, float(explained)
        component.height_m = best
        self._place(component)

    def covariances(self) -> list[FloatArray]:
        """Covariance (2, 2) of each component's place, as the noise alone would make it [m^2]."""
        result = [np.eye(2) for _ in self.components]
        hessian, _, owners = self._system(self.components)
        if not owners:
            return result
        scale = np.sqrt(np.diag(hessian)) + 1e-12
        inverse = np.linalg.pinv(hessian / np.outer(scale, scale), rcond=1e-8, hermitian=True)
        inverse = inverse / np.outer(scale, scale)
        index = {id(component): i for i, component in enumerate(self.components)}
        for position, (component, axis) in enumerate(owners):
            if axis == 0:
                own = slice(position, position + 2)
                result[index[id(component)]] = inverse[own, own]
        return result

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
        weighted = self.weighted_columns()[index]
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
        weighted = precision.times(heard)
        self._far_inverse = self.far_field.inverse(precision)
        self._far_pull = self.far_field.pull(weighted)
        by_far_field = self._far_pull * (self._far_inverse @ self._far_pull)
        self._energy = self._bands(heard, weighted) - np.add.reduceat(by_far_field, starts)

    def _explain(self) -> None:
        """Fit the far field beside the components as they are, and see what is left."""
        part, pull = self.evidence.table.part, self._far_pull
        self.residual = self.evidence.heard.copy()
        for component, coupling in zip(self.components, self._couplings(), strict=True):
            self.residual -= self.sound(component)
            pull = pull - component.strength[part] * coupling
        self.far_harmonics = self._far_inverse @ pull
        self.far_heard = self.far_field.heard(self.far_harmonics)
        self.residual -= self.far_heard

    def _couplings(self) -> FloatArray:
        """Products of the components' weighted columns with those of the far field, (K, D)."""
        told = [each.coupling for each in self.components if each.coupling is not None]
        return np.array(told).reshape(len(self.components), len(self._far_pull))

    def _place(self, component: Component) -> None:
        """Paths and column of a component that has moved."""
        component.paths = self._paths(
            component.place_m, component.height_m, component.kind, component.directivity
        )
        self._hear(component)

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
        component.weighted = component.weighted_by = None
        component.column = self._heard(component, Path.DIRECT)
        for share, paths in component.ways.items():
            for path in paths:
                heard = self._heard(component, path)
                component.column += np.float32(component.shares[share]) * heard

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

    def _heard(self, component: Component, path: int, scans: slice = slice(None)) -> Single:
        paths = component.paths
        wave, aperture = paths.wave[path, scans], paths.aperture[path, scans]
        return waves_heard(self.evidence, wave, aperture, paths.gain[path, scans], scans)

    def _bands(self, left: Single, right: Single) -> FloatArray:
        """Sum of products of two columns in each sub-band."""
        product = np.einsum("sd,sd->d", left, right, dtype=np.float64)
        return np.asarray(np.add.reduceat(product, self.evidence.table.starts[:-1]))

    def _fit_strengths(self) -> None:
        from scipy.optimize import nnls

        count, bands = len(self.components), self.evidence.sub_bands
        if count == 0:
            self.gram, self._product = np.zeros((bands, 0, 0)), np.zeros((bands, 0))
            self._explain()
            return
        columns = np.stack([component.column for component in self.components])
        self.gram, self._product = self._products(columns, self.weighted_columns())
        strengths = np.zeros((count, bands))
        for band, (gram, product) in enumerate(zip(self.gram, self._product, strict=True)):
            root, scale = _scaled_root(gram)
            solved, _ = nnls(root.T, np.linalg.solve(root, product * scale))
            strengths[:, band] = solved * scale
        for component, strength in zip(self.components, strengths, strict=True):
            component.strength = strength
        self._explain()

    def _products(self, columns: Single, weighted: Single) -> tuple[FloatArray, FloatArray]:
        """Gram matrices (B, K, K) of columns, and their products (B, K) with what was heard."""
        starts, heard = self.evidence.table.starts, self.evidence.heard
        couplings = self._couplings()
        held = couplings @ self._far_inverse
        grams, products = [], []
        for start, stop in pairwise(starts):
            right = weighted[:, :, start:stop].reshape(len(columns), -1)
            left = columns[:, :, start:stop].reshape(len(columns), -1)
            gram = (right @ left.T).astype(np.float64)
            gram -= held[:, start:stop] @ couplings[:, start:stop].T
            grams.append(0.5 * (gram + gram.T))
            product = (right @ heard[:, start:stop].ravel()).astype(np.float64)
            products.append(product - held[:, start:stop] @ self._far_pull[start:stop])
        return np.array(grams), np.array(products)

    def _misfit(self, kept: list[int]) -> float:
        """Misfit with some components only, their strengths as fits best."""
        from scipy.optimize import nnls

        misfit = float(self._energy.sum())
        if not kept:
            return misfit
        for gram, product in zip(self.gram, self._product, strict=True):
            own, match = gram[np.ix_(kept, kept)], product[kept]
            root, scale = _scaled_root(own)
            strength = nnls(root.T, np.linalg.solve(root, match * scale))[0] * scale
            misfit += float(strength @ own @ strength - 2.0 * strength @ match)
        return misfit

    @property
    def _strengths(self) -> FloatArray:
        """Of all components, shape (K, B)."""
        return np.array([component.strength for component in self.components])

    def unknowns(self, chosen: list[Component]) -> list[tuple[Component, int]]:
        """Places (axes 0, 1) and shares (as `Share`) of those components that enough scans hear."""
        owners: list[tuple[Component, int]] = []
        for component in chosen:
            if np.count_nonzero(component.paths.gain[Path.DIRECT]) >= 3:
                owners += [(component, axis) for axis in (0, 1, *component.ways)]
        return owners

    def _system(
        self, chosen: list[Component]
    ) -> tuple[FloatArray, FloatArray, list[tuple[Component, int]]]:
        """Normal equations of places (axes 0, 1) and shares (as `Share`), strengths free.

        The strengths' own unknowns stand last, sub-band by sub-band; only the first ones have
        owners.
        """
        owners = self.unknowns(chosen)
        if not owners:
            return np.zeros((0, 0)), np.zeros(0), owners
        count, components, bands = len(owners), len(self.components), len(self.gram)
        hessian = np.zeros((count + bands * components,) * 2)
        gradient = np.zeros(len(hessian))
        coupling = np.zeros((count, len(self._far_pull)))

        def of_some(scans: slice) -> tuple[Single, Single, FloatArray, FloatArray]:
            own = np.stack(list(self.derivatives(owners, scans)))
            weighted = self.precision.times(own, scans)
            flat = weighted.reshape(count, -1)
            squares = flat @ own.reshape(count, -1).T
            pull = flat @ self.residual[scans].ravel()
            return (
                squares,
                pull,
                self._across(weighted, scans),
                self.far_field.pull(weighted, scans),
            )

        for squares, pull, across, far in side_by_side(of_some, parts(len(self.evidence))):
            hessian[:count, :count] += squares
            gradient[:count] += pull
            hessian[:count, count:] += across
            coupling += far
        held = coupling @ self._far_inverse
        hessian[:count, :count] -= held @ coupling.T
        couplings = self._couplings()
        for band, (start, stop) in enumerate(pairwise(self.evidence.table.starts)):
            place = slice(count + band * components, count + (band + 1) * components)
            hessian[:count, place] -= held[:, start:stop] @ couplings[:, start:stop].T
        hessian[count:, :count] = hessian[:count, count:].T
        for band, gram in enumerate(self.gram):
            place = slice(count + band * components, count + (band + 1) * components)
            hessian[place, place] = gram
        rest = self._product - np.einsum("bkl,lb->bk", self.gram, self._strengths)
        gradient[count:] = rest.ravel()
        for position, (component, axis) in enumerate(owners):
            hold = HOLD if axis < 2 else SHARE_SIGMA[Share(axis)] ** -2
            hessian[position, position] += hold
            if axis >= 2:
                share = Share(axis)
                gradient[position] -= hold * (component.shares[share] - ASSUMED[share])
            elif axis == 0:
                self._hold_in_view(component, slice(position, position + 2), hessian, gradient)
        return hessian, gradient, owners

    def _hold_in_view(
        self, component: Component, own: slice, hessian: FloatArray, gradient: FloatArray
    ) -> None:
        """Hold a source that lies behind what the lasers see in front of it."""
        gain, beyond = component.paths.gain[Path.DIRECT], component.paths.beyond_m
        told = np.isfinite(beyond) & (gain > 0.0)
        if component.kind == Kind.IMAGE or not told.any():
            return
        weight = gain[told] ** 2 / np.sum(gain[told] ** 2)
        away = component.place_m - self.evidence.place_m[told]
        toward = weight @ (away / np.maximum(np.hypot(*away.T), NEAREST_M)[:, None])
        behind = float(weight @ beyond[told]) - MAY_BE_BEHIND_M
        if behind > 0.0:
            hessian[own, own] += HOLD_BEHIND * np.outer(toward, toward)
            gradient[own] -= HOLD_BEHIND * behind * toward

    def derivatives(self, owners: list[tuple[Component, int]], scans: slice) -> Iterator[Single]:
        """Change of what some scans hear with each unknown, each (s, D)."""
        evidence, part = self.evidence, self.evidence.table.part
        for component, axis in owners:
            strength = component.strength[part].astype(np.float32)
            if axis >= 2:
                paths = component.ways[Share(axis)]
                yield np.sum([self._heard(component, path, scans) for path in paths], 0) * strength
                continue
            if axis == 0:  # axis 1 of the same component follows
                turned = bearing_derivative(evidence, component.paths, scans) * strength
                step = component.place_m - evidence.place_m[scans]
                square = np.maximum(np.sum(step**2, axis=1), NEAREST_M**2) / evidence.handedness
            bearing = (-step[:, 1], step[:, 0])[axis] / square
            yield turned * bearing.astype(np.float32)[:, None]

    def _across(self, weighted: Single, scans: slice) -> FloatArray:
        """Products of some columns (K', s, D) with those of all components, (K', B K)."""
        starts, count = self.evidence.table.starts, len(weighted)
        columns = np.stack([component.column[scans] for component in self.components])
        return np.concatenate(
            [
                weighted[:, :, start:stop].reshape(count, -1)
                @ columns[:, :, start:stop].reshape(len(columns), -1).T
                for start, stop in pairwise(starts)
            ],
            axis=1,
        )


def _scaled_root(gram: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cholesky root of a Gram matrix whose diagonal is scaled to 1, and that scale."""
    scale = np.asarray(1.0 / np.sqrt(np.diag(gram) + 1e-30))
    scaled = gram * np.outer(scale, scale) + 1e-6 * np.eye(len(gram))
    return np.asarray(np.linalg.cholesky(scaled), dtype=np.float64), scale
