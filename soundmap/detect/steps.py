r"""Steps: components of a fit move to where bearings point, and the shares of their ways change.

Each step solves the normal equations of all places and shares, with strengths and far field free.
Places move by their bearings alone: how strengths change along the way is the business of
reflections and directivity as much as of distance, and would pull them off.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from soundmap.detect.component import ASSUMED, SHARE_SIGMA, Component, Share
from soundmap.detect.harmonics import Single
from soundmap.detect.model_errors import bearing_derivative, parts
from soundmap.detect.sound_paths import NEAREST_M, Kind, Path
from soundmap.detect.sparse_fit import SparseFit
from soundmap.geometry import FloatArray
from soundmap.side_by_side import side_by_side

GREATEST_MOVE_M, GREATEST_CHANGE = 0.1, 0.2
"""Most that a place and a share change in one step."""
LEAST_SHARE, GREATEST_SHARE = 0.0, 1.0
HOLD = 100.0
"""How firmly a place is held where it is while it moves [1/m^2]."""
MAY_BE_BEHIND_M, HOLD_BEHIND = 0.03, 3000.0
"""A source farther behind a surface than this [m] is drawn back to it so firmly [1/m^2]: what the
lasers see hides what lies behind, and reflections in the wall pull sources into it."""


def move(fit: SparseFit, chosen: list[Component] | None = None, *, share: float = 1.0) -> None:
    """One step of some (by default all) components to where bearings point, and a refit.

    Only a ``share`` of the step is taken: reflections turn along with what they reflect, which
    is left out, so that whole ones may go too far in the end.
    """
    chosen = fit.components if chosen is None else chosen
    hessian, gradient, owners = _system(fit, chosen)
    if not owners:
        return
    scale = np.sqrt(np.diag(hessian)) + 1e-12
    scaled = hessian / np.outer(scale, scale) + 1e-4 * np.eye(len(scale))
    step = share * np.linalg.solve(scaled, gradient / scale) / scale
    for position, (component, axis) in enumerate(owners):
        if axis < 2:
            component.place_m[axis] += np.clip(step[position], -GREATEST_MOVE_M, GREATEST_MOVE_M)
        else:
            change = np.clip(step[position], -GREATEST_CHANGE, GREATEST_CHANGE)
            taken = component.shares[Share(axis)] + change
            component.shares[Share(axis)] = float(np.clip(taken, LEAST_SHARE, GREATEST_SHARE))
    for component in {id(owner): owner for owner, _ in owners}.values():
        fit.hear_anew(component)
    fit.refit()


def choose_height(fit: SparseFit, component: Component, heights_m: tuple[float, ...]) -> None:
    """The height at which a component explains most, all else as it is."""
    starts = fit.evidence.table.starts[:-1]
    target = fit.residual + fit.sound(component)
    best, value, columns = component.height_m, -np.inf, []
    for height in heights_m:
        component.height_m = height
        fit.hear_anew(component)
        columns.append(component.column)
    weighted = fit.precision.times(np.stack(columns))
    for height, column, right in zip(heights_m, columns, weighted, strict=True):
        match = np.add.reduceat(np.einsum("sd,sd->d", right, target), starts)
        energy = np.add.reduceat(np.einsum("sd,sd->d", right, column), starts)
        explained = np.sum(np.maximum(match, 0.0) ** 2 / np.maximum(energy, 1e-30))
        if explained > value:
            best, value = height, float(explained)
    component.height_m = best
    fit.hear_anew(component)


def place_covariances(fit: SparseFit) -> list[FloatArray]:
    """Covariance (2, 2) of each component's place, as the noise alone would make it [m^2]."""
    result = [np.eye(2) for _ in fit.components]
    hessian, _, owners = _system(fit, fit.components)
    if not owners:
        return result
    scale = np.sqrt(np.diag(hessian)) + 1e-12
    inverse = np.linalg.pinv(hessian / np.outer(scale, scale), rcond=1e-8, hermitian=True)
    inverse = inverse / np.outer(scale, scale)
    index = {id(component): i for i, component in enumerate(fit.components)}
    for position, (component, axis) in enumerate(owners):
        if axis == 0:
            own = slice(position, position + 2)
            result[index[id(component)]] = inverse[own, own]
    return result


def unknowns(chosen: list[Component]) -> list[tuple[Component, int]]:
    """Places (axes 0, 1) and shares (as `Share`) of those components that enough scans hear."""
    owners: list[tuple[Component, int]] = []
    for component in chosen:
        if np.count_nonzero(component.paths.gain[Path.DIRECT]) >= 3:
            owners += [(component, axis) for axis in (0, 1, *component.ways)]
    return owners


def _system(
    fit: SparseFit, chosen: list[Component]
) -> tuple[FloatArray, FloatArray, list[tuple[Component, int]]]:
    """Normal equations of places (axes 0, 1) and shares (as `Share`), strengths free.

    The strengths' own unknowns stand last, sub-band by sub-band; only the first ones have
    owners.
    """
    owners = unknowns(chosen)
    if not owners:
        return np.zeros((0, 0)), np.zeros(0), owners
    count, components, bands = len(owners), len(fit.components), len(fit.gram)
    hessian = np.zeros((count + bands * components,) * 2)
    gradient = np.zeros(len(hessian))
    coupling = np.zeros((count, len(fit.far_pull)))

    def of_some(scans: slice) -> tuple[Single, Single, FloatArray, FloatArray]:
        own = np.stack(list(derivatives(fit, owners, scans)))
        weighted = fit.precision.times(own, scans)
        flat = weighted.reshape(count, -1)
        squares = flat @ own.reshape(count, -1).T
        pull = flat @ fit.residual[scans].ravel()
        return (
            squares,
            pull,
            _across(fit, weighted, scans),
            fit.far_field.pull(weighted, scans),
        )

    for squares, pull, across, far in side_by_side(of_some, parts(len(fit.evidence))):
        hessian[:count, :count] += squares
        gradient[:count] += pull
        hessian[:count, count:] += across
        coupling += far
    held = coupling @ fit.far_inverse
    hessian[:count, :count] -= held @ coupling.T
    couplings = fit.couplings()
    for band, (start, stop) in enumerate(pairwise(fit.evidence.table.starts)):
        place = slice(count + band * components, count + (band + 1) * components)
        hessian[:count, place] -= held[:, start:stop] @ couplings[:, start:stop].T
    hessian[count:, :count] = hessian[:count, count:].T
    for band, gram in enumerate(fit.gram):
        place = slice(count + band * components, count + (band + 1) * components)
        hessian[place, place] = gram
    rest = fit.product - np.einsum("bkl,lb->bk", fit.gram, fit.strengths)
    gradient[count:] = rest.ravel()
    for position, (component, axis) in enumerate(owners):
        hold = HOLD if axis < 2 else SHARE_SIGMA[Share(axis)] ** -2
        hessian[position, position] += hold
        if axis >= 2:
            share = Share(axis)
            gradient[position] -= hold * (component.shares[share] - ASSUMED[share])
        elif axis == 0:
            _hold_in_view(fit, component, slice(position, position + 2), hessian, gradient)
    return hessian, gradient, owners


def _hold_in_view(
    fit: SparseFit, component: Component, own: slice, hessian: FloatArray, gradient: FloatArray
) -> None:
    """Hold a source that lies behind what the lasers see in front of it."""
    gain, beyond = component.paths.gain[Path.DIRECT], component.paths.beyond_m
    told = np.isfinite(beyond) & (gain > 0.0)
    if component.kind == Kind.IMAGE or not told.any():
        return
    weight = gain[told] ** 2 / np.sum(gain[told] ** 2)
    away = component.place_m - fit.evidence.place_m[told]
    toward = weight @ (away / np.maximum(np.hypot(*away.T), NEAREST_M)[:, None])
    behind = float(weight @ beyond[told]) - MAY_BE_BEHIND_M
    if behind > 0.0:
        hessian[own, own] += HOLD_BEHIND * np.outer(toward, toward)
        gradient[own] -= HOLD_BEHIND * behind * toward


def derivatives(
    fit: SparseFit, owners: list[tuple[Component, int]], scans: slice
) -> Iterator[Single]:
    """Change of what some scans hear with each unknown, each (s, D)."""
    evidence, part = fit.evidence, fit.evidence.table.part
    for component, axis in owners:
        strength = component.strength[part].astype(np.float32)
        if axis >= 2:
            paths = component.ways[Share(axis)]
            yield np.sum([fit.heard(component, path, scans) for path in paths], 0) * strength
            continue
        if axis == 0:  # axis 1 of the same component follows
            turned = bearing_derivative(evidence, component.paths, scans) * strength
            step = component.place_m - evidence.place_m[scans]
            square = np.maximum(np.sum(step**2, axis=1), NEAREST_M**2) / evidence.handedness
        bearing = (-step[:, 1], step[:, 0])[axis] / square
        yield turned * bearing.astype(np.float32)[:, None]


def _across(fit: SparseFit, weighted: Single, scans: slice) -> FloatArray:
    """Products of some columns (K', s, D) with those of all components, (K', B K)."""
    starts, count = fit.evidence.table.starts, len(weighted)
    columns = np.stack([component.column[scans] for component in fit.components])
    return np.concatenate(
        [
            weighted[:, :, start:stop].reshape(count, -1)
            @ columns[:, :, start:stop].reshape(len(columns), -1).T
            for start, stop in pairwise(starts)
        ],
        axis=1,
    )
