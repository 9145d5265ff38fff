"""Wandering: whether a sound goes about instead of standing where the fit has it.

Someone who walks and talks is heard from many places. The fit, which knows only what stands still,
puts components on the way. What nothing else explains is looked at second by second: a way along
which somebody could have walked is held against the best place to stand at.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter

from soundmap.detect.component import Component
from soundmap.detect.matched_filter import HEIGHTS_M, MatchedScans, explained, matched_scans
from soundmap.detect.model_errors import Precision
from soundmap.detect.sound_paths import Kind
from soundmap.detect.sparse_fit import SparseFit
from soundmap.geometry import FloatArray

SPAN_S = 0.8
"""How long it is taken to stay where it is."""
LEAST_IN_SPAN, LEAST_SPANS = 4, 10
"""Audio scans in a span, and spans, for anything to be told."""
SPEED_M_S = 1.3
"""Most that it moves."""
AROUND_M, CELL_M = 2.5, 0.25
CELLS = round(2.0 * AROUND_M / CELL_M) + 1
GOES_ABOUT, COMES_AND_GOES = 2.0, 1.5
"""It moves if a way explains more than any place by the first of these factors, and a place more
than it would with an even sound by the second. On random scenes three in five of the components
that stand for someone walking do, one in nine machines that they walk among, and one in eighty
where nobody walks."""


def is_moving(fit: SparseFit, component: Component) -> bool:
    """Whether somebody on their way explains what a component does far better than it can.

    Parameters
    ----------
    fit : SparseFit
    component : Component
        Of the fit.
    """
    along = np.linspace(-AROUND_M, AROUND_M, CELLS)
    cells = component.place_m + np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    others = [each for each in fit.components if each is not component]
    matched = matched_scans(
        fit.evidence,
        fit.residual + fit.sound(component),
        Precision(fit.evidence, others, fit.far_heard),
    )
    height = int(np.argmin(np.abs(HEIGHTS_M - component.height_m)))
    times_s, told = _told_in_spans(fit, matched, cells, height)
    if len(told) < LEAST_SPANS:
        return False
    even = explained(fit.evidence, matched, cells, Kind.SOURCE)[:, height].max()
    if told.sum(axis=0).max() < COMES_AND_GOES * even:
        return False
    told /= np.sqrt(np.maximum(told.max(axis=1, keepdims=True), 1e-30))  # near spans would decide
    return bool(_best_way(times_s, told) > GOES_ABOUT * told.sum(axis=0).max())


def _told_in_spans(
    fit: SparseFit, matched: MatchedScans, cells_m: FloatArray, height: int
) -> tuple[FloatArray, FloatArray]:
    """Mean time of each span (T,) [s], and what a sound in each cell would explain, (T, C)."""
    evidence = fit.evidence
    span = np.floor(evidence.time_s / SPAN_S)
    times_s, told = [], []
    for one in np.unique(span):
        scans = np.flatnonzero(span == one)
        if evidence.merged[scans].sum() < LEAST_IN_SPAN:
            continue
        few = MatchedScans(matched.match[scans], matched.energy[scans])
        here = explained(evidence.chosen(scans), few, cells_m, Kind.SOURCE, least_scans=0.5)
        times_s.append(evidence.time_s[scans].mean())
        told.append(here[:, height])
    return np.array(times_s), np.array(told)


def _best_way(times_s: FloatArray, told: FloatArray) -> float:
    """Most that a way explains: of each cell, the best that ends there, span by span (Viterbi)."""
    best = told[0].reshape(CELLS, CELLS)
    for waited_s, here in zip(np.diff(times_s), told[1:], strict=True):
        steps = int(np.ceil(SPEED_M_S * waited_s / CELL_M))
        best = maximum_filter(best, 2 * steps + 1, mode="nearest") + here.reshape(CELLS, CELLS)
    return float(best.max())
