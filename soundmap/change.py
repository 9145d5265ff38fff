"""What differs between two runs: a map of it, and places."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray
from soundmap.grid import GridFrame


class ChangeKind(StrEnum):
    """What became of a place from the background run to the run."""

    APPEARED = "appeared"
    LOUDER = "louder"
    QUIETER = "quieter"
    GONE = "gone"
    UNCHANGED = "unchanged"
    UNTOLD = "untold"
    """One of the runs did not hear enough of the place to tell."""

    @property
    def is_louder(self) -> bool:
        """Whether there is more sound than in the background run."""
        return self in (ChangeKind.APPEARED, ChangeKind.LOUDER)

    @property
    def is_quieter(self) -> bool:
        """Whether there is less sound than in the background run."""
        return self in (ChangeKind.QUIETER, ChangeKind.GONE)


@dataclass(frozen=True)
class Change:
    """A place in two runs, and how much louder it is in one than in the other.

    Attributes
    ----------
    x_m, y_m : float
        Position in the map frame [m].
    ratio_db : float
        Power of the run over that of the background [dB]. Where one of them is silent its
        standard error stands in: the change is at least as great.
    visits : int
        Visits of the place in the run.
    kind : ChangeKind
    sigma_db : float or None
        Standard error of the ratio [dB]; None where it is not known, or one of the runs silent.
    false_alarm_probability : float or None
        That two runs of an unchanged site would differ as much anywhere; None if unknown.
    run_source, background_source : int or None
        Index of the source found there in either run.
    """

    x_m: float
    y_m: float
    ratio_db: float
    visits: int
    kind: ChangeKind = ChangeKind.LOUDER
    sigma_db: float | None = None
    false_alarm_probability: float | None = None
    run_source: int | None = None
    background_source: int | None = None


@dataclass(frozen=True)
class PowerRatio:
    """Difference of two power maps in dB, Sect. 4 and Fig. 7.

    Attributes
    ----------
    frame : GridFrame
        That of the run.
    ratio_db : ndarray, shape (H, W)
        Power of the run over that of the background [dB]; NaN where the run did not measure.
    visits : ndarray of int64, shape (H, W)
        Visits in the run.
    background_measured : ndarray of bool, shape (H, W)
        Where the background has a measurement of its own; elsewhere its median stands in.
    changes : tuple of Change
        What is louder, greatest ratio first; then what is quieter, what did not change, and what
        cannot be told.
    chance : ndarray, shape (H, W), or None
        Probability that the cell of an unchanged site would differ as much; None if unknown.
    """

    frame: GridFrame
    ratio_db: FloatArray
    visits: NDArray[np.int64]
    background_measured: NDArray[np.bool_]
    changes: tuple[Change, ...]
    chance: FloatArray | None = None

    @property
    def louder(self) -> tuple[Change, ...]:
        """The changes to more sound, greatest ratio first."""
        return tuple(change for change in self.changes if change.kind.is_louder)
