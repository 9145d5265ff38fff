"""Where each view was taken from: a start found or given, followed ahead and back; lost stretches.

Where the views stop matching the map, the pose is sought anew, in the whole map and where odometry
leads from both sides, and followed back into the stretch as well as ahead.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from soundmap.config import LocalizeConfig
from soundmap.errors import MapError
from soundmap.geometry import FloatArray, composed, relative
from soundmap.grid import OccupancyGrid
from soundmap.localize.following import LOOKED_FOR_M, Follower, Track
from soundmap.localize.global_start import GOLDEN, start_hypotheses
from soundmap.localize.hypotheses import FIRST_SPAN, LEAST_GAP, Followed, surviving
from soundmap.localize.views import STAGE, Views
from soundmap.losses import LossLedger

FIRST_MATCH = 0.6
"""Share of a view that must match before a pose that nothing else speaks for is believed."""
MATCHED_SCORE = 0.7
"""Least score of the returns that match, in the search over the whole map: they lie within a few
centimetres of a surface."""
MOST_BEYOND = 0.10
"""Share of it that may lie behind the map's walls then."""
ELSEWHERE_MATCH = 0.8
"""Share that must match to believe that the robot is where odometry cannot have led ..."""
ELSEWHERE_WAY_M = 3.0
"""... over at least this way: a few views may fit anywhere by chance."""
ODOMETRY_DRIFT = 0.2
"""Worst drift of any odometry in use [m/m and rad/m]."""
SEARCH_EVERY_M = 3.0
"""Way between two places from which the pose is sought in the whole map."""
MOST_SEARCHES = 40
MOST_UNTOLD = 6
"""Views, all over the run, that fit in too many places to follow, after which to give up."""
TOGETHER_NS = 300_000_000
"""Views this close together are matched to the map as one."""
LOST_M, LOST_S = 1.0, 2.0
"""Views that do not match over so much way, or time, make a lost stretch."""
MOST_MENDED = 20
"""Jumps of the trajectory that are followed across."""
ALL = slice(None)
CANNOT_TELL = (
    "the pose cannot be told from the laser scans: the map looks alike in several places, and the "
    "whole run fits it from each of them. Give the start with --start-pose X,Y,DEG."
)


class Placement:
    """Poses of all views of a run, as far as they could be found.

    Parameters
    ----------
    room : OccupancyGrid
    views : Views
    config : LocalizeConfig
    losses : LossLedger
        Is told of lost stretches.

    Attributes
    ----------
    pose : ndarray, shape (K, 3)
    matched, beyond : ndarray, shape (K,)
        As in `soundmap.localize.agreement.Agreement`.
    """

    def __init__(
        self, room: OccupancyGrid, views: Views, config: LocalizeConfig, losses: LossLedger
    ) -> None:
        self._room, self._views, self._config, self._losses = room, views, config, losses
        self._follower = Follower(
            room,
            views,
            hit_sigma_m=config.hit_sigma_m,
            weight=config.likelihood_exponent,
            min_match=config.min_match,
        )
        count = len(views)
        self.pose = np.zeros((count, 3))
        self.matched, self.beyond = np.zeros(count), np.ones(count)

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which views match the map from their poses, shape (K,)."""
        return (self.matched >= self._config.min_match) & (self.beyond <= 0.5 * self.matched)

    def find(self, start_pose: FloatArray | None) -> None:
        """Place the whole run, from a given pose of the first view or from anywhere in the map.

        Raises
        ------
        MapError
            The map has no place for a robot, or it looks alike in several places.
        """
        everything = np.arange(len(self._views))
        if start_pose is not None:
            orders = [everything]
            given, _ = surviving(self._follower, orders, start_pose[None, :])
            if self._is_proved(given[0], FIRST_MATCH):
                self._spread(0, given[0].start, everything)
            else:
                self._remark()
        if start_pose is None or not self.known.any():
            self._find_anywhere(everything)
        for stretch in _stretches(self._views, ~self.known):
            if len(stretch) < len(everything):
                self._find_again(stretch)
        self.mend()

    def _find_anywhere(self, everything: NDArray[np.int64]) -> None:
        """Seek the pose of one view after another, all over the run, until one tells the place."""
        places = np.array(_search_places(self._views, everything))
        untold = 0
        for view in places[np.argsort(np.arange(len(places)) * GOLDEN % 1.0)].tolist():
            outcome = self._found(view, everything, edges={})
            if outcome == "found":
                return
            untold += outcome == "untold"
            if untold == MOST_UNTOLD:
                break
        if untold:
            raise MapError(CANNOT_TELL)

    def _find_again(self, stretch: NDArray[np.int64]) -> None:
        """Seek the pose in a stretch where it has been lost."""
        self._remark()
        edges = {
            int(edge): self.pose[edge]
            for edge in (stretch[0] - 1, stretch[-1] + 1)
            if 0 <= edge < len(self._views)
        }
        for view in _search_places(self._views, stretch):
            if not self.known[view]:
                self._found(view, stretch, edges)

    def _found(
        self, view: int, stretch: NDArray[np.int64], edges: dict[int, FloatArray]
    ) -> Literal["found", "nowhere", "untold"]:
        """Seek the pose of one view; if it is found, place what can be followed from there.

        It is untold where so many places fit that not all of them can be followed until the run
        refutes them: the one that seems best is then no better than those that were left out.
        """
        views = self._views
        near = np.abs(views.time_ns[stretch] - views.time_ns[view]) < TOGETHER_NS
        rays = views.joined_rays(stretch[near].tolist(), view)
        needed = ELSEWHERE_MATCH if edges else FIRST_MATCH
        sought = start_hypotheses(self._room, rays, least_score=MATCHED_SCORE * needed)
        carried = [carried_pose(views, edge, pose, view) for edge, pose in edges.items()]
        hypotheses = np.concatenate([sought.pose, np.array(carried).reshape(-1, 3)])
        if len(hypotheses) == 0:
            return "untold" if sought.are_too_many else "nowhere"
        piece = _unbroken(views, stretch, view)
        ahead, back = piece[piece >= view], piece[piece <= view][::-1]
        orders = sorted([ahead, back], key=len, reverse=True)
        driven_m = views.driven_m[piece]
        is_long = driven_m[-1] - driven_m[0] >= ELSEWHERE_WAY_M
        survivors, is_settled = surviving(self._follower, orders, hypotheses)
        is_sure = is_settled and not sought.are_too_many
        proved = []
        for each in survivors:
            expected = any(leads_to(views, edge, edges[edge], view, each.start) for edge in edges)
            needed = FIRST_MATCH if expected or not edges else ELSEWHERE_MATCH
            if (expected or not edges or is_long) and self._is_proved(each, needed):
                proved.append((each, expected))
        likely = [each for each, expected in proved if expected] or [each for each, _ in proved]
        if len(likely) > 1 and not edges and is_sure:
            if len(piece) == len(stretch):
                raise MapError(CANNOT_TELL)
            return "untold"  # another part of the run may tell
        if likely and not (is_sure or any(expected for _, expected in proved)):
            return "untold"
        if len(likely) != 1:
            return "nowhere"
        self._spread(view, likely[0].start, stretch)
        return "found"

    def mend(self) -> None:
        """Where odometry cannot have led from one known view to the next, follow across.

        One of two such pieces is in the wrong place, unless someone carried the robot. Each is
        followed through the other, and takes its views if they match about as well from there.
        """
        tried: set[int] = set()
        for _ in range(MOST_MENDED):
            tears = _tears(self._views, self.pose, self.known)
            untried = [number for number, (before, _) in enumerate(tears) if before not in tried]
            if not untried:
                return
            number = untried[0]
            before, after = tears[number]
            tried.add(before)
            begin = tears[number - 1][1] if number > 0 else 0
            end = tears[number + 1][0] if number + 1 < len(tears) else len(self._views) - 1
            orders = (np.arange(before, end + 1), np.arange(begin, after + 1)[::-1])
            tracks = [self._follower.followed(order, self.pose[order[0]]) for order in orders]
            gains = [
                track.support - (self.matched - self.beyond)[order]
                for order, track in zip(orders, tracks, strict=True)
            ]
            best = max((0, 1), key=lambda side: float(gains[side].sum()))
            if gains[best].mean() >= -LEAST_GAP:
                self._put(orders[best], tracks[best])

    def _is_proved(self, followed: Followed, needed: float) -> bool:
        first = slice(0, FIRST_SPAN)
        matched, beyond = followed.track.matched[first], followed.track.beyond[first]
        return bool(np.median(matched) >= needed and np.median(beyond) <= MOST_BEYOND)

    def _spread(self, view: int, start: FloatArray, stretch: NDArray[np.int64]) -> None:
        """Follow a pose through a stretch; views that match better than before take it.

        Where a single wall was seen the start may be off along it, until the robot came to what
        tells the place; so the way is followed back as well, from the last view that matched.
        """
        for order in (stretch[stretch >= view], stretch[stretch <= view][::-1]):
            self._take(order, self._follower.followed(order, start, seek=True))
            for back in _known_pieces(self._views, self.known, order):
                self._take(back, self._follower.followed(back, self.pose[back[0]]))

    def _take(self, order: NDArray[np.int64], track: Track) -> None:
        better = track.support > (self.matched - self.beyond)[order]
        self._put(order[better], track, better)

    def _put(
        self, views: NDArray[np.int64], track: Track, of_track: NDArray[np.bool_] | slice = ALL
    ) -> None:
        self.pose[views] = track.pose[of_track]
        self.matched[views], self.beyond[views] = track.matched[of_track], track.beyond[of_track]

    def _remark(self) -> None:
        self._losses.remark(
            "laser scans stopped matching the map", STAGE, effect="pose sought in the whole map"
        )


def carried_pose(views: Views, known: int, pose: FloatArray, view: int) -> FloatArray:
    """Where odometry leads from the pose of one view by the time of another, shape (3,)."""
    return composed(pose, relative(views.odometry[known], views.odometry[view]))


def leads_to(views: Views, known: int, pose: FloatArray, view: int, found: FloatArray) -> bool:
    """Whether odometry can have led from the pose of one view to that found for another."""
    off = relative(carried_pose(views, known, pose, view), found)
    driven_m = abs(views.driven_m[view] - views.driven_m[known])
    near = np.hypot(off[0], off[1]) <= 0.5 + ODOMETRY_DRIFT * driven_m
    return bool(near and abs(off[2]) <= np.radians(20.0) + ODOMETRY_DRIFT * driven_m)


def _stretches(views: Views, lost: NDArray[np.bool_]) -> Iterator[NDArray[np.int64]]:
    """Runs of lost views that are long enough to be sought anew."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lost, [False]]).astype(np.int8)))
    for begin, end in edges.reshape(-1, 2):
        way_m = views.driven_m[end - 1] - views.driven_m[begin]
        took_s = (views.time_ns[end - 1] - views.time_ns[begin]) * 1e-9
        if way_m >= LOST_M or took_s >= LOST_S:
            yield np.arange(begin, end)


def _unbroken(views: Views, stretch: NDArray[np.int64], view: int) -> NDArray[np.int64]:
    """The part of a stretch about one view in which scan follows scan.

    Over a longer way without one, odometry drifts out of reach of a search nearby: what does not
    match behind it does not refute a place.
    """
    cuts = np.flatnonzero(np.diff(views.driven_m[stretch]) > LOOKED_FOR_M) + 1
    own = np.searchsorted(stretch[cuts], view, side="right")
    return np.split(stretch, cuts)[own]


def _known_pieces(
    views: Views, known: NDArray[np.bool_], order: NDArray[np.int64]
) -> list[NDArray[np.int64]]:
    """Pieces of the way that matched without a long break, each from its end back to its begin."""
    index = np.flatnonzero(known[order])
    gap_m = np.abs(np.diff(views.driven_m[order[index]]))
    pieces = np.split(index, np.flatnonzero(gap_m > LOST_M) + 1)
    return [order[piece[0] : piece[-1] + 1][::-1] for piece in pieces if len(piece)]


def _tears(views: Views, pose: FloatArray, known: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Pairs of known views with little way between, in order, that odometry cannot have joined."""
    index = np.flatnonzero(known)
    reach = np.searchsorted(views.driven_m[index], views.driven_m[index] + ELSEWHERE_WAY_M, "right")
    last = index[reach - 1]
    torn = [
        not leads_to(views, before, pose[before], after, pose[after])
        for before, after in zip(index.tolist(), last.tolist(), strict=True)
    ]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], torn, [False]]).astype(np.int8)))
    middle = edges.reshape(-1, 2).sum(axis=1) // 2  # the jump is in the middle of these
    return [(int(index[at]), int(last[at])) for at in middle]


def _search_places(views: Views, stretch: NDArray[np.int64]) -> list[int]:
    """Views of a stretch, some metres apart, from which to seek the pose; the first among them."""
    driven_m = views.driven_m[stretch]
    way_m = driven_m[-1] - driven_m[0]
    count = int(np.clip(np.ceil(way_m / SEARCH_EVERY_M), 1, MOST_SEARCHES))
    at = driven_m[0] + way_m * np.arange(count) / count
    return np.unique(stretch[np.searchsorted(driven_m, at)]).tolist()
