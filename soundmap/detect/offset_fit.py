r"""Offset fit: what the array's clock and yaw lack, by all that was heard.

The bearings of peaks are pulled by whatever sounds beside them. The sparse fit knows what sounds
beside them: with its components where they are, a scan is

.. math:: y_s = \sum_k q_k \, a_{k,s} + A_s f + J_s \, (\delta, \psi)^T + e_s,

J being its derivative by what the array's clock :math:`\delta` and yaw :math:`\psi` lack. Places,
shares, strengths, directivities and the far field are unknowns beside those two: in each step all
are solved for together, and those of the fit eliminated.

What tells of :math:`\delta` and :math:`\psi` is the shape over the bearings: see
`soundmap.detect.model_errors.FREE_ERRORS`. Machines radiate less to their backs, and what walls
reflect shows up on other bearings: hence the directivities, of level as a cosine of the direction.
The late sound of a room arrives from all heights, to which the array's response over the bearings
differs: the far field is the sum of two such fields.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from soundmap.detect.candidates import candidate_places
from soundmap.detect.component import Component
from soundmap.detect.evidence import Evidence
from soundmap.detect.far_field import FarFieldBand
from soundmap.detect.growth import carried_fit, rough_fit
from soundmap.detect.model_errors import FREE_ERRORS, Precision, parts
from soundmap.detect.offset_derivatives import by_offsets
from soundmap.detect.regions import Region, regions, telling
from soundmap.detect.sparse_fit import SparseFit
from soundmap.detect.unknowns import Owner, change, derivatives, held, unknowns
from soundmap.detect.walls import surface_points, wall_lines
from soundmap.geometry import FloatArray
from soundmap.memory import give_back

ROUNDS, STEP_SHARE = 5, 0.8
"""Steps go this share of the way: reflections turn along with what they reflect, so that whole
ones would go too far."""
LEAST_SCANS, MOST_SCANS, MOST_REGIONS = 40, 500, 2
"""Of a region so many scans are looked at, and of a large site so many regions."""
LEAST_GAIN = 300.0
"""The fit grows until no candidate explains more than this, in units of the noise."""
FAR_APERTURES = 0, 4
"""Of the beam table: waves along the floor, and from 38 degrees above or below."""
DAMPING = np.array([25.0, 25.0])
"""Information on clock [1/s^2] and yaw [1/rad^2] that damps each step."""
GREATEST_STEP = np.array([0.03, 0.03])
SETTLED = np.array([0.005, np.radians(0.5)])
"""A fit whose last step is greater than this [s, rad] has found nothing."""
HeardAt = Callable[[float, float], tuple[Evidence, FloatArray]]
"""What was heard from where, and how fast the array moved (S, 3), with so much added to clock [s]
and yaw [rad]."""


@dataclass(frozen=True)
class FittedOffsets:
    """Clock and yaw as the fit has them.

    Attributes
    ----------
    state : ndarray, shape (2,)
        Clock [s] and yaw [rad].
    covariance : ndarray, shape (2, 2)
    explained : float
        Share of what was heard, by its square, that components and far field explain.
    """

    state: FloatArray
    covariance: FloatArray
    explained: float


def offsets_by_fit(start: FloatArray, heard_at: HeardAt) -> FittedOffsets | None:
    """Clock and yaw by the fit alone.

    Parameters
    ----------
    start : ndarray, shape (2,)
        Clock [s] and yaw [rad] to begin from, right to within some 15 ms and 1.5 degrees.
    heard_at : callable

    Returns
    -------
    FittedOffsets or None
        None if nothing is told.
    """
    state = start
    sites: list[_Site] = []
    for _ in range(ROUNDS):
        evidence, velocity = heard_at(float(state[0]), float(state[1]))
        if not sites:
            sites = _sites(evidence)
            give_back()
        told = [each for site in sites if (each := site.told(evidence, velocity)) is not None]
        if not told:
            return None
        information = np.diag(DAMPING) + sum(each.information for each in told)
        covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        step = covariance @ sum(each.pull for each in told)
        step = np.clip(STEP_SHARE * step, -GREATEST_STEP, GREATEST_STEP)
        for each in told:
            each.move(step)
        state = state + step
    if np.any(np.abs(step) > SETTLED):
        return None
    left, heard = (sum(each.energy[index] for each in told) for index in (0, 1))
    return FittedOffsets(state, covariance, 1.0 - left / heard)


@dataclass
class _Site:
    """A region and what sounds there: all that is kept of a fit, which is large."""

    region: Region
    walls: FloatArray
    components: Sequence[Component]

    def told(self, evidence: Evidence, velocity: FloatArray) -> _Told | None:
        """What it tells of clock and yaw; None if nothing sounds there."""
        scans = _some(telling(evidence, self.region.low_m, self.region.high_m))
        if len(scans) < LEAST_SCANS:
            return None
        fit = carried_fit(self.components, self.walls, evidence.chosen(scans))
        self.components = fit.components
        give_back()
        return _told(fit, velocity[scans]) if fit.components else None


def _sites(evidence: Evidence) -> list[_Site]:
    """The regions with most scans, and a rough fit to each."""
    sites = []
    for region in sorted(regions(evidence), key=lambda each: -len(each.evidence))[:MOST_REGIONS]:
        some = region.evidence.chosen(_some(np.arange(len(region.evidence))))
        if len(some) >= LEAST_SCANS:
            surface = surface_points(some)
            walls, candidates = wall_lines(surface), candidate_places(some, surface)
            fit = rough_fit(some, walls, candidates, least_gain=LEAST_GAIN)
            sites.append(_Site(region, walls, fit.components))
    return sites


def _some(scans: NDArray[np.int64]) -> NDArray[np.int64]:
    """No more than `MOST_SCANS` of them, evenly chosen."""
    count = min(len(scans), MOST_SCANS)
    return scans[np.arange(count) * len(scans) // max(count, 1)]


@dataclass(frozen=True)
class _Told:
    """What a fit tells of clock and yaw, its own unknowns eliminated.

    ``information`` (2, 2) and ``pull`` (2,) are of clock and yaw. The step of the fit's unknowns is
    ``alone`` less ``bound`` times that of clock and yaw; those with ``owners`` come first.
    ``energy`` is what the fit leaves unexplained of what was heard, and all of it.
    """

    information: FloatArray
    pull: FloatArray
    alone: FloatArray
    bound: FloatArray
    owners: Sequence[Owner]
    energy: tuple[float, float]

    def move(self, step: FloatArray) -> None:
        """Places, shares and directivities as such a step of clock and yaw has them."""
        own = STEP_SHARE * self.alone - self.bound @ step
        for owner, of_owner in zip(self.owners, own[: len(self.owners)], strict=True):
            change(owner, float(of_owner))


def _told(fit: SparseFit, velocity: FloatArray) -> _Told:
    """Normal equations of clock, yaw and all unknowns of a fit, summed up part by part.

    Clock and yaw come first, then the unknowns of components, then for each sub-band the strengths
    and the harmonics of the far field. The fit is of no use afterwards.
    """
    evidence, starts = fit.evidence, fit.evidence.table.starts
    del fit.precision  # it is large, and the next one, too
    precision = Precision(evidence, fit.components, fit.far_heard, FREE_ERRORS)
    offsets = by_offsets(fit, velocity)
    owners = unknowns(fit.components, directed=True)
    first = 2 + len(owners)
    far = [
        [FarFieldBand(evidence, band, slice(*own), aperture) for aperture in FAR_APERTURES]
        for band, own in enumerate(pairwise(starts))
    ]
    sizes = [len(fit.components) + len(FAR_APERTURES) * (b - a) for a, b in pairwise(starts)]
    ends = np.cumsum([first, *sizes])
    normal, right = np.zeros((ends[-1], ends[-1])), np.zeros(ends[-1])
    for scans in parts(len(evidence)):
        common = np.stack([*offsets[:, scans], *derivatives(fit, owners, scans)])
        for band, (start, stop) in enumerate(pairwise(starts)):
            own = np.stack([each.column[scans, start:stop] for each in fit.components])
            waves = [each.columns(scans).transpose(2, 0, 1) for each in far[band]]
            columns = np.concatenate([common[:, :, start:stop], own, *waves]).transpose(1, 2, 0)
            weighted = np.matmul(precision.inverse[band][scans], columns)
            flat, weighted = (each.reshape(-1, columns.shape[2]) for each in (columns, weighted))
            index = np.r_[:first, ends[band] : ends[band + 1]]
            normal[np.ix_(index, index)] += flat.T @ weighted
            right[index] += weighted.T @ fit.residual[scans, start:stop].ravel()
    priors = np.array([held(owner) for owner in owners]).reshape(-1, 2)
    right[2:first] -= priors[:, 0] * priors[:, 1]
    firmness = [*priors[:, 0]]
    for band, fields in enumerate(far):
        firmness += [0.0] * len(fit.components)
        for field in fields:
            firmness += [field.held] * (starts[band + 1] - starts[band])
    normal[2:, 2:] += np.diag(firmness)
    left, heard = (float(np.sum(each**2)) for each in (fit.residual, evidence.heard))
    return _Told(*_eliminated(normal, right), owners, (left, heard))


def _eliminated(
    normal: FloatArray, right: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Normal equations of which clock and yaw, which stand first, are left; as in `_Told`."""
    own, coupling = normal[2:, 2:], normal[2:, :2]
    scale = np.sqrt(np.diag(own)) + 1e-12
    scaled = own / np.outer(scale, scale) + 1e-8 * np.eye(len(own))
    both = np.column_stack([coupling, right[2:]]) / scale[:, None]
    solved: FloatArray = (np.linalg.solve(scaled, both) / scale[:, None]).astype(np.float64)
    bound, alone = solved[:, :2], solved[:, 2]
    return normal[:2, :2] - coupling.T @ bound, right[:2] - coupling.T @ alone, alone, bound
