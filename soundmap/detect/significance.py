r"""Significance: how likely anything in a run would seem as much of a source as this.

What noise alone shows somewhere stays far below what the fit looks at. What the model leaves of
loud sources does not: their ghosts may explain much. But ghosts differ from sources in more than
size. They explain in some stretches of the way what they spoil in others, few of them lie on a
surface, and many lie behind one. The log odds of a component to be a source,

.. math:: s = \sum_i w_i x_i

are linear in its steadiness, in the logarithms of what it explains, alone and over the loudest
component, and of the odds that it is on a surface, and in how far it lies behind what the lasers
see. The weights are those of a logistic regression on 1299 components, 494 of them sources, of 168
simulated runs in random rooms. The share of runs with a ghost of at least some s was measured on
them, too, with weights from other runs than the one looked at; it stays below

.. math:: P(s) = 0.04 \, e^{-1.2 s}.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soundmap.geometry import FloatArray

USUAL_GAIN = 100.0
AT_THESE = -1.98
"""Log odds of the loudest component if it explains that, is not steady at all and as likely on a
surface as not."""
PER_GAIN, PER_SHARE, PER_STEADINESS = 0.84, 0.75, 0.32
MOST_STEADINESS = 20.0
"""To be steadier tells no more."""
PER_SURFACE_ODDS, LEAST_ODDS = 0.51, 0.05
"""Less likely to be on a surface than this is the same."""
PER_METRE_BEHIND, MOST_BEHIND_M = -43.0, 0.05
"""To lie farther behind tells no more."""
GHOST_RATE, GHOST_DECAY = 0.04, 1.2
"""Share of runs with a ghost whose log odds are 0 or more, and how it falls with them."""


@dataclass(frozen=True)
class Marks:
    """What speaks for the components of a fit, each shape (K,).

    Attributes
    ----------
    gain : ndarray
        Misfit that each explains, in units of the noise that is left.
    steadiness : ndarray
        Its strength over what that scatters by along the way.
    surface_odds : ndarray
        How much likelier it is on a surface than in the open.
    behind_m : ndarray
        How far behind the surfaces in front of it it lies, 0 if it does not [m].
    """

    gain: FloatArray
    steadiness: FloatArray
    surface_odds: FloatArray
    behind_m: FloatArray


def log_odds(marks: Marks) -> FloatArray:
    """Log odds of each component to be a source, shape (K,)."""
    gain = np.maximum(marks.gain, 1.0)
    share = gain / gain.max(initial=1.0)
    return np.asarray(
        AT_THESE
        + PER_GAIN * np.log(gain / USUAL_GAIN)
        + PER_SHARE * np.log(share)
        + PER_STEADINESS * np.minimum(marks.steadiness, MOST_STEADINESS)
        + PER_SURFACE_ODDS * np.log(marks.surface_odds + LEAST_ODDS)
        + PER_METRE_BEHIND * np.minimum(marks.behind_m, MOST_BEHIND_M)
    )


def false_alarm_probabilities(marks: Marks) -> FloatArray:
    """Probability that a run without these sources would show as much somewhere, shape (K,).

    Examples
    --------
    >>> ghost = Marks(*np.array([[400.0], [4.0], [0.1], [0.1]]))
    >>> source = Marks(*np.array([[400.0], [10.0], [1.0], [0.0]]))
    >>> false_alarm_probabilities(ghost).round(3), false_alarm_probabilities(source).round(4)
    (array([0.965]), array([0.0022]))
    """
    exponent = np.clip(-GHOST_DECAY * log_odds(marks), -700.0, 700.0)
    return np.asarray(np.minimum(GHOST_RATE * np.exp(exponent), 1.0))
