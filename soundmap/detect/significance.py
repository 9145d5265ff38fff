"""Significance: how likely a run without a source would show as much, by chance or by ghosts."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from soundmap.detect.candidates import Candidates
from soundmap.detect.matched_filter import (
    MatchedScans,
    beam_energies,
    beam_matches,
    explained,
)
from soundmap.detect.sound_paths import Kind
from soundmap.detect.sparse_fit import SparseFit
from soundmap.geometry import FloatArray

CHANCE_RUNS = 8
CHANCE_SEED = 8
SCANS = 150
"""About as many scans are turned: chance needs no more."""
GHOST_GAIN, GHOST_SHARE = 300.0, 0.07
"""What ghosts explain: this, or this share of what the loudest source of the run does."""
OPEN_FACTOR = 0.5
"""Most ghosts stand in the open, few sources do: there, what is explained counts for half."""
GHOST_DECAY = 0.2
"""Ghosts that explain more by this share of the above are rarer by a factor e."""
GHOST_RATE = 0.02
"""Runs that have a ghost of exactly that size or more."""


def chance_distribution(fit: SparseFit, candidates: Candidates) -> tuple[float, float]:
    """Location and scale of the Gumbel distribution of what the best candidate explains by chance.

    From what the fit leaves, weighted as candidates see it, each scan turned by an angle of its
    own.
    """
    rng = np.random.default_rng(CHANCE_SEED)
    stride = max(len(fit.evidence) // SCANS, 1)
    few = np.arange(0, len(fit.evidence), stride)
    evidence = fit.evidence.chosen(few)
    energy = beam_energies(fit.evidence, fit.precision)[few]
    weighted = fit.precision.times(fit.residual)[few]
    best = []
    for _ in range(CHANCE_RUNS):
        turned = _turned(weighted, fit, rng.uniform(0.0, 2.0 * np.pi, len(few)))
        matched = MatchedScans(beam_matches(evidence, turned), energy)
        value = explained(evidence, matched, candidates.source_m, Kind.SOURCE)
        best.append(stride * float(value.max(initial=0.0)))
    scale = max(float(np.std(best, ddof=1)) * np.sqrt(6.0) / np.pi, 1e-12)
    return float(np.mean(best)) - np.euler_gamma * scale, scale


def _turned(
    weighted: NDArray[np.float32], fit: SparseFit, angle_rad: FloatArray
) -> NDArray[np.float32]:
    """Scans as an array turned by some angle would have heard them."""
    starts = fit.evidence.table.starts
    turned = np.empty_like(weighted)
    for start, stop in pairwise(starts):
        middle = (start + stop) // 2
        order = 1 + np.arange(middle - start)
        series = weighted[:, start:middle] + 1j * weighted[:, middle:stop]
        series = series * np.exp(1j * order * angle_rad[:, None])
        turned[:, start:middle], turned[:, middle:stop] = series.real, series.imag
    return turned


def false_alarm_probabilities(
    gains: FloatArray, on_surface: NDArray[np.bool_], chance: tuple[float, float]
) -> FloatArray:
    """Probability that a run without these sources would show as much somewhere, shape (K,).

    Parameters
    ----------
    gains : ndarray, shape (K,)
        Misfit that each component explains, in units of the noise that is left.
    on_surface : ndarray of bool, shape (K,)
    chance : tuple of float
        As `chance_distribution` gives it.
    """
    counted = np.where(on_surface, 1.0, OPEN_FACTOR) * gains
    ghost = max(GHOST_GAIN, GHOST_SHARE * float(gains.max(initial=0.0)))
    by_ghosts = GHOST_RATE * np.exp(np.clip((1.0 - counted / ghost) / GHOST_DECAY, -700.0, 700.0))
    return np.asarray(np.minimum(chance_probabilities(counted, chance) + by_ghosts, 1.0))


def chance_probabilities(gains: FloatArray, chance: tuple[float, float]) -> FloatArray:
    """Probability that noise alone would show as much somewhere, shape (K,)."""
    location, scale = chance
    return np.asarray(-np.expm1(-np.exp(np.clip(-(gains - location) / scale, -700.0, 700.0))))
