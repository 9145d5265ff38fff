"""Following the robot scan by scan: the particle filter, and what to do when it is lost. Sect. 2.2.

While the particles do not agree, what was seen is kept, and once they do, the filter runs back over
it: a whole run is at hand, so its beginning need not be lost.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np

from soundmap.config import LocalizeConfig
from soundmap.errors import MapError
from soundmap.geometry import FloatArray, composed, relative
from soundmap.grid import OccupancyGrid
from soundmap.localize.global_start import start_hypotheses
from soundmap.localize.likelihood import Agreement
from soundmap.localize.particle_filter import ParticleFilter
from soundmap.localize.views import STAGE, View, joined_rays
from soundmap.losses import LossLedger

LOST_AFTER_S = 2.0
"""Without a match for this long, the pose is sought in the whole map."""
ODOMETRY_DRIFT = 0.2
"""Worst drift of any odometry in use [m/m and rad/m]."""
FIRST_MATCH = 0.6
"""Share of a scan that must match before any pose of the run is trusted."""
ELSEWHERE_MATCH = 0.8
"""Share of a scan that must match to believe that the robot is where odometry cannot have led."""
MOST_BEYOND = 0.10
"""Share of a scan that may lie behind the map's walls where a pose has to be proved."""
OPENING_NS = 300_000_000
"""Scans this close together are matched to the map as one."""
MOST_PENDING = 20_000
"""Scans kept while the particles do not agree; bounds the memory of a run that stays lost."""


@dataclass(frozen=True)
class Fix:
    """The pose found for a view, how the map agrees with it there, and whether to trust it."""

    view: View
    pose: FloatArray
    agreement: Agreement
    usable: bool
    covariance: FloatArray | None = None

    @property
    def time_ns(self) -> int:
        """Time of the pose [ns since epoch]."""
        return self.view.time_ns


class Tracker:
    """Runs the particle filter over the views; seeks the pose in the whole map when it is lost."""

    def __init__(
        self,
        room: OccupancyGrid,
        config: LocalizeConfig,
        rng: np.random.Generator,
        losses: LossLedger,
    ) -> None:
        self._room, self._config, self._rng, self._losses = room, config, rng, losses
        self._filter: ParticleFilter | None = None
        self._odometry = np.zeros(3)
        self._pending: list[tuple[int, View]] = []
        self._anchor: Fix | None = None
        self._recent: dict[int, View] = {}
        self._matched_ns = 0
        self._patience_s = LOST_AFTER_S
        self.fixes: list[Fix] = []

    def start(self, opening: list[View], start_pose: FloatArray | None) -> None:
        """Place the particles, from a given pose or by a search with the first views."""
        first = opening[0]
        if start_pose is None:
            hypotheses, _ = start_hypotheses(self._room, joined_rays(opening, first))
            if len(hypotheses) == 0:
                raise MapError("the map has no free space in which the robot could stand.")
        else:
            hypotheses = start_pose[None, :]
        self._filter = self._seeded(hypotheses, first)
        self._odometry, self._matched_ns = first.odometry, first.rays.time_ns

    def add(self, view: View) -> None:
        """Use one more scan."""
        if self._filter is None:
            raise ValueError("start the localizer first")
        self._filter.predict(relative(self._odometry, view.odometry))
        self._odometry = view.odometry
        self._recent[view.scanner] = view
        if view.is_evidence:
            self._filter.correct(view.rays)
        fix = self._fix(self._filter, view)
        self.fixes.append(fix)
        self._anchor = fix if fix.usable else self._anchor
        if fix.agreement.matched >= self._config.min_match:
            self._matched_ns, self._patience_s = view.time_ns, LOST_AFTER_S
        if fix.usable:
            self._look_back(self._filter)
            return
        if len(self._pending) < MOST_PENDING:
            self._pending.append((len(self.fixes) - 1, view))
        if (view.time_ns - self._matched_ns) * 1e-9 > self._patience_s:
            self._seek(view, fix.pose)

    def _seeded(self, hypotheses: FloatArray, view: View) -> ParticleFilter:
        return ParticleFilter(
            self._room,
            hypotheses,
            self._config,
            range_max_m=view.range_max_m,
            rng=self._rng,
        )

    def _fix(self, particle_filter: ParticleFilter, view: View) -> Fix:
        estimate = particle_filter.estimate()
        agreement = particle_filter.agreement(estimate, view.rays)
        usable = particle_filter.concentrated(estimate) and self._believed(
            view, estimate.pose, agreement
        )
        # Only smoothing looks at the rays again; an hour of them would fill 100 MB.
        kept = view if self._config.smoothing else view.without_rays()
        return Fix(kept, estimate.pose, agreement, usable)

    def _believed(self, view: View, pose: FloatArray, agreement: Agreement) -> bool:
        """Whether the scan speaks for the pose, the more so the less is known of the run."""
        needed, most_beyond = self._config.min_match, 1.0
        if self._anchor is None:
            needed, most_beyond = max(needed, FIRST_MATCH), MOST_BEYOND
        elif not _consistent(self._anchor, view, pose):
            needed, most_beyond = max(needed, ELSEWHERE_MATCH), MOST_BEYOND
        return agreement.matched >= needed and agreement.beyond <= most_beyond

    def _look_back(self, particle_filter: ParticleFilter) -> None:
        """Run back over the views that came before the particles agreed."""
        pending, self._pending = self._pending, []
        backward, odometry = copy(particle_filter), self._odometry
        for index, view in reversed(pending):
            backward.predict(relative(odometry, view.odometry))
            odometry = view.odometry
            if view.is_evidence:
                backward.correct(view.rays)
            fix = self._fix(backward, view)
            if fix.usable:
                self.fixes[index] = fix

    def _seek(self, view: View, expected: FloatArray) -> None:
        """Search the whole map; the pose expected from odometry stays a hypothesis."""
        near = [
            recent
            for recent in self._recent.values()
            if abs(recent.rays.time_ns - view.time_ns) < OPENING_NS
        ]
        hypotheses, _ = start_hypotheses(self._room, joined_rays(near, view))
        self._filter = self._seeded(np.vstack([hypotheses, expected]), view)
        self._matched_ns, self._patience_s = view.time_ns, 2.0 * self._patience_s
        self._losses.remark(
            "laser scans stopped matching the map",
            STAGE,
            effect="pose sought in the whole map",
        )


def _consistent(anchor: Fix, view: View, pose: FloatArray) -> bool:
    """Whether the odometry can have led from a trusted pose to this one."""
    expected = composed(anchor.pose, relative(anchor.view.odometry, view.odometry))
    driven_m = abs(view.driven_m - anchor.view.driven_m)
    off = relative(expected, pose)
    near = np.hypot(off[0], off[1]) <= 0.5 + ODOMETRY_DRIFT * driven_m
    return bool(near and abs(off[2]) <= np.radians(20.0) + ODOMETRY_DRIFT * driven_m)
