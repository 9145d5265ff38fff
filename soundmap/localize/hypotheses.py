"""Which of several starts is the true one: each is followed until the others are refuted.

A whole run is at hand, so nothing need be decided from the first view: hypotheses are followed
together, first over a short way, then over ever longer ones, and given up as the map contradicts
them. Two that the map never tells apart, as in a corridor that looks the same from both ends, both
remain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, wrapped_angle
from soundmap.localize.following import Follower, Track

FIRST_SPAN = 24
"""Views over which all hypotheses are followed at first; then twice as many, and so on."""
MOST_FOLLOWED = 100_000
"""Views, over all hypotheses, that are followed before the run counts as telling too little."""
GIVEN_UP = 0.15
"""A hypothesis is given up on the way if the views speak for it so much less than for the best."""
LEAST_GAP = 0.02
"""In the end it is refuted if they do so by this much on average ..."""
STRETCH, STRETCH_GAP = 12, 0.10
"""... and by this much over so many views in a row: somewhere the map is plainly another."""
SAME_M, SAME_RAD = 0.3, np.radians(15.0)
"""Tracks that end nearer to each other than this have become one."""


@dataclass(frozen=True)
class Followed:
    """A hypothesis and what came of following it.

    Attributes
    ----------
    start : ndarray, shape (3,)
    track : Track
        In the order in which it was followed.
    """

    start: FloatArray
    track: Track

    @property
    def support(self) -> float:
        """How far the views speak for it on average."""
        return float(self.track.support.mean())


def surviving(
    follower: Follower, orders: list[NDArray[np.int64]], hypotheses: FloatArray
) -> tuple[list[Followed], bool]:
    """The hypotheses that the run does not refute, best first, and whether all of it was asked.

    Where many hypotheses outlive much of the run, which tells no place then, the rest is not asked.

    Parameters
    ----------
    follower : Follower
    orders : list of ndarray of int64
        Views by number in the orders in which to follow: ahead from a view, and back from it. Both
        begin with the same one.
    hypotheses : ndarray, shape (H, 3), H >= 1
        Poses of that view.
    """
    followed: list[Followed] = [
        Followed(pose, follower.followed(orders[0][:1], pose, seek=True)) for pose in hypotheses
    ]
    followed = [Followed(each.track.pose[0], each.track) for each in followed]
    asked = 0
    for order in orders:
        done = 1
        while done < len(order) and (done < FIRST_SPAN or len(followed) > 1):
            stop = min(max(FIRST_SPAN, 2 * done), len(order))
            asked += len(followed) * (stop - done)
            if asked > MOST_FOLLOWED:
                return followed, False
            followed = [_continued(follower, each, order[:stop], done) for each in followed]
            followed = _merged(_not_given_up(followed))
            done = stop
    best = followed[0]
    left = [best, *(each for each in followed[1:] if not _is_refuted(each.track, best.track))]
    return left, True


def _continued(
    follower: Follower, followed: Followed, order: NDArray[np.int64], done: int
) -> Followed:
    """Follow from view number ``done`` of the order on."""
    last = followed.start if done == 1 else followed.track.pose[-1]
    return Followed(followed.start, followed.track.then(follower.followed(order[done - 1 :], last)))


def _not_given_up(followed: list[Followed]) -> list[Followed]:
    best = max(each.support for each in followed)
    kept = [each for each in followed if each.support > best - GIVEN_UP]
    return sorted(kept, key=lambda each: -each.support)


def _merged(followed: list[Followed]) -> list[Followed]:
    """Of those that have come to the same pose, the best."""
    kept: list[Followed] = []
    for each in followed:
        off = [each.track.pose[-1] - other.track.pose[-1] for other in kept]
        if not any(
            np.hypot(x, y) < SAME_M and abs(wrapped_angle(turn)) < SAME_RAD for x, y, turn in off
        ):
            kept.append(each)
    return kept


def _is_refuted(track: Track, best: Track) -> bool:
    gap = best.support - track.support
    stretch = np.convolve(gap, np.full(STRETCH, 1.0 / STRETCH), mode="valid")
    longest = stretch if len(stretch) else gap.mean(keepdims=True)
    return bool(gap.mean() >= LEAST_GAP and longest.max() >= STRETCH_GAP)
