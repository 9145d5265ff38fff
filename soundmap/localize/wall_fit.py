"""What the laser scans of a run say about its poses, given the walls: first by the map alone."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from soundmap.along_walls import unsupported, without_hearsay
from soundmap.config import LocalizeConfig
from soundmap.geometry import FloatArray, transformed
from soundmap.grid import OccupancyGrid
from soundmap.localize.map_fit import map_surface, point_pull
from soundmap.localize.registration import registered
from soundmap.localize.smoothing import ScanEvidence
from soundmap.localize.views import Views
from soundmap.localize.wall_lines import has_line, line_pull, wall_lines

KERNEL_M = 0.15
"""Width of the robust kernel of the points that the map explains [m]."""
VIEWS_AT_ONCE = 1024
"""Views whose returns are placed at once; bounds the memory of long runs."""


class WallFit:
    """Fits laser points to the walls of a map.

    To its cells while the poses are rough; then to the lines that the run's returns draw in them,
    laid where they cross their cells, so that lines and poses do not drift together. Returns that
    draw no line are still fitted to cells.
    """

    def __init__(self, room: OccupancyGrid, config: LocalizeConfig) -> None:
        self._surface = map_surface(room)
        self._sigma_m, self._independence = config.hit_sigma_m, config.likelihood_exponent

    def evidence(
        self, views: Views, counts: NDArray[np.bool_], pose: FloatArray, *, by_lines: bool
    ) -> ScanEvidence:
        """Information and pull of the returns of all views on any poses.

        Parameters
        ----------
        views : Views
        counts : ndarray of bool, shape (P,)
            Which returns count.
        pose : ndarray, shape (K, 3)
            Best poses so far: lines are drawn from there.
        by_lines : bool
            Fit to lines where there are any.
        """
        points_m, first = views.end_m, views.first  # as they are: a long run has many
        sigma_m, weight = self._sigma_m, self._independence
        by_cells = counts.copy()

        def by_map(at: FloatArray) -> tuple[FloatArray, FloatArray]:
            information, pull = point_pull(
                self._surface,
                at,
                points_m,
                first,
                by_cells,
                sigma_m=sigma_m,
                kernel_m=KERNEL_M,
            )
            return weight * information, weight * pull

        if not by_lines:
            return lambda at: _borne_out(*by_map(at))
        placed = (part for _, part in _placed(pose, points_m, first, counts))
        lines = registered(self._surface, wall_lines(self._surface, placed))
        for own, part in _placed(pose, points_m, first, counts):
            by_cells[own[has_line(self._surface, lines, part)]] = False

        def by_both(at: FloatArray) -> tuple[FloatArray, FloatArray]:
            information, pull = line_pull(
                self._surface,
                lines,
                at,
                points_m,
                first,
                counts,
                sigma_m=sigma_m,
                kernel_m=KERNEL_M,
            )
            map_information, map_pull = by_map(at)
            return _borne_out(weight * information + map_information, weight * pull + map_pull)

        return by_both


def _borne_out(information: FloatArray, pull: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Evidence of views less what errors of walls' directions and single returns make up."""
    return without_hearsay(information, pull, unsupported(information))


def _placed(
    pose: FloatArray,
    points_m: NDArray[np.float32],
    first: NDArray[np.int64],
    counts: NDArray[np.bool_],
) -> Iterator[tuple[NDArray[np.int64], FloatArray]]:
    """The returns that count of some views at a time in the map frame, and which they are."""
    for start in range(0, len(pose), VIEWS_AT_ONCE):
        ends = first[start : start + VIEWS_AT_ONCE + 1]
        own = np.flatnonzero(counts[ends[0] : ends[-1]])
        view = np.repeat(np.arange(start, start + len(ends) - 1), np.diff(ends))[own]
        own += ends[0]
        yield own, transformed(pose[view], points_m[own])
