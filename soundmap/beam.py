r"""Beam: what a scan shows of one wave, the array's own response over its bearings.

A delay-and-sum beamformer that looks along :math:`\theta_n` hears a wave from :math:`\phi` with
the gain

.. math:: B(\theta_n, \phi) = \sum_f s_f \left| \frac{1}{Q} \sum_q
          e^{j 2 \pi f r_q \cdot (a u(\phi) - u(\theta_n)) / c} \right|^2,
          \quad \sum_f s_f = 1.

The sound's spectrum s only changes the width of the main lobe. The aperture a is the cosine of the
wave's elevation over the array's plane: a wave from above passes the microphones faster than one
along the plane, and its beam is wider and lower.
"""

from __future__ import annotations

import numpy as np

from soundmap.geometry import FloatArray


def beam_patterns(
    positions_m: FloatArray,
    *,
    bearings: int,
    waves: int,
    frequency_hz: FloatArray,
    share: FloatArray | None = None,
    aperture: float = 1.0,
    speed_of_sound_m_s: float,
) -> FloatArray:
    r"""Response of the scan to a wave of power 1 from each direction.

    Parameters
    ----------
    positions_m : ndarray, shape (Q, 3)
        :math:`r_q`, microphones in the array's frame [m].
    bearings : int
        N, bearings of a scan, :math:`2 \pi n / N`.
    waves : int
        M, directions of the waves, :math:`2 \pi m / M`.
    frequency_hz : ndarray, shape (F,)
        Frequencies that stand for the band [Hz].
    share : ndarray, shape (F,), optional
        Power of the sound at each, in any unit; left out: all are as loud.
    aperture : float
        Cosine of the elevation that the waves come from, in (0, 1].
    speed_of_sound_m_s : float

    Returns
    -------
    ndarray, shape (M, N)
        [-]; 1 where a bearing looks along a wave of aperture 1.

    Examples
    --------
    >>> angle = 2.0 * np.pi * np.arange(8) / 8
    >>> circle = 0.1 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)
    >>> beams = beam_patterns(circle, bearings=4, waves=8, aperture=1.0,
    ...                       frequency_hz=np.array([1e3, 2e3]), speed_of_sound_m_s=343.0)
    >>> bool(np.allclose(beams[::2].diagonal(), 1.0)), bool(beams[0, 2] < 0.5)
    (True, True)
    """
    looking, coming = _directions(bearings), aperture * _directions(waves)
    looking_m, coming_m = looking @ positions_m[:, :2].T, coming @ positions_m[:, :2].T
    patterns = np.zeros((waves, bearings), dtype=np.float32)
    share = np.ones(len(frequency_hz)) if share is None else share
    for hertz, part in zip(frequency_hz, share / share.sum(), strict=True):
        wavenumber = 2.0 * np.pi * hertz / speed_of_sound_m_s
        steering = np.exp(-1j * wavenumber * looking_m).astype(np.complex64)
        wave = np.exp(1j * wavenumber * coming_m).astype(np.complex64)
        heard = wave @ steering.T
        patterns += np.float32(part) * (heard.real**2 + heard.imag**2)
    return patterns.astype(np.float64) / len(positions_m) ** 2


def _directions(count: int) -> FloatArray:
    angle = 2.0 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)
