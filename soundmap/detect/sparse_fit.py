r"""Sparse fit: the few places whose sounds together explain what all scans have heard.

.. math:: J_s(\theta_n) = b_s + \sum_k a_{k,s} B(\theta_n, \phi_{k,s}) / (r_{k,s}^2 + h^2)

Components are added one at a time, the best candidate first; after each, the places of all are
improved and their strengths fitted anew. The strength of a component may vary slowly along the
way, held to its mean: this takes up what the model leaves out (directivity, floor and ceiling, a
sound that comes and goes), which otherwise would gather in ghosts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.detect.candidates import Candidates, Kind
from soundmap.detect.evidence import SLOPES_DB_PER_OCTAVE, Evidence, Single
from soundmap.detect.matched_filter import column, explained_energy, seen_from
from soundmap.geometry import FloatArray

STRETCH = 8
"""Scans along the way that share one strength of each component."""
STIFFNESS = 0.9
"""How firmly strengths are held to their mean, in units of a stretch's mean evidence."""
LEAST_STRENGTH, GREATEST_STRENGTH = 0.2, 4.0
"""Strength of a stretch over the mean strength: what directivity and gaps may do."""
ROUNDS = 4
KIND_FACTOR = {Kind.SURFACE: 1.0, Kind.BEHIND: 0.9, Kind.OPEN: 0.6}
"""Of two kinds that explain the same, the one with the larger factor is taken."""
BACK_TO_SURFACE = {Kind.BEHIND: 0.97, Kind.OPEN: 0.8}
"""A component moves to a surface that explains at least this share of what it explains."""
FIRST_SLOPES = (1, 3)


@dataclass
class Component:
    """One sound of the fit.

    Attributes
    ----------
    place_m : ndarray, shape (2,)
    kind : Kind
    slope : int
        Index of the beams that fit its spectrum.
    scans, beyond_m : ndarray, shape (V,)
        Scans that hear it, and how far behind the first surface it lies in each [m].
    column : ndarray, shape (V, N)
        What it adds at strength 1.
    """

    place_m: FloatArray
    kind: Kind
    slope: int
    scans: NDArray[np.int64]
    beyond_m: FloatArray
    column: Single

    @classmethod
    def at(cls, evidence: Evidence, place_m: FloatArray, kind: Kind, slope: int) -> Component:
        """The component of a place."""
        scans, wave, gain, beyond = seen_from(evidence, place_m, kind)
        return cls(place_m, kind, slope, scans, beyond, column(evidence, scans, wave, gain, slope))


class SparseFit:
    """Components, their strengths, and what they leave unexplained.

    Attributes
    ----------
    components : list of Component
    strength : ndarray, shape (K,)
        :math:`q_k`, mean square at 1 m.
    residual : ndarray of float32, shape (S, N)
    """

    def __init__(self, evidence: Evidence, candidates: Candidates) -> None:
        from scipy.spatial import cKDTree

        self.evidence, self.candidates = evidence, candidates
        self.components: list[Component] = []
        self.strength = np.empty(0)
        self.residual = evidence.heard.copy()
        self.stretch = np.arange(len(evidence)) // STRETCH
        self.stretches = int(self.stretch[-1]) + 1
        self._gram = np.zeros((self.stretches, 0, 0))
        self._data = np.zeros((self.stretches, 0))
        self._along = np.zeros((self.stretches, 0))
        self._tree = cKDTree(candidates.surface_m)
        self._surfaces = int(np.sum(candidates.kind == Kind.SURFACE))
        factors = np.array([KIND_FACTOR[kind] for kind in Kind])
        self._factor = factors[candidates.kind]

    @property
    def energy(self) -> float:
        """What is left unexplained."""
        return float(np.sum(self.residual.astype(np.float64) ** 2))

    def strength_along(self, index: int) -> FloatArray:
        """Strength of a component in each stretch, shape (stretches,)."""
        return self._along[:, index]

    def evidence_along(self, index: int) -> FloatArray:
        """How much each stretch tells of a component, shape (stretches,)."""
        return self._gram[:, index, index]

    def add(self, component: Component) -> None:
        """One component more, and all strengths anew."""
        self.components.append(component)
        count = len(self.components)
        gram, data = self._gram, self._data
        self._gram = np.zeros((self.stretches, count, count))
        self._gram[:, :-1, :-1] = gram
        self._data = np.concatenate([data, np.zeros((self.stretches, 1))], axis=1)
        self._renew(count - 1)
        self._fit_strengths()

    def remove(self, index: int) -> None:
        """One component less, and all strengths anew."""
        del self.components[index]
        self._gram = np.delete(np.delete(self._gram, index, axis=1), index, axis=2)
        self._data = np.delete(self._data, index, axis=1)
        self._fit_strengths()

    def replace(self, index: int, component: Component) -> None:
        """Another component in the place of one, and all strengths anew."""
        self.components[index] = component
        self._renew(index)
        self._fit_strengths()

    def best_candidate(self, residual: Single | None = None) -> tuple[float, Component]:
        """The candidate that explains most of a residual, and how much energy that is."""
        residual = self.residual if residual is None else residual
        value, index, slope = self._best(residual, FIRST_SLOPES, len(self._factor))
        kind = Kind(int(self.candidates.kind[index]))
        return value, Component.at(self.evidence, self.candidates.place_m[index], kind, slope)

    def improve(self, radius_m: float) -> None:
        """Move each component to the best place near it, on its own kind of place."""
        for index in range(len(self.components)):
            self._improve(index, radius_m)
            self._renew(index)
        self._fit_strengths()

    def energy_at_mean_strength(self, index: int) -> float:
        """Energy of what a component adds to the scans at its mean strength."""
        return float(self.strength[index] ** 2 * self._gram[:, index, index].sum())

    def energy_without(self, index: int) -> float:
        """What would be left unexplained if a component were not there."""
        kept = [i for i in range(len(self.components)) if i != index]
        _, along = _strengths(self._gram[:, kept][:, :, kept], self._data[:, kept])
        return self._energy_of(kept, along)

    def with_own(self, index: int) -> Single:
        """The residual with a component put back."""
        own = self.components[index]
        whole = self.residual.copy()
        strength = self._along[self.stretch[own.scans], index].astype(np.float32)
        whole[own.scans] += strength[:, None] * own.column
        return whole

    def _energy_of(self, kept: list[int], along: FloatArray) -> float:
        data = float(np.sum(self.evidence.heard.astype(np.float64) ** 2))
        if not kept:
            return data
        gram, product = self._gram[:, kept][:, :, kept], self._data[:, kept]
        explained = 2.0 * np.sum(along * product)
        return float(data - explained + np.einsum("bk,bkl,bl->", along, gram, along))

    def _best(
        self, residual: Single, slopes: tuple[int, ...], count: int
    ) -> tuple[float, int, int]:
        value = self._factor[:count] * explained_energy(
            self.evidence,
            residual,
            slopes,
            self.candidates.place_m[:count],
            self.candidates.kind[:count],
        )
        best, index = np.unravel_index(int(np.argmax(value)), value.shape)
        return float(value[best, index]), int(index), slopes[int(best)]

    def _improve(self, index: int, radius_m: float) -> None:
        component = self.components[index]
        residual = self.with_own(index)
        kind, place = component.kind, component.place_m
        if kind == Kind.SURFACE:
            near = self._tree.query_ball_point(place, radius_m)
            around = self.candidates.surface_m[sorted(near)]
        else:
            steps = 0.5 * radius_m * np.arange(-2, 3)
            around = place + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        places = np.concatenate([around, place[None]])
        kinds = np.full(len(places), int(kind), dtype=np.int64)
        slopes = tuple(range(len(SLOPES_DB_PER_OCTAVE)))
        value = explained_energy(self.evidence, residual, slopes, places, kinds)
        slope, top = np.unravel_index(int(np.argmax(value)), value.shape)
        best = (float(value[slope, top]), places[top], int(slope))
        if kind != Kind.SURFACE and self._surfaces:
            value_there, there, its_slope = self._best(residual, FIRST_SLOPES, self._surfaces)
            if value_there >= BACK_TO_SURFACE[kind] * best[0]:
                kind = Kind.SURFACE
                best = (value_there, self.candidates.place_m[there], its_slope)
        self.components[index] = Component.at(self.evidence, best[1], kind, best[2])

    def _renew(self, index: int) -> None:
        """Products of one component with the data and with all others, stretch by stretch."""
        own = self.components[index]
        heard = self.evidence.heard[own.scans]
        stretch = self.stretch[own.scans]
        self._data[:, index] = self._sums(stretch, np.einsum("sn,sn->s", own.column, heard))
        for other, component in enumerate(self.components):
            _, mine, its = np.intersect1d(
                own.scans, component.scans, assume_unique=True, return_indices=True
            )
            product = np.einsum("sn,sn->s", own.column[mine], component.column[its])
            sums = self._sums(stretch[mine], product)
            self._gram[:, index, other] = sums
            self._gram[:, other, index] = sums

    def _sums(self, stretch: NDArray[np.int64], values: NDArray[np.float32]) -> FloatArray:
        return np.bincount(stretch, values.astype(np.float64), self.stretches).astype(np.float64)

    def _fit_strengths(self) -> None:
        self.strength, self._along = _strengths(self._gram, self._data)
        self.residual = self.evidence.heard.copy()
        for index, component in enumerate(self.components):
            along = self._along[self.stretch[component.scans], index].astype(np.float32)
            self.residual[component.scans] -= along[:, None] * component.column


def _strengths(gram: FloatArray, data: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean strengths (K,), not negative, and those of each stretch (B, K), held to the mean."""
    from scipy.optimize import nnls

    count = gram.shape[1]
    if count == 0:
        return np.empty(0), np.zeros((len(gram), 0))
    whole = gram.sum(axis=0)
    whole += 1e-9 * np.trace(whole) * np.eye(count)
    root = np.linalg.cholesky(whole)
    mean, _ = nnls(root.T, np.linalg.solve(root, data.sum(axis=0)))
    told = np.einsum("bkk->bk", gram)
    hold = STIFFNESS * told.mean(axis=0) + 1e-30
    along = np.tile(mean, (len(gram), 1))
    for _ in range(ROUNDS):
        for k in np.flatnonzero(mean > 0.0):
            rest = data[:, k] - np.einsum("bl,bl->b", gram[:, k], along) + told[:, k] * along[:, k]
            fitted = (rest + hold[k] * mean[k]) / (told[:, k] + hold[k])
            along[:, k] = np.clip(fitted, LEAST_STRENGTH * mean[k], GREATEST_STRENGTH * mean[k])
        mean = np.where(mean > 0.0, (told * along).sum(axis=0) / (told.sum(axis=0) + 1e-300), 0.0)
    return np.asarray(mean), along


def fitted_components(
    evidence: Evidence, candidates: Candidates, *, least_share: float, most: int
) -> SparseFit:
    """The sparse fit, grown until no candidate explains enough of what is left.

    Parameters
    ----------
    evidence : Evidence
    candidates : Candidates
        At least one.
    least_share : float
        Least share of the energy left that a new component has to explain.
    most : int
        Components at most.
    """
    fit = SparseFit(evidence, candidates)
    for _ in range(most):
        value, component = fit.best_candidate()
        if value < least_share * fit.energy:
            break
        fit.add(component)
        fit.improve(0.15)
        fit.improve(0.08)
        gone = [index for index, strength in enumerate(fit.strength) if strength <= 0.0]
        for index in reversed(gone):
            fit.remove(index)
        if len(fit.components) in gone:
            break
    return fit
