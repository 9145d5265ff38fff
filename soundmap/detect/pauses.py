"""Pauses: machines that fall silent now and then.

Valves open, compressors start and stop. A component of constant strength is then too quiet while
the machine runs and too loud while it does not; what that leaves feeds ghosts. With two states for
each scan, sounding and silent, and a price for every change, the most likely states are those of a
shortest path (Viterbi). They are taken if the machine is heard to start and stop often enough, and
if that explains nearly as much as a strength of its own for every second would.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from soundmap.detect.sound_paths import Kind
from soundmap.detect.sparse_fit import SparseFit
from soundmap.detect.steps import move
from soundmap.detect.wandering import is_moving
from soundmap.geometry import FloatArray

CHANGE = 40.0
"""Price of a change, in units of the noise: chance does not pay it."""
LEAST_CHANGES, SHORTEST_S = 4, 0.6
"""A machine that pauses is heard to change so often, and to stay as it is for so long."""
WORTH, LEAST_WORTH = 0.25, 200.0
"""Pauses explain so much more than an even strength does, as a share of that and at least."""
SPAN_S, OF_FREE, SURE_OF_FREE = 0.6, 0.6, 0.9
"""They explain at least the first share of what strengths of their own for such spans would. Below
the second, somebody who walks by again and again may be heard."""
ROUNDS, MOST = 6, 6
STEPS = 2


def find_pauses(fit: SparseFit) -> None:
    """Let those components fall silent that are heard to, the plainest first, and fit anew.

    What one leaves unexplained while it is silent looks like pauses of others: each is looked at
    once those before it are taken.
    """
    for _ in range(MOST):
        told = [_states(fit, index) for index in range(len(fit.components))]
        best = int(np.argmax([0.0, *(worth for worth, _ in told)])) - 1
        if best < 0:
            break
        component = fit.components[best]
        component.sounding = told[best][1]
        fit.hear_anew(component)
        fit.refit()
        fit.renew()
        for _ in range(STEPS):
            move(fit)


def _states(fit: SparseFit, index: int) -> tuple[float, NDArray[np.bool_] | None]:
    """What pauses of a component are worth, and when it sounds, (S,); None if it does not pause."""
    component, evidence = fit.components[index], fit.evidence
    if component.kind == Kind.IMAGE or component.sounding is not None:
        return 0.0, None
    match, energy = _told(fit, index)
    span = np.unique(np.floor(evidence.time_s / SPAN_S), return_inverse=True)[1].ravel()
    even = _explained(match.sum(axis=0), energy.sum(axis=0))
    free = _explained(_in_spans(match, span), _in_spans(energy, span))
    if free < even + max(WORTH * even, LEAST_WORTH):
        return 0.0, None
    sounding = _sounding(match, energy, span)
    changes = int(np.count_nonzero(np.diff(sounding)))
    explained = _explained(match[sounding].sum(axis=0), energy[sounding].sum(axis=0))
    worth = explained - even - CHANGE * changes
    if (
        changes < LEAST_CHANGES
        or worth < max(WORTH * even, LEAST_WORTH)
        or explained < OF_FREE * free
        or _shortest_s(sounding, evidence.time_s) < SHORTEST_S
        or (explained < SURE_OF_FREE * free and is_moving(fit, component))
    ):
        return 0.0, None
    return worth, sounding


def _told(fit: SparseFit, index: int) -> tuple[FloatArray, FloatArray]:
    """What each scan tells of a component's strength, (S, B), in units of the noise.

    Products of its column with what the others leave, and with itself.
    """
    component = fit.components[index]
    own = fit.residual + fit.sound(component)
    weighted = fit.weighted_column(index) / np.float32(fit.noise)
    starts = fit.evidence.table.starts[:-1]
    match = np.add.reduceat(weighted * own, starts, axis=1)
    energy = np.add.reduceat(weighted * component.column, starts, axis=1)
    return match.astype(np.float64), energy.astype(np.float64)


def _explained(product: FloatArray, square: FloatArray) -> float:
    """Misfit that strengths explain, each of so much match and energy."""
    return float(np.sum(np.maximum(product, 0.0) ** 2 / np.maximum(square, 1e-30)))


def _in_spans(told: FloatArray, span: NDArray[np.int64]) -> FloatArray:
    """Sums of what the scans (S, B) of each span tell, (T, B)."""
    return np.stack([np.bincount(span, each) for each in told.T], axis=1)


def _sounding(match: FloatArray, energy: FloatArray, span: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Likeliest states, and the strength while it sounds, in turn until they agree."""
    strength = np.maximum(match.sum(axis=0), 0.0) / np.maximum(energy.sum(axis=0), 1e-30)
    heard = np.bincount(span, match @ strength)
    expected = np.bincount(span, energy @ strength**2)
    sounding = (heard > 0.5 * expected)[span]
    for _ in range(ROUNDS):
        if not sounding.any():
            break
        product = np.maximum(match[sounding].sum(axis=0), 0.0)
        strength = product / np.maximum(energy[sounding].sum(axis=0), 1e-30)
        before = sounding
        sounding = _cheapest(energy @ strength**2 - 2.0 * match @ strength, CHANGE)
        if np.array_equal(before, sounding):
            break
    return sounding


@njit(cache=True, nogil=True)
def _cheapest(cost: FloatArray, change: float) -> NDArray[np.bool_]:
    """States of least cost: of each scan in which it sounds its own, and of every change."""
    scans = len(cost)
    stays = np.ones((scans, 2), dtype=np.bool_)  # in silence, sounding
    silent, loud = 0.0, cost[0]
    for s in range(1, scans):
        stays[s, 0] = silent <= loud + change
        stays[s, 1] = loud <= silent + change
        silent, loud = min(silent, loud + change), min(loud, silent + change) + cost[s]
    sounding = np.empty(scans, dtype=np.bool_)
    sounding[scans - 1] = loud < silent
    for s in range(scans - 1, 0, -1):
        same = stays[s, 1] if sounding[s] else stays[s, 0]
        sounding[s - 1] = sounding[s] == same
    return sounding


def _shortest_s(sounding: NDArray[np.bool_], time_s: FloatArray) -> float:
    """How long the shortest state between two changes lasts [s]; inf if there is none."""
    changes_s = time_s[np.flatnonzero(np.diff(sounding)) + 1]
    return float(np.diff(changes_s).min(initial=np.inf))
