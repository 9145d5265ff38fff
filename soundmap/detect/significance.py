"""Significance: how likely anything in a run would seem as much of a source as this.

What noise alone shows somewhere stays far below what the fit looks at. What the model leaves of
loud sources does not: their ghosts explain the more, the louder their source is. How large ghosts
are was measured on simulated rooms, in units of what each run leaves unexplained.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray

GHOST_GAIN, GHOST_SHARE = 300.0, 0.07
"""What ghosts explain: this, or this share of what the loudest source of the run does."""
OPEN_FACTOR = 0.5
"""Most ghosts stand in the open, few sources do: there, what is explained counts for half."""
GHOST_DECAY = 0.2
"""Ghosts that explain more by this share of the above are rarer by a factor e."""
GHOST_RATE = 0.02
"""Share of runs that have a ghost of exactly that size or more."""


def false_alarm_probabilities(gains: FloatArray, on_surface: NDArray[np.bool_]) -> FloatArray:
    """Probability that a run without these sources would show as much somewhere, shape (K,).

    Parameters
    ----------
    gains : ndarray, shape (K,)
        Misfit that each component explains, in units of the noise that is left.
    on_surface : ndarray of bool, shape (K,)

    Examples
    --------
    >>> surface = np.array([True, True, False])
    >>> false_alarm_probabilities(np.array([300.0, 360.0, 600.0]), surface).round(4).tolist()
    [0.02, 0.0074, 0.02]
    """
    counted = np.where(on_surface, 1.0, OPEN_FACTOR) * gains
    ghost = max(GHOST_GAIN, GHOST_SHARE * float(gains.max(initial=0.0)))
    exponent = np.clip((1.0 - counted / ghost) / GHOST_DECAY, -700.0, 700.0)
    return np.asarray(np.minimum(GHOST_RATE * np.exp(exponent), 1.0))
