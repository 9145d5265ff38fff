"""Unknowns: what is open of a component, and how what is heard changes with it.

A component's place bends the bearings of all paths that its sound takes, those by mirror images
among them. How strengths change with the place is left out: that is the business of reflections and
directivity as much as of distance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from soundmap.detect.component import ASSUMED, SHARE_SIGMA, Component, Share
from soundmap.detect.harmonics import Single, add, look_up
from soundmap.detect.sound_paths import NEAREST_M, Kind, Path, Waves, waves_to, weigh
from soundmap.detect.sparse_fit import SparseFit
from soundmap.geometry import FloatArray

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


def unknowns(
    chosen: Sequence[Component], *, directed: bool, only_places: bool = False
) -> list[Owner]:
    """Places, shares and, if they are ``directed``, directivities of those that enough scans hear.

    Or ``only_places`` of them. Mirror images have no directivity: what they mirror is not known.
    """
    owners: list[Owner] = []
    for component in chosen:
        if np.count_nonzero(component.paths.gain[Path.DIRECT]) >= 3:
            lobe = LOBE if directed and component.kind == Kind.SOURCE else ()
            others = () if only_places else (*component.ways, *lobe)
            owners += [(component, axis) for axis in (*PLACE, *others)]
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


def derivatives(fit: SparseFit, owners: Sequence[Owner], scans: slice) -> Single:
    """Change of what some scans hear with each unknown, shape (U, s, D).

    Parameters
    ----------
    fit : SparseFit
    owners : sequence of tuple, length U
        The unknowns, those of a component one after the other.
    scans : slice
    """
    evidence = fit.evidence
    components = list(dict.fromkeys(component for component, _ in owners))
    paths = [component.paths for component in components]
    strength = np.array([component.strength for component in components])
    part_of = np.zeros((len(components), len(paths[0].gain)))
    for component, parts in zip(components, part_of, strict=True):
        chosen, share = component.taken()
        parts[chosen] = share
    of_share = np.zeros((len(owners), len(paths[0].gain)), dtype=np.bool_)
    for (component, axis), own in zip(owners, of_share, strict=True):
        if axis not in (*PLACE, *LOBE):
            own[component.ways[Share(axis)]] = True
    told = np.zeros((len(owners), *evidence.heard[scans].shape), dtype=np.float32)
    _add_changes(
        told,
        np.array([components.index(component) for component, _ in owners]),
        np.array([axis for _, axis in owners]),
        of_share,
        waves_to(evidence, paths, strength, scans),
        part_of,
        np.array([component.place_m for component in components]),
        fit.walls,
        evidence.place_m[scans],
        float(evidence.handedness),
    )
    return told


@njit(cache=True, nogil=True)
def _add_changes(
    out: Single,
    number: NDArray[np.int64],
    axes: NDArray[np.int64],
    of_share: NDArray[np.bool_],
    waves: Waves,
    part_of: FloatArray,
    place: FloatArray,
    walls: FloatArray,
    stand: FloatArray,
    hand: float,
) -> None:
    """Derivatives (U, s, D), path by path.

    Of U unknowns, ``number`` is that of the component, and ``of_share`` (U, P) tells the paths that
    have the share. ``part_of`` (C, P) is the part of a component's power that takes a path.
    """
    beam, turning = np.empty(out.shape[2], np.float32), np.empty(out.shape[2], np.float32)
    noise = np.empty(out.shape[2], np.float32)
    last = 0
    for c in range(len(place)):
        first = last
        while last < len(number) and number[last] == c:
            last += 1
        for s in range(len(stand)):
            weigh(noise, waves, c, s)
            for p in range(part_of.shape[1]):
                part, loud = part_of[c, p], waves.gain[c, p, s]
                if loud == 0.0 or (part == 0.0 and not of_share[first:last, p].any()):
                    continue
                at, cos, turn = waves.wave[c, p, s], waves.aperture[c, p, s], waves.turn[s]
                look_up(beam, waves.beams, noise, at, cos, turn)
                look_up(turning, waves.turned, noise, at, cos, turn)
                dx, dy, sense = place[c, 0] - stand[s, 0], place[c, 1] - stand[s, 1], hand
                if p >= Path.WALLS:  # the way to the source in the mirror, mirrored back
                    nx, ny, offset = walls[p - Path.WALLS]
                    off = nx * stand[s, 0] + ny * stand[s, 1] - offset
                    dx, dy, sense = dx + 2.0 * off * nx, dy + 2.0 * off * ny, -hand
                distance = max(np.sqrt(dx * dx + dy * dy), 1e-9)
                bent = sense * part * loud / max(distance, NEAREST_M) ** 2
                sent = part * loud / distance
                for u in range(first, last):
                    if axes[u] == PLACE[0]:
                        add(out[u, s], -bent * dy, turning)
                    elif axes[u] == PLACE[1]:
                        add(out[u, s], bent * dx, turning)
                    elif axes[u] == LOBE[0]:
                        add(out[u, s], -sent * dx, beam)
                    elif axes[u] == LOBE[1]:
                        add(out[u, s], -sent * dy, beam)
                    elif of_share[u, p]:
                        add(out[u, s], loud, beam)
