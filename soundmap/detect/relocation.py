"""Relocation: components that growth put in a poor place find a better one.

Growth takes the best place for each component when it comes; those that come later may take away
what spoke for that place. A source that is heard along its wall or from far away is easily taken
for an image behind it, and from there no small steps lead back: the whole surroundings are searched
once more, with all other components as they are.
"""

from __future__ import annotations

import copy

import numpy as np

from soundmap.detect.candidates import Candidates, finer_place
from soundmap.detect.component import Component
from soundmap.detect.harmonics import Single
from soundmap.detect.matched_filter import (
    HEIGHTS_M,
    MatchedScans,
    beam_energies,
    beam_matches,
    explained,
)
from soundmap.detect.sound_paths import Kind
from soundmap.detect.sparse_fit import SparseFit
from soundmap.detect.steps import move
from soundmap.geometry import FloatArray

WITHIN_M = 2.5
"""Better places are sought this near."""
APART_M = 0.15
"""Nearer ones are reached by small steps."""
LEAST_SHARE = {Kind.SOURCE: 1.05, Kind.IMAGE: 0.9}
"""A source elsewhere takes a component's place if it explains at least this share of what that
does: of a source and an image, the source is taken."""


def relocate(fit: SparseFit, candidates: Candidates) -> None:
    """Put components where a source explains more, all others as they are.

    Parameters
    ----------
    fit : SparseFit
    candidates : Candidates
        Places to look at.
    """
    fit.renew()
    energy = beam_energies(fit.evidence, fit.precision)
    for component in sorted(fit.components, key=fit.energy):
        if component in fit.components:
            _relocate(fit, component, candidates.source_m, energy)


def _relocate(fit: SparseFit, component: Component, places_m: FloatArray, energy: Single) -> None:
    evidence = fit.evidence
    near = places_m[np.hypot(*(places_m - component.place_m).T) < WITHIN_M]
    if not len(near):
        return
    unexplained = fit.precision.times(fit.residual + fit.sound(component))
    matched = MatchedScans(beam_matches(evidence, unexplained), energy)
    worth = explained(evidence, matched, component.place_m[None], component.kind).max()
    best = int(np.argmax(explained(evidence, matched, near, Kind.SOURCE).max(axis=1)))
    place = finer_place(evidence, matched, near[best], Kind.SOURCE)
    value = explained(evidence, matched, place[None], Kind.SOURCE)[0]
    stays = component.kind == Kind.SOURCE and np.hypot(*(place - component.place_m)) < APART_M
    if stays or value.max() < LEAST_SHARE[component.kind] * worth:
        return
    kept, before = copy.copy(fit.components), fit.misfit
    fit.components = [each for each in kept if each is not component]
    fit.add(place, float(HEIGHTS_M[int(np.argmax(value))]), Kind.SOURCE)
    fit.refit()
    move(fit, only_places=True)
    if component.kind == Kind.SOURCE and fit.misfit > before:
        fit.components = kept
        fit.refit()
