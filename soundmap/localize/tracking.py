"""Following the robot view by view with the particle filter of Sect. 2.2.

The particles start where the run was first recognised in the map and follow it ahead and back from
there. Where they leave what the map shows, they are set out anew at the next place that was
recognised.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soundmap.config import LocalizeConfig
from soundmap.geometry import FloatArray, relative
from soundmap.grid import OccupancyGrid
from soundmap.localize.agreement import view_shares
from soundmap.localize.particle_filter import ParticleFilter
from soundmap.localize.placement import FIRST_MATCH, LOST_S, MOST_BEYOND
from soundmap.localize.views import Views


class Tracker:
    """Runs the particle filter over the views of a run.

    Parameters
    ----------
    room : OccupancyGrid
    views : Views
    recognised : ndarray of bool, shape (K,)
        Views from whose poses particles may start.
    start : ndarray, shape (K, 3)
        Those poses.
    config : LocalizeConfig

    Attributes
    ----------
    pose : ndarray, shape (K, 3)
        Weighted mean of the particles at each view.
    matched, beyond : ndarray, shape (K,)
        How the map agrees with the view there, see `soundmap.localize.agreement.Agreement`.
    usable : ndarray of bool, shape (K,)
        Whether the particles agreed and the view spoke for them.
    """

    def __init__(
        self,
        room: OccupancyGrid,
        views: Views,
        recognised: NDArray[np.bool_],
        start: FloatArray,
        config: LocalizeConfig,
    ) -> None:
        self._room, self._views, self._config = room, views, config
        self._recognised, self._start = recognised, start
        self._rng = np.random.default_rng(config.seed)
        count = len(views)
        self.pose = np.zeros((count, 3))
        self.matched, self.beyond = np.zeros(count), np.zeros(count)
        self.usable = np.zeros(count, dtype=bool)

    def track(self) -> None:
        """Run over all views."""
        first = int(np.argmax(self._recognised))
        self._run(np.arange(first, len(self._views)))
        self._run(np.arange(first, -1, -1))

    def _run(self, order: NDArray[np.int64]) -> None:
        time_ns, odometry = self._views.time_ns, self._views.odometry
        particles, before, matched_ns = self._seeded(order[0]), order[0], time_ns[order[0]]
        for view in order.tolist():
            lost_s = abs(time_ns[view] - matched_ns) * 1e-9
            if lost_s > LOST_S and self._recognised[view]:
                particles, matched_ns = self._seeded(view), time_ns[view]
            else:
                particles.predict(relative(odometry[before], odometry[view]))
            if self._views.is_evidence[view]:
                particles.correct(self._views.rays(view))
            self._judge(particles, view)
            if self.matched[view] >= self._config.min_match:
                matched_ns = time_ns[view]
            before = view

    def _judge(self, particles: ParticleFilter, view: int) -> None:
        """What the particles say of a view's pose, and whether to trust it."""
        estimate = particles.estimate()
        matched, beyond = view_shares(
            self._room,
            estimate.pose,
            self._views,
            view,
            tolerance_m=3.0 * self._config.hit_sigma_m,
        )
        proved = matched >= FIRST_MATCH and beyond <= MOST_BEYOND
        believed = proved or (self._recognised[view] and matched >= self._config.min_match)
        self.usable[view] = believed and particles.concentrated(estimate)
        self.pose[view], self.matched[view], self.beyond[view] = estimate.pose, matched, beyond

    def _seeded(self, view: int) -> ParticleFilter:
        return ParticleFilter(
            self._room,
            self._start[view],
            self._config,
            range_max_m=self._views.range_max_m,
            rng=self._rng,
        )
