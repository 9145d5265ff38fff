"""Growth: how the fit comes by its components, and which of them are one."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np

from soundmap.detect.candidates import Candidates, best_candidates
from soundmap.detect.component import Component
from soundmap.detect.evidence import Evidence
from soundmap.detect.matched_filter import (
    HEIGHTS_M,
    LEAST_SCANS,
    effective_number,
    explained,
    matched_scans,
)
from soundmap.detect.model_errors import FREE_ERRORS
from soundmap.detect.pauses import find_pauses
from soundmap.detect.relocation import relocate
from soundmap.detect.sound_paths import Kind, Path
from soundmap.detect.sparse_fit import SparseFit
from soundmap.detect.steps import choose_height, move
from soundmap.geometry import FloatArray

LEAST_GAIN = 100.0
"""The fit grows until no candidate explains more than this, in units of the noise."""
LEAST_SHARE = 0.35
"""Candidates of one round explain at least this share of what the best near them does."""
APART_M = 2.0
AT_ONCE = 4
MOST_ROUNDS, MOST_COMPONENTS = 18, 24
ONE_SOURCE_M = 0.75
"""Components nearer to each other than this may be one source."""
SURELY_ONE_M = 0.3
"""Nearer ones are."""
BESIDE_M = 0.3
IN_VIEW_SHARE = 0.7
"""An image becomes a source if as such it explains at least this share of what it and all within
`BESIDE_M` of it did."""
HEIGHTS_TRIED_M = (0.1, 0.3, 0.6, 1.0, 1.4)
MERGE_SHARE, JOINT_SHARE = 0.4, 0.1
"""They are, if one in their midst loses less than this share of what the lesser of both gains, or
of what both gain together: two that share one source gain little each."""
STEPS = 4
SETTLED_HEIGHTS_M = (0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0, 1.2, 1.4)
"""Heights between array and source among which sources that settle choose."""
SETTLING_SHARE = 0.5
"""Their last steps: whole ones may swing to and fro by centimetres."""
GROWTH_SCANS = 120
"""About as many scans tell where components are; all of them place and weigh these."""


def grown_fit(evidence: Evidence, walls: FloatArray, candidates: Candidates) -> SparseFit:
    """The sparse fit, grown from nothing, its components placed and none of them twice.

    Parameters
    ----------
    evidence : Evidence
    walls : ndarray, shape (W, 3)
    candidates : Candidates
    """
    fit = rough_fit(evidence, walls, candidates)
    relocate(fit, candidates)
    if len(fit.evidence) < len(evidence):
        fit = carried_fit(fit.components, walls, evidence)
    _merge(fit)
    fit.renew()
    _bring_into_view(fit)
    for _ in range(STEPS):
        move(fit)
    _choose_heights(fit, HEIGHTS_TRIED_M)
    move(fit)
    fit.renew()
    find_pauses(fit)
    return fit


def rough_fit(
    evidence: Evidence, walls: FloatArray, candidates: Candidates, *, least_gain: float = LEAST_GAIN
) -> SparseFit:
    """Components added until no candidate explains so much, to about `GROWTH_SCANS` of the scans.

    Parameters
    ----------
    evidence : Evidence
    walls : ndarray, shape (W, 3)
    candidates : Candidates
    least_gain : float
        As `LEAST_GAIN`, for all scans.
    """
    stride = max(round(len(evidence) / GROWTH_SCANS), 1)
    if stride > 1:
        evidence = evidence.chosen(np.arange(0, len(evidence), stride))
        least_gain /= stride
    fit = SparseFit(evidence, walls)
    fit.refit()
    for _ in range(MOST_ROUNDS):
        matched = matched_scans(evidence, fit.residual, fit.precision)
        found = best_candidates(
            evidence,
            matched,
            candidates,
            least=least_gain,
            least_share=LEAST_SHARE,
            apart_m=APART_M,
            most=AT_ONCE,
        )
        if not found:
            break
        for candidate in found:
            value = explained(evidence, matched, candidate.place_m[None], candidate.kind)[0]
            fit.add(candidate.place_m, float(HEIGHTS_M[int(np.argmax(value))]), candidate.kind)
        fit.refit()
        fit.renew()
        move(fit, only_places=True)
        move(fit, only_places=True)
        if len(fit.components) >= MOST_COMPONENTS:
            break
    return fit


def carried_fit(
    components: Sequence[Component], walls: FloatArray, evidence: Evidence
) -> SparseFit:
    """The components of a fit, fitted to other scans of the same sounds."""
    fit = SparseFit(evidence, walls)
    for component in components:
        joined = fit.add(
            component.place_m, component.height_m, component.kind, component.directivity
        )
        joined.strength = component.strength
        joined.shares.update(component.shares)
    fit.renew()
    move(fit)
    return fit


def settle(fit: SparseFit, components: Sequence[Component]) -> None:
    """Leave only some components in a fit, and let them find their places without the others.

    Ghosts take up what the model leaves of loud sources, in other places after every small change,
    and what is a source shall not hang on them. What they took up is left to what may err, and to
    directivities: what a source sends to one side more than to others looks like something beside
    it otherwise. Components that are silent then go.

    Parameters
    ----------
    fit : SparseFit
    components : sequence of Component
        Of the fit.
    """
    fit.components = list(components)
    fit.errors, fit.directed = FREE_ERRORS, True
    fit.refit()
    for _ in range(2):
        fit.renew()
        for _ in range(STEPS):
            move(fit)
        _choose_heights(fit, SETTLED_HEIGHTS_M)
    fit.renew()
    for _ in range(STEPS):
        move(fit, share=SETTLING_SHARE)


def _choose_heights(fit: SparseFit, heights_m: tuple[float, ...]) -> None:
    for component in fit.components:
        choose_height(fit, component, heights_m)
    fit.refit()


def _bring_into_view(fit: SparseFit) -> None:
    """Make sources of images that can be heard directly from many places.

    Nothing is seen past a mirror image, which lies behind a wall. What lies behind a surface for
    some scans and not for others is a source behind something that stands in the room; what lies
    on a surface is a source, too, whichever explained a little more. A source takes the place of
    the image and of what stands beside it, if that loses little.
    """
    for image in [c for c in fit.components if c.kind == Kind.IMAGE]:
        if image not in fit.components:  # silent since an earlier one became a source
            continue
        kept, before = copy.copy(fit.components), fit.misfit
        others = [c for c in kept if np.hypot(*(c.place_m - image.place_m)) > BESIDE_M]
        worth = fit.misfit_of(others) - before
        fit.components = others
        source = fit.add(image.place_m, image.height_m, Kind.SOURCE)
        if effective_number(source.paths.gain[Path.DIRECT]) > LEAST_SCANS:
            fit.refit()
            for _ in range(STEPS):
                move(fit, [source])
            if source in fit.components and fit.misfit - before < (1.0 - IN_VIEW_SHARE) * worth:
                continue
        fit.components = kept
        fit.refit()


def _merge(fit: SparseFit) -> None:
    """Put one component in the place of two where it explains nearly as much."""
    tried: list[tuple[Component, Component]] = []
    while (pair := _nearest_pair(fit.components, tried)) is not None:
        first, second = pair
        tried.append(pair)
        before, kept = fit.misfit, copy.copy(fit.components)
        lesser = min(fit.gain(kept.index(each)) for each in pair)
        others = [c for c in kept if c is not first and c is not second]
        may_lose = max(MERGE_SHARE * lesser, JOINT_SHARE * (fit.misfit_of(others) - before))
        weight = np.array([fit.energy(first), fit.energy(second)])
        share = weight / max(weight.sum(), 1e-30)
        louder = first if weight[0] >= weight[1] else second
        fit.components = others
        middle = share[0] * first.place_m + share[1] * second.place_m
        joint = fit.add(middle, louder.height_m, louder.kind)
        fit.refit()
        for _ in range(STEPS):
            move(fit, [joint])
        away = float(np.hypot(*(first.place_m - second.place_m)))
        is_worse = away > SURELY_ONE_M and fit.misfit - before > may_lose
        if is_worse or joint not in fit.components:
            fit.components = kept
            fit.refit()


def _nearest_pair(
    components: list[Component], tried: list[tuple[Component, Component]]
) -> tuple[Component, Component] | None:
    """The two components nearest to each other that may be one and were not tried yet."""
    best, least = None, ONE_SOURCE_M
    for index, first in enumerate(components):
        for second in components[:index]:
            away = float(np.hypot(*(first.place_m - second.place_m)))
            if away < least and (first, second) not in tried:
                best, least = (first, second), away
    return best
