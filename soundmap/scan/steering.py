r"""Steering: how a plane wave from each bearing reaches the microphones (Sect. 2.3, far field).

A wave from bearing :math:`\theta`, unit vector u, reaches the microphone at r earlier than the
array's origin by :math:`r \cdot u / c`. Between two microphones only the baseline
:math:`r_m - r_n` matters, and arrays repeat their baselines: 16 microphones on a circle have 120
pairs but 64 baselines. Bearings lie in the array's x-y plane; heights have no part in them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from soundmap.geometry import FloatArray

PHASE_TOLERANCE_RAD = 1e-4
"""Baselines are one if merging them moves no phase by more than this. At 6 kHz that is 0.9 um
about their mean: positions that a file gives in whole micrometres still merge."""


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
    """The distinct baselines of an array, those of most pairs first.

    Attributes
    ----------
    vector_m : ndarray, shape (B, 2)
        :math:`r_m - r_n` in the array's plane, mean over its pairs [m].
    layers : tuple of ndarray of int
        Element b of layer i is m * Q + n of the i-th pair (m, n) with baseline b. Later layers
        are shorter. A pair that runs the other way is listed as (n, m).
    """

    vector_m: FloatArray
    layers: tuple[NDArray[np.intp], ...]

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
    Four microphones on a square: six pairs, of which two are parallel twice.

    >>> corners = np.array([[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    >>> len(distinct_baselines(corners, tolerance_m=1e-6))
    4
    """
    count = len(positions_m)
    pairs: list[list[int]] = []
    members: list[FloatArray] = []
    means = np.empty((count * (count - 1) // 2, 2))
    for m in range(count):
        for n in range(m + 1, count):
            baseline = positions_m[m, :2] - positions_m[n, :2]
            found = _joined(baseline, means[: len(pairs)], members, tolerance_m)
            if found is None:
                means[len(pairs)] = baseline
                members.append(baseline[None])
                pairs.append([m * count + n])
                continue
            group, sign = found
            members[group] = np.vstack([members[group], sign * baseline])
            means[group] = members[group].mean(axis=0)
            pairs[group].append(m * count + n if sign > 0 else n * count + m)
    order = sorted(range(len(pairs)), key=lambda group: -len(pairs[group]))
    depth = len(pairs[order[0]]) if order else 0
    layers = tuple(
        np.array([pairs[group][i] for group in order if len(pairs[group]) > i], dtype=np.intp)
        for i in range(depth)
    )
    return Baselines(means[order], layers)


def _joined(
    baseline: FloatArray, means: FloatArray, members: list[FloatArray], tolerance_m: float
) -> tuple[int, float] | None:
    """The group that a baseline joins and its sign there; None if it is a new one."""
    if len(means) == 0:
        return None
    distances = np.stack([np.hypot(*(means - sign * baseline).T) for sign in (1.0, -1.0)])
    opposite, group = np.unravel_index(int(np.argmin(distances)), distances.shape)
    if distances[opposite, group] > 2.0 * tolerance_m:
        return None
    sign = -1.0 if opposite else 1.0
    joined = np.vstack([members[group], sign * baseline])
    if np.hypot(*(joined - joined.mean(axis=0)).T).max() > tolerance_m:
        return None
    return int(group), sign


@dataclass(frozen=True)
class SteeringTable:
    """Weighted cosines and sines of the phase that each baseline has on each bearing.

    Attributes
    ----------
    bearing_rad : ndarray, shape (N,)
        All bearings [rad].
    baselines : Baselines
    weight : ndarray of float32, shape (K,)
        Weight of each bin.
    cosine, sine : ndarray of float32, shape (N or N / 2, K * B)
        Twice the weight times cos and sin. With an even N only the first half of the bearings:
        the opposite bearing has the same cosine and the opposite sine.
    """

    bearing_rad: FloatArray
    baselines: Baselines
    weight: NDArray[np.float32]
    cosine: NDArray[np.float32]
    sine: NDArray[np.float32]

    @property
    def halved(self) -> bool:
        """Whether the tables hold only the first half of the bearings."""
        return len(self.cosine) < len(self.bearing_rad)


def steering_table(
    positions_m: FloatArray,
    bearings: int,
    *,
    frequency_hz: FloatArray,
    weight: FloatArray,
    speed_of_sound_m_s: float,
) -> SteeringTable:
    """Table for equally spaced bearings and the bins of a band.

    Parameters
    ----------
    positions_m : ndarray, shape (Q, 3)
        Microphones in the array's frame [m].
    bearings : int
        :math:`N`.
    frequency_hz, weight : ndarray, shape (K,)
        Bins of the band [Hz], and what the square of each counts for.
    speed_of_sound_m_s : float
        c [m/s].
    """
    wavenumber = 2.0 * np.pi * frequency_hz / speed_of_sound_m_s
    tolerance_m = PHASE_TOLERANCE_RAD / float(wavenumber.max())
    baselines = distinct_baselines(positions_m, tolerance_m=tolerance_m)
    bearing = scan_bearings(bearings)
    kept = bearing if bearings % 2 else bearing[: bearings // 2]
    cosine = np.empty((len(kept), len(wavenumber) * len(baselines)), dtype=np.float32)
    sine = np.empty_like(cosine)
    for row, toward in enumerate(direction(kept)):  # one bearing at a time: tables can be large
        phase = wavenumber[:, None] * (baselines.vector_m @ toward)
        cosine[row] = (2.0 * weight[:, None] * np.cos(phase)).ravel()
        sine[row] = (2.0 * weight[:, None] * np.sin(phase)).ravel()
    return SteeringTable(bearing, baselines, weight.astype(np.float32), cosine, sine)
