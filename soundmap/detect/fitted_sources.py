r"""From all audio scans of a run to its sources and their mirror images, by a sparse fit.

A component of the fit counts as a source if it explains more than chance and the model's own
imperfection would:

- *Chance*: the scans of each stretch of the way are turned by an angle of their own, which keeps
  all that was heard but where it came from. The best candidate of many such runs follows a Gumbel
  distribution; its tail gives the probability of a false alarm anywhere in the run.
- *Imperfection*: beams, directivity and propagation are known to a few percent only, and what a
  loud source leaves unexplained may look like a weak one. A source must explain a set share of
  all that the fit leaves over.

It assumes sources that stand still and sound most of the time, and surfaces that the lasers see.
It fails where a source moves, where two stand within half a metre of each other, and where a
source far above the lasers' plane is heard from one side only.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from soundmap.config import DetectConfig, ScanConfig
from soundmap.detect.candidates import Kind, candidate_places
from soundmap.detect.evidence import Evidence, Single, gathered_evidence
from soundmap.detect.matched_filter import explained_energy, heard_enough
from soundmap.detect.sparse_fit import Component, SparseFit, fitted_components
from soundmap.geometry import FloatArray, Trajectory
from soundmap.grid import OccupancyGrid
from soundmap.sensors import MicArray
from soundmap.sound import AudioScans, Reflection, Source, SourceFit, SourceList

LEAST_SCANS = 8
GROWTH_SHARE = 0.012
"""The fit grows until no candidate explains more than this share of what is left."""
MOST_COMPONENTS = 24
CHANCE_RUNS = 20
CHANCE_SEED = 8
LEAST_SHARE = {Kind.SURFACE: 0.04, Kind.OPEN: 0.12}
"""Least energy of a source over what the whole fit leaves unexplained."""
MOST_EXCESS = 1.35
"""What a source explains with strengths that vary along the way, over what its mean strength
alone accounts for. More is sound that does not fade with distance as that of a source does."""
ONE_SOURCE_M = 0.5
"""Components nearer to each other than this are one source."""
AROUND_M = 0.3
"""A source's place is averaged over this neighbourhood."""
OPEN_STEP_M = 0.05
INDEPENDENT_SHARE = 0.03
"""Independent measurements among the scans' bearings, as a share of their number."""
PLACE_SIGMA_M = 0.022
"""Standard deviation of a place that is due to cells, ranges and poses [m]."""
BEFORE_WALL_SIGMA_M = 0.12
"""Standard deviation toward the robot where only a wall is seen: the source may hang before it."""
WALL_M = 0.10
"""A surface nearer than this to an occupied cell of the map is a wall; others are machines."""
LEAVE_SURFACE_M, LEAVE_SURFACE_RATIO, LEAVE_SURFACE_SHARE = 0.10, 1.03, 0.0065
"""A source leaves the surface for a place in the open this far from it that explains so much more
than the surface does: a ratio, and a share of what the whole fit leaves unexplained."""
LEAVE_SURFACE_AROUND_M = 0.6
IMAGE_TOLERANCE_M = 0.35
JUST_BEHIND_M, ALONE_M = 0.4, 1.0
ONE_SIDE_RAD = np.radians(40.0)
UNSTEADY_SHARE = 0.35


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
        Empty if nothing is told from chance.
    """
    evidence = gathered_evidence(scans, around_m, trajectory, array, scan)
    none = SourceList((), scans.reference)
    if len(evidence) < LEAST_SCANS:
        return none
    candidates = candidate_places(evidence)
    heard = heard_enough(evidence, candidates.place_m, candidates.kind)
    if not heard.any():
        return none
    candidates = dataclasses.replace(
        candidates, place_m=candidates.place_m[heard], kind=candidates.kind[heard]
    )
    fit = fitted_components(evidence, candidates, least_share=GROWTH_SHARE, most=MOST_COMPONENTS)
    if not fit.components:
        return none
    _bring_to_surface(fit)
    location, scale = chance_distribution(fit)
    energies = [fit.energy_without(index) - fit.energy for index in range(len(fit.components))]
    probabilities = [float(-np.expm1(-np.exp(-(e - location) / scale))) for e in energies]
    chosen = [
        index
        for index in _strongest_apart(fit.components, energies)
        if probabilities[index] <= detect.false_alarm_rate
        and energies[index] >= LEAST_SHARE[fit.components[index].kind] * fit.energy
        and energies[index] <= MOST_EXCESS * fit.energy_at_mean_strength(index)
    ]
    chosen.sort(key=lambda index: -fit.strength[index])
    for index in chosen:
        _leave_surface(fit, index)
    sources = tuple(_source(fit, index, probabilities[index], room) for index in chosen)
    return SourceList(sources, scans.reference, _reflections(fit, probabilities, sources, detect))


def _bring_to_surface(fit: SparseFit) -> None:
    """Put what lies just behind a surface, with no other sound near it, onto the surface.

    Reflections in the wall behind a source pull it outward; a mirror image proper has its source
    as far in front of the surface as it lies behind.
    """
    surface = fit.candidates.surface_m
    for index, component in enumerate(fit.components):
        if component.kind != Kind.BEHIND or np.median(component.beyond_m) > JUST_BEHIND_M:
            continue
        others = [
            np.hypot(*(other.place_m - component.place_m))
            for other in fit.components
            if other.kind != Kind.BEHIND
        ]
        away = np.hypot(*(surface - component.place_m).T)
        near = surface[away < LEAVE_SURFACE_AROUND_M]
        if min(others, default=np.inf) < ALONE_M or not len(near):
            continue
        residual = fit.with_own(index)
        kinds = np.full(len(near), int(Kind.SURFACE), dtype=np.int64)
        explained = explained_energy(fit.evidence, residual, [component.slope], near, kinds)[0]
        place = near[int(np.argmax(explained))]
        fit.replace(index, Component.at(fit.evidence, place, Kind.SURFACE, component.slope))


def chance_distribution(fit: SparseFit) -> tuple[float, float]:
    """Location and scale of the Gumbel distribution of what the best candidate explains by chance.

    From the fit's residual, each stretch of the way turned by a random number of bearings.
    """
    rng = np.random.default_rng(CHANCE_SEED)
    bearings = fit.residual.shape[1]
    best = []
    for _ in range(CHANCE_RUNS):
        shift = rng.integers(0, bearings, fit.stretches)[fit.stretch]
        index = (np.arange(bearings) + shift[:, None]) % bearings
        turned = np.take_along_axis(fit.residual, index, axis=1)
        best.append(fit.best_candidate(turned)[0])
    scale = max(float(np.std(best, ddof=1)) * np.sqrt(6.0) / np.pi, 1e-12)
    return float(np.mean(best)) - np.euler_gamma * scale, scale


def _strongest_apart(components: Sequence[Component], energies: Sequence[float]) -> list[int]:
    """Of components that lie together and are no mirror images, the one that explains most."""
    kept: list[int] = []
    for index in np.argsort(-np.asarray(energies), kind="stable"):
        own = components[index]
        if own.kind == Kind.BEHIND:
            continue
        apart = [np.hypot(*(components[other].place_m - own.place_m)) for other in kept]
        if min(apart, default=np.inf) > ONE_SOURCE_M:
            kept.append(int(index))
    return kept


def _leave_surface(fit: SparseFit, index: int) -> None:
    """Move a component into the open if all scans clearly say that it is not on the surface."""
    component, evidence = fit.components[index], fit.evidence
    if component.kind != Kind.SURFACE:
        return
    steps = np.arange(-LEAVE_SURFACE_AROUND_M, LEAVE_SURFACE_AROUND_M + 1e-9, OPEN_STEP_M)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) + component.place_m
    surface = fit.candidates.surface_m
    near = np.hypot(*(surface - component.place_m).T) < LEAVE_SURFACE_AROUND_M
    places = np.concatenate([grid, surface[near]])
    kinds = np.full(len(places), int(Kind.OPEN), dtype=np.int64)
    kinds[len(grid) :] = int(Kind.SURFACE)
    residual = fit.with_own(index)
    explained = explained_energy(evidence, residual, [component.slope], places, kinds)[0]
    in_open, on_surface = explained[: len(grid)], explained[len(grid) :]
    best = int(np.argmax(in_open))
    gain = in_open[best] - on_surface.max(initial=0.0)
    nearest = places[len(grid) + int(np.argmax(on_surface))]
    if (
        gain > LEAVE_SURFACE_SHARE * fit.energy
        and in_open[best] > LEAVE_SURFACE_RATIO * on_surface.max(initial=0.0)
        and np.hypot(*(grid[best] - nearest)) > LEAVE_SURFACE_M
    ):
        fit.replace(index, Component.at(evidence, grid[best], Kind.OPEN, component.slope))


def _source(fit: SparseFit, index: int, probability: float, room: OccupancyGrid | None) -> Source:
    component = fit.components[index]
    place, covariance = located(fit, index)
    if component.kind == Kind.SURFACE and _on_wall(room, place):
        toward = _direction_heard(fit, index, place)
        covariance = covariance + BEFORE_WALL_SIGMA_M**2 * np.outer(toward, toward)
    elif component.kind == Kind.OPEN:
        covariance = covariance + (0.5 * BEFORE_WALL_SIGMA_M) ** 2 * np.eye(2)
    power = float(fit.strength[index])
    arc = _arc(fit.evidence, component.scans, place)
    flags = []
    if component.kind == Kind.OPEN:
        flags.append("not_seen_by_laser")
    if arc < ONE_SIDE_RAD:
        flags.append("seen_from_one_side")
    told = fit.evidence_along(index)
    silent = fit.strength_along(index) < 0.35 * power
    if told[silent].sum() > UNSTEADY_SHARE * told.sum():
        flags.append("unsteady")
    visits = int(fit.evidence.merged[component.scans].sum())
    details = SourceFit(power, covariance, probability, arc, tuple(flags))
    return Source(float(place[0]), float(place[1]), power, visits, details)


def located(fit: SparseFit, index: int) -> tuple[FloatArray, FloatArray]:
    """Mean place [m] and covariance [m^2] of a component, given what all others explain.

    The places near it, on surfaces or in the open as it is, are weighted by their likelihood.
    """
    component, evidence = fit.components[index], fit.evidence
    if component.kind == Kind.SURFACE:
        away = np.hypot(*(fit.candidates.surface_m - component.place_m).T)
        places = fit.candidates.surface_m[away < AROUND_M]
    else:
        steps = np.arange(-AROUND_M, AROUND_M + 1e-9, OPEN_STEP_M)
        grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        places = component.place_m + grid
    kinds = np.full(len(places), int(component.kind), dtype=np.int64)
    residual = fit.with_own(index)
    explained = explained_energy(evidence, residual, [component.slope], places, kinds)[0]
    noise = fit.energy / (INDEPENDENT_SHARE * fit.residual.size)
    weight = np.exp((explained - explained.max(initial=0.0)) / (2.0 * noise))
    weight /= weight.sum()
    mean = weight @ places
    spread = (places - mean).T @ ((places - mean) * weight[:, None])
    return mean, spread + PLACE_SIGMA_M**2 * np.eye(2)


def _on_wall(room: OccupancyGrid | None, place_m: FloatArray) -> bool:
    """Whether the map shows a surface there; also if there is no map to tell."""
    if room is None:
        return True
    cell = room.frame.cells(place_m)
    if not room.frame.contains(cell):
        return True
    clearance = float(room.clearance_cells[tuple(cell)]) * room.frame.resolution_m
    return clearance < WALL_M


def _direction_heard(fit: SparseFit, index: int, place_m: FloatArray) -> FloatArray:
    """Unit vector from a place to where it was heard best, on average."""
    component = fit.components[index]
    step = fit.evidence.place_m[component.scans] - place_m
    weight = np.einsum("sn,sn->s", component.column, component.column).astype(np.float64)
    mean = weight @ (step / np.maximum(np.hypot(*step.T), 1e-6)[:, None])
    return np.asarray(mean / max(float(np.hypot(*mean)), 1e-12))


def _arc(evidence: Evidence, scans: NDArray[np.int64], place_m: FloatArray) -> float:
    """Width of the directions from which a place was heard [rad]."""
    step = evidence.place_m[scans] - place_m
    angle = np.sort(np.arctan2(step[:, 1], step[:, 0]))
    gaps = np.diff(np.append(angle, angle[:1] + 2.0 * np.pi))
    return float(2.0 * np.pi - gaps.max(initial=0.0))


def _reflections(
    fit: SparseFit,
    probabilities: Sequence[float],
    sources: tuple[Source, ...],
    detect: DetectConfig,
) -> tuple[Reflection, ...]:
    images = [
        index
        for index, component in enumerate(fit.components)
        if component.kind == Kind.BEHIND and probabilities[index] <= detect.false_alarm_rate
    ]
    images.sort(key=lambda index: -fit.strength[index])
    return tuple(
        Reflection(
            float(fit.components[index].place_m[0]),
            float(fit.components[index].place_m[1]),
            float(fit.strength[index]),
            _reflected_source(fit, fit.components[index], sources),
        )
        for index in images
    )


def _reflected_source(fit: SparseFit, image: Component, sources: tuple[Source, ...]) -> int | None:
    """The source whose mirror the surfaces in front of an image are, if there is one.

    The mirror lies half way between source and image, at right angles to the line between them:
    that is where the lasers should see a surface on the bearings of the image.
    """
    best, least = None, IMAGE_TOLERANCE_M
    stand = fit.evidence.place_m[image.scans]
    ray = image.place_m - stand
    length = np.hypot(*ray.T)
    for number, source in enumerate(sources):
        across = image.place_m - (source.x_m, source.y_m)
        middle = image.place_m - 0.5 * across
        along = ray @ across
        with np.errstate(divide="ignore", invalid="ignore"):
            share = ((middle - stand) @ across) / along
        expected = (1.0 - share) * length
        off = np.abs(expected - image.beyond_m)
        off = float(np.median(off[np.isfinite(off)])) if np.isfinite(off).any() else np.inf
        if off < least:
            best, least = number, off
    return best
