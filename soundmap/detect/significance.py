r"""Significance: how likely anything in a run would seem as much of a source as this.

What noise alone shows somewhere stays far below what the fit looks at. What the model leaves of
loud sources does not: their ghosts may explain much. But ghosts differ from sources in more than
size. They explain in some stretches of the way what they spoil in others, their place is vague, few
of them lie on a surface, and many lie behind one. The log odds of a component to be a source,

.. math:: s = \sum_i w_i x_i

are linear in the logarithms of what it explains, alone and over the loudest component, of its
steadiness, of the area that its place is known to, in whether it is on a surface and in how far it
lies behind what the lasers see. The weights are those of a logistic regression on 695 components,
264 of them sources, of 105 simulated runs in random rooms. The share of runs with a ghost of at
least some s was measured on them, too, with weights from other runs than the one looked at:

.. math:: P(s) = 0.04 \, e^{-1.1 s}.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray

USUAL_GAIN, USUAL_STEADINESS, USUAL_SIGMA_M = 100.0, 5.0, 0.05
AT_THESE = -1.29
"""Log odds of a component that is all of this, is the loudest and is on no surface."""
PER_GAIN, PER_STEADINESS, PER_SHARE = 1.3, 2.0, 1.14
PER_AREA = -0.96
ON_SURFACE = 3.35
PER_METRE_BEHIND = -4.3
GHOST_RATE, GHOST_DECAY = 0.04, 1.1
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
    area_m2 : ndarray
        Root of the determinant of its place's covariance [m^2].
    behind_m : ndarray
        How far behind the surfaces in front of it it lies, 0 if it does not [m].
    on_surface : ndarray of bool
    """

    gain: FloatArray
    steadiness: FloatArray
    area_m2: FloatArray
    behind_m: FloatArray
    on_surface: NDArray[np.bool_]


def log_odds(marks: Marks) -> FloatArray:
    """Log odds of each component to be a source, shape (K,)."""
    gain = np.maximum(marks.gain, 1.0)
    share = gain / gain.max(initial=1.0)
    return np.asarray(
        AT_THESE
        + PER_GAIN * np.log(gain / USUAL_GAIN)
        + PER_SHARE * np.log(share)
        + PER_STEADINESS * np.log(np.maximum(marks.steadiness, 0.1) / USUAL_STEADINESS)
        + PER_AREA * np.log(marks.area_m2 / USUAL_SIGMA_M**2)
        + ON_SURFACE * marks.on_surface
        + PER_METRE_BEHIND * marks.behind_m
    )


def false_alarm_probabilities(marks: Marks) -> FloatArray:
    """Probability that a run without these sources would show as much somewhere, shape (K,).

    Examples
    --------
    >>> ghost = Marks(*np.array([[400.0], [4.0], [0.01], [0.0]]), on_surface=np.array([False]))
    >>> source = Marks(*np.array([[400.0], [8.0], [0.001], [0.0]]), on_surface=np.array([True]))
    >>> false_alarm_probabilities(ghost).round(3), false_alarm_probabilities(source).round(4)
    (array([0.161]), array([0.0001]))
    """
    exponent = np.clip(-GHOST_DECAY * log_odds(marks), -700.0, 700.0)
    return np.asarray(np.minimum(GHOST_RATE * np.exp(exponent), 1.0))
