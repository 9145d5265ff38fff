r"""Steering: how a plane wave from each bearing reaches the microphones (Sect. 2.3, far field).

A wave from bearing :math:`\theta`, unit vector u, reaches the microphone at r earlier than the
array's origin by :math:`r \cdot u / c`. Between two microphones only the baseline
:math:`r_m - r_n` matters, and arrays repeat their baselines: 16 microphones on a circle have 120
pairs but 64 baselines. A microphone with itself is a pair without a baseline. Bearings lie in the
array's x-y plane; heights have no part in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from soundmap.geometry import FloatArray
from soundmap.scan.lanes import lanes_array

PHASE_TOLERANCE_RAD = 1e-4
"""Baselines are one if merging them moves no phase by more than this. At 6 kHz that is 0.9 um
about their mean: positions that a file gives in whole micrometres still merge."""

BEARINGS_A_TILE = 64
"""Bearings that are steered at a time; tables are filled up to a multiple of them."""


def scan_bearings(count: int) -> FloatArray:
    r"""Equally spaced bearings :math:`\theta_n = 2 \pi n / N`, shape (N,) [rad]."""
    return 2.0 * np.pi * np.arange(count) / count


def direction(bearing_rad: ArrayLike) -> FloatArray:
    """Unit vectors toward bearings, shape (..., 2)."""
    bearing = np.asarray(bearing_rad, dtype=np.float64)
    return np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)


def steering_vectors(
    positions_m: FloatArray,
    bearing_rad: FloatArray,
    frequency_hz: float,
    *,
    speed_of_sound_m_s: float,
) -> NDArray[np.complex128]:
    r"""What each microphone hears of a unit plane wave at one frequency.

    .. math:: a_q(\theta) = \exp(j 2 \pi f \, r_q \cdot u(\theta) / c)

    Parameters
    ----------
    positions_m : ndarray, shape (Q, 3)
        :math:`r_q`, microphones in the array's frame [m].
    bearing_rad : ndarray, shape (N,)
        :math:`\theta_n` [rad].
    frequency_hz : float
        f [Hz].
    speed_of_sound_m_s : float
        c [m/s].

    Returns
    -------
    ndarray of complex128, shape (N, Q)

    Examples
    --------
    A wave from ahead is a quarter of a period early 0.25 wavelengths ahead:

    >>> ahead = steering_vectors(np.array([[0.25, 0.0, 0.0]]), np.array([0.0]), 343.0,
    ...                          speed_of_sound_m_s=343.0)
    >>> bool(np.isclose(ahead[0, 0], 1j))
    True
    """
    lead_s = direction(bearing_rad) @ positions_m[:, :2].T / speed_of_sound_m_s
    return np.exp(2j * np.pi * frequency_hz * lead_s)


@dataclass(frozen=True)
class Baselines:
    """The distinct baselines of an array and the pairs of microphones that have them.

    Attributes
    ----------
    vector_m : ndarray, shape (B, 2)
        :math:`r_m - r_n` in the array's plane, mean over its pairs [m]; nought for the first, which
        is every microphone's with itself. Then those of most pairs come first.
    first, second : ndarray of int, shape (P,)
        m and n of each pair. A pair that runs the other way is listed as (n, m).
    baseline : ndarray of int, shape (P,)
        Which baseline each pair has; pairs of one follow one another.
    """

    vector_m: FloatArray
    first: NDArray[np.uintp]
    second: NDArray[np.uintp]
    baseline: NDArray[np.uintp]

    def __len__(self) -> int:
        return len(self.vector_m)


def distinct_baselines(positions_m: FloatArray, *, tolerance_m: float) -> Baselines:
    """The baselines of all pairs, equal and opposite ones merged; found from the geometry.

    Parameters
    ----------
    positions_m : ndarray, shape (Q, 3)
        Microphones in the array's frame [m].
    tolerance_m : float
        Greatest distance of a pair's own baseline from the merged one [m].

    Examples
    --------
    Four microphones on a square: six pairs, of which two are parallel twice; and no baseline.

    >>> corners = np.array([[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    >>> len(distinct_baselines(corners, tolerance_m=1e-6))
    5
    """
    count = len(positions_m)
    place = positions_m[:, 0] + 1j * positions_m[:, 1]
    pairs: list[list[tuple[int, int]]] = []
    members: list[list[complex]] = []
    means = np.empty(count * (count - 1) // 2, dtype=np.complex128)
    for m in range(count):
        for n in range(m + 1, count):
            baseline = complex(place[m] - place[n])
            found = _joined(baseline, means[: len(pairs)], members, tolerance_m)
            if found is None:
                means[len(pairs)] = baseline
                members.append([baseline])
                pairs.append([(m, n)])
                continue
            group, sign = found
            members[group].append(sign * baseline)
            means[group] = np.mean(members[group])
            pairs[group].append((m, n) if sign > 0 else (n, m))
    order = sorted(range(len(pairs)), key=lambda group: -len(pairs[group]))
    lists = [[(q, q) for q in range(count)], *(pairs[group] for group in order)]
    table = [(*pair, line) for line, pairs in enumerate(lists) for pair in pairs]
    first, second, line = np.array(table, dtype=np.uintp).T.copy()
    merged = np.concatenate([[0.0], means[order]])
    return Baselines(np.stack([merged.real, merged.imag], axis=1), first, second, line)


def _joined(
    baseline: complex,
    means: NDArray[np.complex128],
    members: list[list[complex]],
    tolerance_m: float,
) -> tuple[int, float] | None:
    """The group that a baseline joins and its sign there; None if it is a new one."""
    if len(means) == 0:
        return None
    equal, opposite = np.abs(means - baseline), np.abs(means + baseline)
    sign, distance = (1.0, equal) if equal.min() <= opposite.min() else (-1.0, opposite)
    group = int(np.argmin(distance))
    if distance[group] > 2.0 * tolerance_m:
        return None
    joined = np.array([*members[group], sign * baseline])
    if np.abs(joined - joined.mean()).max() > tolerance_m:
        return None
    return group, sign


@dataclass(frozen=True)
class SteeringTable:
    """What it takes to steer the bins of a band.

    Attributes
    ----------
    bearing_rad : ndarray, shape (N,)
        All bearings [rad].
    baselines : Baselines
    first_bin : int
        Lowest bin of the band.
    weight : ndarray, shape (K,)
        What the square of each bin counts for.
    group : ndarray of int, shape (K,)
        Which group each bin is of; 0, 0, ..., 1, 1, ...
    cosine, sine : ndarray of float32, shape (K, B, C)
        The weight, for pairs of different microphones twice the weight, times cos and sin of the
        phase that each baseline has on each bearing. With an even N only the first half of the
        bearings: the opposite bearing has the same cosine and the opposite sine. The rest of the C,
        a multiple of `BEARINGS_A_TILE`, is nought.
    """

    bearing_rad: FloatArray
    baselines: Baselines
    first_bin: int
    weight: FloatArray
    group: NDArray[np.intp]
    cosine: NDArray[np.float32]
    sine: NDArray[np.float32]

    @property
    def groups(self) -> int:
        """Groups of bins whose power is told apart."""
        return int(self.group[-1]) + 1

    @property
    def halved(self) -> bool:
        """Whether the tables hold only the first half of the bearings."""
        return len(self.bearing_rad) % 2 == 0

    @property
    def spectra_shape(self) -> tuple[int, int, int]:
        """(2, K, B): real and imaginary parts of the cross-spectra of one scan."""
        return (2, len(self.weight), len(self.baselines))


def steering_table(
    positions_m: FloatArray,
    bearings: int,
    *,
    first_bin: int,
    frequency_hz: FloatArray,
    weight: FloatArray,
    speed_of_sound_m_s: float,
    splits: Sequence[int] = (),
) -> SteeringTable:
    """Table for equally spaced bearings and the bins of a band.

    Parameters
    ----------
    positions_m : ndarray, shape (Q, 3)
        Microphones in the array's frame [m].
    bearings : int
        :math:`N`.
    first_bin : int
        Lowest bin of the band.
    frequency_hz, weight : ndarray, shape (K,)
        Bins of the band [Hz], and what the square of each counts for.
    speed_of_sound_m_s : float
        c [m/s].
    splits : sequence of int, optional
        Where to split the band into groups of bins (sub-bands) whose power is told apart: the
        index, rising and inside (0, K), of the bin with which each group but the first begins.
    """
    bins = len(weight)
    edges = [0, *splits, bins]
    if not all(start < stop for start, stop in pairwise(edges)):
        raise ValueError(f"splits {list(splits)} do not rise inside the {bins} bins of the band")
    wavenumber = 2.0 * np.pi * frequency_hz / speed_of_sound_m_s
    tolerance_m = PHASE_TOLERANCE_RAD / float(wavenumber.max())
    baselines = distinct_baselines(positions_m, tolerance_m=tolerance_m)
    bearing = scan_bearings(bearings)
    kept = bearing if bearings % 2 else bearing[: bearings // 2]
    ahead_m = baselines.vector_m @ direction(kept).T
    tiles = -(-len(kept) // BEARINGS_A_TILE)
    cosine = lanes_array(bins, len(baselines), tiles * BEARINGS_A_TILE)
    sine = lanes_array(*cosine.shape)
    counts = np.where(np.arange(len(baselines)) == 0, 1.0, 2.0)[:, None]
    for k in range(bins):  # one bin at a time: tables can be large
        # One tangent of half the phase is had in a fifth of the time of its cosine and sine.
        tangent = np.tan(0.5 * wavenumber[k] * ahead_m)
        scale = weight[k] * counts / (1.0 + tangent**2)
        cosine[k, :, : len(kept)] = scale * (1.0 - tangent**2)
        sine[k, :, : len(kept)] = scale * 2.0 * tangent
    group = np.searchsorted(edges[1:], np.arange(bins), side="right")
    return SteeringTable(bearing, baselines, first_bin, weight, group, cosine, sine)
