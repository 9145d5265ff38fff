r"""Steps: components of a fit move to where bearings point, and the shares of their ways change.

Each step solves the normal equations of all places, shares and directivities, with strengths and
far field free.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from soundmap.detect.component import Component
from soundmap.detect.sound_paths import NEAREST_M, Kind, Path
from soundmap.detect.sparse_fit import SparseFit
from soundmap.detect.unknowns import PLACE, Owner, change, derivatives, held, unknowns
from soundmap.geometry import FloatArray

MAY_BE_BEHIND_M, HOLD_BEHIND = 0.03, 3000.0
"""A source farther behind a surface than this [m] is drawn back to it so firmly [1/m^2]: what the
lasers see hides what lies behind, and reflections in the wall pull sources into it."""


def move(
    fit: SparseFit,
    chosen: list[Component] | None = None,
    *,
    share: float = 1.0,
    only_places: bool = False,
) -> None:
    """One step of some (by default all) components to where bearings point, and a refit.

    Only a ``share`` of the step is taken, or ``only_places`` move and all else stays as it is.
    """
    chosen = fit.components if chosen is None else chosen
    hessian, gradient, owners = _system(fit, chosen, only_places)
    if not owners:
        return
    scale = np.sqrt(np.diag(hessian)) + 1e-12
    scaled = hessian / np.outer(scale, scale) + 1e-4 * np.eye(len(scale))
    step = share * np.linalg.solve(scaled, gradient / scale) / scale
    for owner, own in zip(owners, step[: len(owners)], strict=True):
        change(owner, float(own))
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


def _system(
    fit: SparseFit, chosen: list[Component], only_places: bool = False
) -> tuple[FloatArray, FloatArray, list[Owner]]:
    """Normal equations of all unknowns of some components, strengths free.

    The strengths' own unknowns stand last, sub-band by sub-band; only the first ones have
    owners.
    """
    owners = unknowns(chosen, directed=fit.directed, only_places=only_places)
    if not owners:
        return np.zeros((0, 0)), np.zeros(0), owners
    count, components = len(owners), fit.components
    own, across, far = fit.products(
        lambda scans: derivatives(fit, owners, scans),
        [*(component.column for component in components), fit.residual],
    )
    size = count + len(fit.gram) * len(components)
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    by_far = far @ fit.far_inverse
    hessian[:count, :count] = own.sum(axis=0) - by_far @ far.T
    gradient[:count] = across[:, :, -1].sum(axis=0)
    for band, (start, stop) in enumerate(pairwise(fit.evidence.table.starts)):
        strengths = slice(count + band * len(components), count + (band + 1) * len(components))
        by_far_field = by_far[:, start:stop] @ fit.coupling[:, start:stop].T
        hessian[:count, strengths] = across[band, :, :-1] - by_far_field
        hessian[strengths, strengths] = fit.gram[band]
    hessian[count:, :count] = hessian[:count, count:].T
    rest = fit.product - np.einsum("bkl,lb->bk", fit.gram, fit.strengths)
    gradient[count:] = rest.ravel()
    for position, owner in enumerate(owners):
        firmness, away = held(owner)
        hessian[position, position] += firmness
        gradient[position] -= firmness * away
        if owner[1] == PLACE[0]:
            _hold_in_view(fit, owner[0], slice(position, position + 2), hessian, gradient)
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
