r"""From all audio scans of a run to its sources and their mirror images, by a sparse fit.

What a loud source leaves unexplained may look like a weak one. A component of the fit counts as a
source if such ghosts hardly ever look as much like one: `soundmap.detect.significance`. Sources and
their mirror images then find their places without the ghosts, sources may be louder on one side,
and are told from ghosts once more.

It assumes sources that stand still and sound much of the time, and surfaces that the lasers see.
It fails where a source moves, where two stand within half a metre of each other, and where a weak
one stands near a loud one of the same bearing all along the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from soundmap.config import DetectConfig, ScanConfig
from soundmap.detect.candidates import candidate_places
from soundmap.detect.component import Component
from soundmap.detect.evidence import Evidence, gathered_evidence
from soundmap.detect.growth import grown_fit, settle
from soundmap.detect.harmonics import Single
from soundmap.detect.matched_filter import effective_number
from soundmap.detect.placement import Placement, placement, surface_odds
from soundmap.detect.reflections import is_at_mirror, told_reflections
from soundmap.detect.regions import Region, regions
from soundmap.detect.significance import Marks, false_alarm_probabilities
from soundmap.detect.sound_paths import Kind, Path, departures
from soundmap.detect.sparse_fit import SparseFit
from soundmap.detect.steadiness import steadiness
from soundmap.detect.steps import place_covariances
from soundmap.detect.walls import surface_pieces, surface_points, wall_lines
from soundmap.detect.wandering import is_moving
from soundmap.geometry import CHI_SQUARED_95, FloatArray, Trajectory
from soundmap.grid import OccupancyGrid
from soundmap.sensors import MicArray
from soundmap.sound import AudioScans, Source, SourceFit, SourceList

LEAST_SCANS = 8
LEAST_EFFECTIVE_SCANS = 5.0
"""A source is heard by at least so many scans (effective number)."""
ONE_SOURCE_M = 0.45
"""Components placed nearer to each other than this are one source."""
STAYS_M = 0.4
"""What settles farther from where it was told from ghosts than this is something else: of 396
sources of random scenes none went farther than 0.28 m."""
ADMITTED = 4.0
"""What is no more than so many times as likely to be a ghost as is allowed may settle, and shows
then what it is."""
SEEN_TWICE = 0.7
"""Share of runs with a ghost of no more than some geometric mean of both probabilities, over that
mean: of 120 runs in random rooms none had one below 0.04, and two below 0.05."""
VAGUE_M = 0.5
"""A source is somewhere: within so much of where it is reported [m], with 95 %."""
STRETCH_M = 0.5
"""Bearings err much the same way for half a metre on end."""
SETTLED_ALIKE = 0.6
"""Once they are settled, so much of that: harmonics then err one by one, too."""
ONE_SIDE_RAD = np.radians(40.0)
LOUD_SIDE = 0.75
"""Share of all that is told of a source that makes it no louder than along its axis."""
SILENT, UNSTEADY_SHARE = 0.3, 0.25
"""A source is unsteady if it has less than this share of its strength in so much of what tells: on
random scenes one steady source of a hundred. One that pauses is unsteady, too."""
MOVING_SHARE = 0.05
"""What moves is as silent as that in more of what tells than this; eight in nine that stand are
not, and are not looked at any further."""


@dataclass(frozen=True)
class _Told:
    """A component of the fit, and what speaks for it.

    ``reach_m`` is the greater half axis of its 95 % ellipse beside all other components, ghosts
    among them.
    """

    component: Component
    gain: float
    placement: Placement
    reach_m: float
    probability: float


@dataclass(frozen=True)
class _Ground:
    """The floor of a region: square of each scan, surfaces, and the odds of a source on them."""

    square: NDArray[np.int64]
    surface_m: FloatArray
    odds: FloatArray


def fitted_sources(
    scans: AudioScans,
    around_m: Single,
    trajectory: Trajectory,
    array: MicArray,
    scan: ScanConfig,
    detect: DetectConfig,
    *,
    room: OccupancyGrid | None = None,
) -> SourceList:
    """Sources and mirror images, loudest first.

    Parameters
    ----------
    scans : AudioScans
    around_m : ndarray of float32, shape (S, M)
        Laser ranges around the array at each scan, on its bearings 2 pi m / M [m].
    trajectory : Trajectory
    array : MicArray
    scan : ScanConfig
    detect : DetectConfig
    room : OccupancyGrid, optional
        The geometric map: a surface that it does not show is a machine, not a wall.

    Returns
    -------
    SourceList
        Empty if nothing is told from ghosts.
    """
    evidence = gathered_evidence(scans, around_m, trajectory, array, scan)
    if len(evidence) < LEAST_SCANS:
        return SourceList((), scans.reference)
    found: list[Source] = []
    images: list[tuple[Evidence, Component]] = []
    for region in regions(evidence):
        if len(region.evidence) >= LEAST_SCANS:
            sources, mirrored = _found(region, room, detect.false_alarm_rate)
            found += sources
            images += [(region.evidence, image) for image in mirrored]
    found.sort(key=lambda source: -source.power)
    return SourceList(tuple(found), scans.reference, told_reflections(images, found))


def _found(
    region: Region, room: OccupancyGrid | None, rate: float
) -> tuple[list[Source], list[Component]]:
    """Sources and mirror images that lie in a region."""
    evidence = region.evidence
    surface = surface_points(evidence)
    candidates = candidate_places(evidence, surface)
    fit = grown_fit(evidence, wall_lines(surface), candidates)
    if not fit.components:
        return [], []
    pieces = surface_pieces(surface)
    ground = _Ground(_squares(evidence), pieces, surface_odds(pieces, room))
    told = _told(fit, ground)
    images = [
        each.component
        for each in told
        if each.component.kind == Kind.IMAGE and each.probability <= rate
    ]
    apart = [each for each in _strongest_apart(told) if each.probability <= ADMITTED * rate]
    if not apart and not images:
        return [], []
    stood = {id(each.component): each.component.place_m.copy() for each in apart}
    settle(fit, [*(each.component for each in apart), *images])
    likely = [each for each in _told_again(fit, apart, ground) if each.probability <= rate]
    if 0 < len(likely) < len(apart):
        settle(fit, [*(each.component for each in likely), *_still_in(fit, images)])
    stretch = _stretches(evidence)
    sources = [
        _source(fit, each, stretch)
        for each in _strongest_apart(_placed_anew(fit, likely, ground))
        if effective_number(each.component.paths.gain[Path.DIRECT]) >= LEAST_EFFECTIVE_SCANS
        and each.reach_m <= VAGUE_M
        and np.hypot(*(each.component.place_m - stood[id(each.component)])) <= STAYS_M
        and region.owns(each.placement.place_m)
    ]
    mirrored = [image for image in _still_in(fit, images) if region.owns(image.place_m)]
    return sources, mirrored


def _told(fit: SparseFit, ground: _Ground) -> list[_Told]:
    """All components with what speaks for them, those that explain most first."""
    components = fit.components
    places = _placements(fit, ground)
    noise = fit.noise
    marks = Marks(
        gain=np.array([fit.gain(index) / noise for index in range(len(components))]),
        steadiness=steadiness(fit, ground.square),
        surface_odds=np.array([place.surface_odds for place in places]),
        behind_m=np.array([_behind_m(component) for component in components]),
    )
    told = [
        _Told(component, float(gain), place, _reach_m(place), float(probability))
        for component, gain, place, probability in zip(
            components, marks.gain, places, false_alarm_probabilities(marks), strict=True
        )
    ]
    return sorted(told, key=lambda each: -each.gain)


def _told_again(fit: SparseFit, told: Sequence[_Told], ground: _Ground) -> list[_Told]:
    """Those that are still in the fit, now that they have settled.

    What a ghost explains is mostly lost once sources may be louder on one side. The log odds of
    both times count the same, so that the probability goes with the geometric mean.
    """
    now = {id(each.component): each.probability for each in _told(fit, ground)}
    return [
        replace(each, probability=SEEN_TWICE * float(np.sqrt(each.probability * now[key])))
        for each in told
        if (key := id(each.component)) in now
    ]


def _still_in(fit: SparseFit, components: Sequence[Component]) -> list[Component]:
    return [each for each in components if each in fit.components]


def _placed_anew(fit: SparseFit, told: Sequence[_Told], ground: _Ground) -> list[_Told]:
    """Those that are still in the fit, where they are now."""
    placements = _placements(fit, ground, SETTLED_ALIKE)
    places = dict(zip(map(id, fit.components), placements, strict=True))
    return [
        replace(each, placement=places[id(each.component)])
        for each in told
        if each.component in fit.components
    ]


def _placements(fit: SparseFit, ground: _Ground, alike: float = 1.0) -> list[Placement]:
    """Where each component stands, if such a share of what may err alike does."""
    return [
        placement(
            component.place_m.copy(),
            alike * _erring_alike(component, ground.square) * covariance,
            ground.surface_m,
            ground.odds,
        )
        for component, covariance in zip(fit.components, place_covariances(fit), strict=True)
    ]


def _strongest_apart(told: Sequence[_Told]) -> list[_Told]:
    """Of sources that lie together, the one that explains most."""
    kept: list[_Told] = []
    for each in told:
        if each.component.kind == Kind.IMAGE:
            continue
        apart = [np.hypot(*(other.placement.place_m - each.placement.place_m)) for other in kept]
        if min(apart, default=np.inf) > ONE_SOURCE_M:
            kept.append(each)
    return kept


def _reach_m(place: Placement) -> float:
    """Greater half axis of the 95 % ellipse [m]."""
    return float(np.sqrt(CHI_SQUARED_95 * np.linalg.eigvalsh(place.covariance_m2)[-1]))


def _behind_m(component: Component) -> float:
    """How far a source lies behind the surfaces that scans see in front of it, on average [m]."""
    gain, beyond = component.paths.gain[Path.DIRECT], component.paths.beyond_m
    known = np.isfinite(beyond) & (gain > 0.0)
    if component.kind == Kind.IMAGE or not known.any():
        return 0.0
    return max(float(np.average(beyond[known], weights=gain[known] ** 2)), 0.0)


def _source(fit: SparseFit, told: _Told, stretch: NDArray[np.int64]) -> Source:
    component, place = told.component, told.placement.place_m
    strength, told_of = fit.strengths_along(fit.components.index(component), stretch)
    power = _power(fit, component)
    heard = component.paths.gain[Path.DIRECT] > 0.0
    arc = _arc(fit.evidence.place_m[heard], place)
    flags = []
    if not told.placement.on_surface:
        flags.append("not_seen_by_laser")
    louder = [each.place_m for each in fit.components if _power(fit, each) > power]
    if is_at_mirror(component.place_m, np.reshape(louder, (-1, 2)), fit.walls):
        flags.append("reflection_suspected")
    if arc < ONE_SIDE_RAD:
        flags.append("seen_from_one_side")
    along = _relative(strength, told_of, component.strength)
    lobe = np.bincount(stretch, _lobe(fit, component)) / np.bincount(stretch)
    sent = _relative(lobe[:, None] * strength, told_of, component.strength)
    silent = _silent_share(*along)
    if silent > UNSTEADY_SHARE or component.sounding is not None:
        flags.append("unsteady")
    if silent > MOVING_SHARE and component.sounding is None and is_moving(fit, component):
        flags.append("moving")
    details = SourceFit(
        float(component.strength.sum()) * _loud_side(*sent),
        told.placement.covariance_m2,
        told.probability,
        arc,
        tuple(flags),
    )
    visits = int(fit.evidence.merged[heard].sum())
    return Source(float(place[0]), float(place[1]), power, visits, details)


def _lobe(fit: SparseFit, component: Component) -> FloatArray:
    """What its directivity makes of a component's strength toward each scan, shape (S,)."""
    toward = departures(fit.walls, component.place_m, fit.evidence.place_m)[Path.DIRECT]
    return np.asarray(np.exp(toward @ component.directivity))


def _power(fit: SparseFit, component: Component) -> float:
    """Mean square at 1 m that a component sends to the scans, those that are near before all."""
    gain = component.paths.gain[Path.DIRECT]
    even = np.sum(gain / _lobe(fit, component))
    return float(component.strength.sum() * (gain.sum() / even if even > 0.0 else 1.0))


def _squares(evidence: Evidence) -> NDArray[np.int64]:
    """Number of the square of the floor that each scan was taken in.

    What the model does not know errs alike in all scans of a square, lap for lap.
    """
    cell = np.floor(evidence.place_m / STRETCH_M)
    return np.unique(cell, axis=0, return_inverse=True)[1].ravel().astype(np.int64)


def _erring_alike(component: Component, square: NDArray[np.int64]) -> float:
    """How many scans err alike: of those that tell of a component, so many a square."""
    told = component.paths.gain[Path.DIRECT] ** 2
    if not told.any():
        return 1.0
    return float(np.sum(np.bincount(square, told) ** 2) / np.sum(told**2))


def _stretches(evidence: Evidence) -> NDArray[np.int64]:
    """Number of the stretch of the way that each scan was taken in."""
    step = np.hypot(*np.diff(evidence.place_m, axis=0).T)
    way = np.concatenate([[0.0], np.cumsum(step)])
    return np.unique(np.floor(way / STRETCH_M), return_inverse=True)[1].astype(np.int64)


def _relative(
    strength: FloatArray, told: FloatArray, mean: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Strength of each stretch over the mean one, and how much weight it has; sub-bands joined."""
    weight = np.where(np.isfinite(strength), told, 0.0) * mean**2
    weight[weight < 1.0] = 0.0  # tells less than the noise hides
    value = np.where(weight > 0.0, strength, 0.0) / np.maximum(mean, 1e-30)
    total = weight.sum(axis=1)
    kept = total > 0.0
    return (weight * value).sum(axis=1)[kept] / total[kept], total[kept]


def _loud_side(value: FloatArray, weight: FloatArray) -> float:
    """Strength on the side that a source faces, over its mean one.

    Sources radiate less to their sides and backs. What a quarter of the way exceeds comes near to
    what they radiate along their axis, and does not hang on the loudest stretch.
    """
    if not len(value):
        return 1.0
    order = np.argsort(value)
    below = np.cumsum(weight[order])
    return max(float(value[order][np.searchsorted(below, LOUD_SIDE * below[-1])]), SILENT)


def _silent_share(value: FloatArray, weight: FloatArray) -> float:
    heard = np.sqrt(weight)  # near stretches shall not decide alone
    return float(heard[value < SILENT].sum() / max(heard.sum(), 1e-30))


def _arc(stand_m: FloatArray, place_m: FloatArray) -> float:
    """Width of the directions from which a place was heard [rad]."""
    step = stand_m - place_m
    angle = np.sort(np.arctan2(step[:, 1], step[:, 0]))
    gaps = np.diff(np.append(angle, angle[:1] + 2.0 * np.pi))
    return float(2.0 * np.pi - gaps.max(initial=0.0))
