r"""Where to begin: a coarse search for the clock's and the yaw's error, and for fixed places.

If clock and yaw are right, the bearings of a fixed place meet in it, from wherever it was heard.
On a grid over the surroundings, each scan votes for the cells that lie on the bearings of its
peaks; the combination of clock and yaw whose votes pile up highest is near the right one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from soundmap.calibrate.peaks import Peaks
from soundmap.calibrate.way import Way
from soundmap.geometry import FloatArray, wrapped_angle
from soundmap.side_by_side import side_by_side

CLOCKS_S = 0.04 * np.arange(-2, 3)
YAWS_RAD = np.radians(3.0) * np.arange(-3, 4)
STARTS = 3
CELL_M, REACH_M = 0.20, 4.0
CELLS_AT_ONCE = 1000
DIRECTIONS = 240
VOTE_RAD = np.radians(3.5)
"""Standard deviation of a vote over the bearings."""
FULL_CONTRAST = 2.0
"""Peaks of this contrast or more have a full vote, fainter ones less."""
STAYING = 6
"""Power mean over the cells: votes that pile up count, their number does not."""
MOST_SCANS = 150
"""Of a stretch; others have no vote."""
MOST_PLACES = 6
LEAST_VOTES = 0.05
"""A fixed place has this share of all full votes or more."""
OWN_RAD = np.radians(12.0)
"""Peaks this near to the bearing of a place are its own."""


@dataclass(frozen=True)
class Ballot:
    """The votes of one stretch of the way.

    Attributes
    ----------
    cell_m : ndarray, shape (C, 2)
        In the map frame.
    direction : ndarray of int16, shape (C, S)
        Of each cell from each scan, in the array's axes, in steps of 2 pi / `DIRECTIONS`.
    turn_rad_s : ndarray, shape (S,)
    votes : ndarray of float32, shape (S, DIRECTIONS)
    own_bins : int
        Votes this near to the direction of a place are its own.
    """

    cell_m: FloatArray
    direction: NDArray[np.int16]
    turn_rad_s: FloatArray
    votes: NDArray[np.float32]
    own_bins: int

    def shift(self, clock_s: float, yaw_rad: float) -> NDArray[np.int32]:
        """Steps by which directions move if clock and yaw are off; parallax is left out."""
        turn = -(self.turn_rad_s * clock_s + yaw_rad) * DIRECTIONS / (2.0 * np.pi)
        return (np.rint(turn).astype(np.int64) % DIRECTIONS).astype(np.int32)


def ballot(way: Way, peaks: Peaks, first: int, last: int) -> Ballot:
    """The votes of the scans from ``first`` to before ``last``, thinned if they are many."""
    scans = np.arange(first, last, max(1, -(-(last - first) // MOST_SCANS)))
    place, axis = way.place_m[scans], way.axis_rad[scans]
    low, high = place.min(axis=0) - REACH_M, place.max(axis=0) + REACH_M
    x, y = (np.arange(low[i], high[i], CELL_M) for i in range(2))
    cell = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    direction = np.empty((len(cell), len(scans)), dtype=np.int16)
    for start in range(0, len(cell), CELLS_AT_ONCE):
        some = slice(start, start + CELLS_AT_ONCE)
        step = cell[some, None] - place
        bearing = np.arctan2(step[..., 1], step[..., 0]) - axis
        direction[some] = np.floor(bearing * DIRECTIONS / (2.0 * np.pi)) % DIRECTIONS
    row = np.full(last, -1)
    row[scans] = np.arange(len(scans))
    inside = (peaks.scan >= first) & (peaks.scan < last)
    inside[inside] = row[peaks.scan[inside]] >= 0
    centre = (np.arange(DIRECTIONS) + 0.5) * 2.0 * np.pi / DIRECTIONS
    away = wrapped_angle(centre - peaks.bearing_rad[inside, None]) / (peaks.blur * VOTE_RAD)
    weight = np.minimum(peaks.contrast[inside] / FULL_CONTRAST, 1.0)
    votes = np.zeros((len(scans), DIRECTIONS), dtype=np.float32)
    cast = (weight[:, None] * np.exp(-0.5 * away**2)).astype(np.float32)
    np.maximum.at(votes, row[peaks.scan[inside]], cast)
    own_bins = round(min(peaks.blur * OWN_RAD, np.pi / 2.0) * DIRECTIONS / (2.0 * np.pi))
    return Ballot(cell, direction, way.turn_rad_s[scans], votes, own_bins)


def starting_points(ballots: list[Ballot]) -> list[tuple[float, float]]:
    """Clock [s] and yaw [rad] to begin from, the most promising first; not beside each other."""
    grid = [(float(clock), float(yaw)) for clock in CLOCKS_S for yaw in YAWS_RAD]
    score = np.array(
        side_by_side(lambda at: sum(_pile(votes, *at) for votes in ballots), grid)
    ).reshape(len(CLOCKS_S), -1)
    chosen: list[tuple[int, int]] = []
    for flat in np.argsort(-score, axis=None, kind="stable"):
        i, j = divmod(int(flat), len(YAWS_RAD))
        if all(max(abs(i - k), abs(j - m)) > 1 for k, m in chosen):
            chosen.append((i, j))
        if len(chosen) == STARTS:
            break
    return [(float(CLOCKS_S[i]), float(YAWS_RAD[j])) for i, j in chosen]


def _pile(ballot: Ballot, clock_s: float, yaw_rad: float) -> float:
    votes = _counted(ballot.direction, ballot.shift(clock_s, yaw_rad), ballot.votes)
    above = np.maximum(votes - votes.mean(), 0.0)
    return float((above**STAYING).sum() ** (1.0 / STAYING))


def fixed_places(ballot: Ballot, clock_s: float, yaw_rad: float) -> FloatArray:
    """The places with most votes, shape (K, 2) [m]: each is taken with the votes it explains."""
    shift = ballot.shift(clock_s, yaw_rad)
    votes = ballot.votes.copy()
    own = np.arange(-ballot.own_bins, ballot.own_bins + 1)
    scans = np.arange(len(votes))[:, None]
    places: list[FloatArray] = []
    while len(places) < MOST_PLACES:
        best = int(np.argmax(_counted(ballot.direction, shift, votes)))
        near = (ballot.direction[best] + shift)[:, None] + own
        near %= DIRECTIONS
        if votes[scans, near].max(axis=1).sum() < LEAST_VOTES * len(votes):
            break
        votes[scans, near] = 0.0
        places.append(ballot.cell_m[best])
    return np.array(places).reshape(-1, 2)


@njit(cache=True, nogil=True)
def _counted(direction, shift, votes):  # type: ignore[no-untyped-def]
    """Votes for each cell, shape (C,)."""
    cells, scans = direction.shape
    directions = votes.shape[1]
    counted = np.empty(cells)
    for c in range(cells):
        total = 0.0
        for s in range(scans):
            d = direction[c, s] + shift[s]
            total += votes[s, d - directions if d >= directions else d]
        counted[c] = total
    return counted
