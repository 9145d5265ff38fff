r"""Reverberation: what is left of a sound after more reflections than are followed one by one.

It is a diffuse field: plane waves from all directions, each a copy of the sound smeared by a
random response whose energy decays exponentially. Its level follows from the balance between the
power that a source radiates and the power that the surfaces absorb.
"""

from __future__ import annotations

import numpy as np

from soundmap.geometry import FloatArray

WAVES = 32
"""Plane waves of a tail; their coherence is that of a diffuse field to within 1 / sqrt(32)."""
_DECAY = 6.0 * np.log(10.0)
"""Energy falls by this exponent within the reverberation time: 60 dB."""


def eyring_time(
    volume_m3: float, areas_m2: FloatArray, reflection: FloatArray, *, speed_of_sound_m_s: float
) -> float:
    r"""Reverberation time after Eyring [s].

    .. math:: T = \frac{24 \ln 10}{c} \frac{V}{-S \ln \overline{R^2}}

    Parameters
    ----------
    volume_m3 : float
    areas_m2, reflection : ndarray, shapes (F,)
        Area of each surface and its sound pressure reflection coefficient.
    speed_of_sound_m_s : float

    Returns
    -------
    float
        0 if nothing is reflected; inf if nothing is absorbed.
    """
    surface = float(np.sum(areas_m2))
    kept = float(np.sum(areas_m2 * reflection**2)) / surface
    if kept <= 0.0:
        return 0.0
    if kept >= 1.0:
        return float("inf")
    return float(24.0 * np.log(10.0) / speed_of_sound_m_s * volume_m3 / (-surface * np.log(kept)))


def tail_start(
    volume_m3: float, surface_m2: float, image_order: int, *, speed_of_sound_m_s: float
) -> float:
    """When sound has been reflected ``image_order`` and a half times on average [s].

    The mean free path in a room is 4 V / S.
    """
    return (image_order + 0.5) * 4.0 * volume_m3 / (surface_m2 * speed_of_sound_m_s)


def tail_density(
    time_s: FloatArray,
    *,
    volume_m3: float,
    reverberation_s: float,
    start_s: float,
    speed_of_sound_m_s: float,
) -> FloatArray:
    r"""Energy of a diffuse tail arriving in each second, at each time after emission [1/s].

    Relative to the mean square at 1 m from an omnidirectional source. A source radiates
    :math:`4 \pi p_1^2 / \rho c`; in a room with equivalent absorption area A the mean square is
    :math:`16 \pi p_1^2 / A`, and :math:`A = 24 \ln 10 \, V / (c T)` (Sabine).
    """
    area = 24.0 * np.log(10.0) * volume_m3 / (speed_of_sound_m_s * reverberation_s)
    decay = _DECAY / reverberation_s
    density = 16.0 * np.pi / area * decay * np.exp(-decay * time_s)
    return np.asarray(np.where(time_s >= start_s, density, 0.0))


def tail_response(
    density: FloatArray, rate_hz: float, waves: int, rng: np.random.Generator
) -> FloatArray:
    """Random response of one of ``waves`` plane waves whose energies add up to ``density``."""
    return np.asarray(np.sqrt(density / (rate_hz * waves)) * rng.standard_normal(len(density)))


def wave_directions(waves: int, rng: np.random.Generator) -> FloatArray:
    """Unit vectors to where plane waves come from, evenly over the sphere, shape (waves, 3).

    A Fibonacci lattice in random orientation.
    """
    number = np.arange(waves) + 0.5
    height = 1.0 - 2.0 * number / waves
    turn = np.pi * (1.0 + np.sqrt(5.0)) * number
    across = np.sqrt(1.0 - height**2)
    lattice = np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=-1)
    orientation, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return np.asarray(lattice @ orientation)


def mean_directivity(front_to_back_db: float) -> float:
    """Power radiated over that of an omnidirectional source as loud on the axis."""
    if front_to_back_db <= 0.0:
        return 1.0
    fall = front_to_back_db / 10.0 * np.log(10.0)
    return float((1.0 - np.exp(-fall)) / fall)
