"""Unknowns: what is open of a component, and how what is heard changes with it.

A component's place bends the bearings of all paths that its sound takes, those by mirror images
among them. How strengths change with the place is left out: that is the business of reflections and
directivity as much as of distance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np

from soundmap.detect.component import ASSUMED, SHARE_SIGMA, Component, Share
from soundmap.detect.harmonics import Single
from soundmap.detect.sound_paths import (
    NEAREST_M,
    Kind,
    Path,
    departures,
    heard_places,
    mirrors,
    paths_heard,
)
from soundmap.detect.sparse_fit import SparseFit

PLACE, LOBE = (0, 1), (5, 6)
"""Axes of a component: its place along x and y, and its directivity along x and y. Those in between
are shares, numbered as `Share`."""
HOLD = 100.0
"""How firmly a place is held where it is while it moves [1/m^2]."""
DIRECTIVITY_SIGMA = 0.5
"""Of a directivity along x and y: 4 dB from front to back."""
GREATEST_MOVE_M, GREATEST_CHANGE, GREATEST_LOBE = 0.1, 0.2, 0.3
"""Most that a place, a share and a directivity change in one step."""
LEAST_SHARE, GREATEST_SHARE = 0.0, 1.0
Owner = tuple[Component, int]
"""A component and one of its axes."""


def unknowns(chosen: Sequence[Component], *, directed: bool) -> list[Owner]:
    """Places, shares and, if they are ``directed``, directivities of those that enough scans hear.

    Mirror images have no directivity: what they mirror is not known.
    """
    owners: list[Owner] = []
    for component in chosen:
        if np.count_nonzero(component.paths.gain[Path.DIRECT]) >= 3:
            lobe = LOBE if directed and component.kind == Kind.SOURCE else ()
            owners += [(component, axis) for axis in (*PLACE, *component.ways, *lobe)]
    return owners


def held(owner: Owner) -> tuple[float, float]:
    """How firmly an unknown is held, and how far it is from where.

    Places are held where they are, shares to what is assumed of them, directivities to none.
    """
    component, axis = owner
    if axis in PLACE:
        return HOLD, 0.0
    if axis in LOBE:
        return DIRECTIVITY_SIGMA**-2, float(component.directivity[LOBE.index(axis)])
    share = Share(axis)
    return SHARE_SIGMA[share] ** -2, component.shares[share] - ASSUMED[share]


def change(owner: Owner, step: float) -> None:
    """Take a step, or the greatest one that is allowed."""
    component, axis = owner
    if axis in PLACE:
        component.place_m[axis] += np.clip(step, -GREATEST_MOVE_M, GREATEST_MOVE_M)
    elif axis in LOBE:
        component.directivity[LOBE.index(axis)] += np.clip(step, -GREATEST_LOBE, GREATEST_LOBE)
    else:
        share = component.shares[Share(axis)] + np.clip(step, -GREATEST_CHANGE, GREATEST_CHANGE)
        component.shares[Share(axis)] = float(np.clip(share, LEAST_SHARE, GREATEST_SHARE))


def derivatives(fit: SparseFit, owners: Sequence[Owner], scans: slice) -> Iterator[Single]:
    """Change of what some scans hear with each unknown, each (s, D).

    Parameters
    ----------
    fit : SparseFit
    owners : sequence of tuple
        The unknowns, those of a component one after the other.
    scans : slice
    """
    for _, group in groupby(owners, key=lambda owner: id(owner[0])):
        of_one = list(group)
        component, axes = of_one[0][0], [axis for _, axis in of_one]
        strength = component.strength[fit.evidence.table.part].astype(np.float32)
        changes: dict[int, Single] = {}
        if not set(axes).isdisjoint(PLACE):
            changes |= zip(PLACE, _by_place(fit, component, scans), strict=True)
        if not set(axes).isdisjoint(LOBE):
            changes |= zip(LOBE, _by_directivity(fit, component, scans), strict=True)
        for axis in axes:
            own = changes[axis] if axis in changes else _by_share(fit, component, axis, scans)
            yield own * strength


def _by_share(fit: SparseFit, component: Component, axis: int, scans: slice) -> Single:
    """Change with a share at strength 1, shape (s, D)."""
    paths = component.ways[Share(axis)]
    return paths_heard(fit.evidence, component.paths, paths, np.ones((1, 1, 1)), scans)[0]


def _by_place(fit: SparseFit, component: Component, scans: slice) -> Single:
    """Change with the place at strength 1 by the bearings of all paths, shape (2, s, D)."""
    chosen, share = component.taken()
    stand = fit.evidence.place_m[scans]
    step = heard_places(fit.walls, component.place_m)[chosen, None] - stand
    square = np.maximum(np.sum(step**2, axis=2), NEAREST_M**2) / fit.evidence.handedness
    across = np.stack([-step[..., 1], step[..., 0]], axis=-1) @ mirrors(fit.walls)[chosen]
    bearing = share[:, None, None] * across / square[..., None]
    return paths_heard(
        fit.evidence, component.paths, chosen, np.moveaxis(bearing, 2, 0), scans, turned=True
    )


def _by_directivity(fit: SparseFit, component: Component, scans: slice) -> Single:
    """Change with the directivity at strength 1, shape (2, s, D)."""
    chosen, share = component.taken()
    toward = departures(fit.walls, component.place_m, fit.evidence.place_m[scans])[chosen]
    weight = np.moveaxis(share[:, None, None] * toward, 2, 0)
    return paths_heard(fit.evidence, component.paths, chosen, weight, scans)
