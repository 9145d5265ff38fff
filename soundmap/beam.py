r"""Beam: what a scan shows of one plane wave, the array's own response over its bearings.

A delay-and-sum beamformer that looks along :math:`\theta_n` hears a wave from :math:`\phi` with
the gain

.. math:: B(\theta_n, \phi) = \sum_f s_f \left| \frac{1}{Q} \sum_q
          e^{j 2 \pi f r_q \cdot (u(\phi) - u(\theta_n)) / c} \right|^2, \quad \sum_f s_f = 1,

which depends on the sound's spectrum s only through the width of the main lobe: a few slopes
stand for all spectra.
"""

from __future__ import annotations

import numpy as np

from soundmap.geometry import FloatArray

FREQUENCIES = 32
"""Frequencies that stand for the band; more change the pattern by less than 0.1 %."""


def beam_patterns(
    positions_m: FloatArray,
    *,
    bearings: int,
    waves: int,
    low_hz: float,
    high_hz: float,
    slope_db_per_octave: float,
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
    low_hz, high_hz : float
        Band [Hz].
    slope_db_per_octave : float
        Of the sound's power density over the band [dB/octave].
    speed_of_sound_m_s : float

    Returns
    -------
    ndarray, shape (M, N)
        [-]; 1 where a bearing looks along the wave.

    Examples
    --------
    >>> angle = 2.0 * np.pi * np.arange(8) / 8
    >>> circle = 0.1 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)
    >>> beams = beam_patterns(circle, bearings=4, waves=8, low_hz=1000.0, high_hz=6000.0,
    ...                       slope_db_per_octave=-6.0, speed_of_sound_m_s=343.0)
    >>> bool(np.allclose(beams[::2].diagonal(), 1.0)), bool(beams[0, 2] < 0.2)
    (True, True)
    """
    frequency = np.linspace(low_hz, high_hz, FREQUENCIES)
    share = 10.0 ** (slope_db_per_octave * np.log2(frequency / low_hz) / 10.0)
    share /= share.sum()
    looking, coming = _directions(bearings), _directions(waves)
    patterns = np.zeros((waves, bearings))
    for hertz, weight in zip(frequency, share, strict=True):
        wavenumber = 2.0 * np.pi * hertz / speed_of_sound_m_s
        steering = np.exp(1j * wavenumber * (looking @ positions_m[:, :2].T))
        wave = np.exp(1j * wavenumber * (coming @ positions_m[:, :2].T))
        patterns += weight * np.abs(wave @ steering.conj().T / len(positions_m)) ** 2
    return patterns


def turned_beam_patterns(patterns: FloatArray, turn_rad: float) -> FloatArray:
    """Mean response while the array turns evenly by an angle, about the middle of the turn.

    Parameters
    ----------
    patterns : ndarray, shape (M, N)
        Of the array at rest, as `beam_patterns` gives them.
    turn_rad : float
        [rad]
    """
    waves = len(patterns)
    order = np.fft.fftfreq(waves, 1.0 / waves)
    smoothing = np.sinc(order * turn_rad / (2.0 * np.pi))
    smoothed = np.fft.ifft(np.fft.fft(patterns, axis=0) * smoothing[:, None], axis=0)
    return np.asarray(smoothed.real, dtype=np.float64)


def _directions(count: int) -> FloatArray:
    angle = 2.0 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)
