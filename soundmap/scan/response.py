r"""Steered response power: how loud the array's output is when it looks along each bearing.

Eqs. (1)-(2) for a delay-and-sum beamformer in the frequency domain. The power of the output,
summed over frames, is a quadratic form of the cross-spectral matrix R,

.. math:: J(\theta) \propto a^H R a
    = \mathrm{tr} R + 2 \sum_{m<n} \mathrm{Re} R_{mn} \cos\phi_{mn}
    + \mathrm{Im} R_{mn} \sin\phi_{mn}, \quad \phi_{mn} = 2 \pi f (r_m - r_n) \cdot u(\theta) / c,

a real matrix product. Beside it stands the sum as the paper writes it, which is slower by far.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from soundmap.geometry import FloatArray
from soundmap.scan.spectrum import Framing, band_bins, hann_power
from soundmap.scan.steering import LANES, SteeringTable, steering_vectors

SILENT = 1e-4
"""A bin with less than this share of the mean power of a scan's bins is not made any louder."""


def steered_response_power(
    spectra: NDArray[np.float32], table: SteeringTable
) -> NDArray[np.float32]:
    r"""Weighted sum over bins of :math:`a^H R a` on every bearing, of many scans at a time.

    Parameters
    ----------
    spectra : ndarray of float32, shape (S, 2, M, B, LANES)
        Cross-spectra of each scan, real and imaginary, summed over the pairs of each baseline: see
        :class:`~soundmap.scan.cross_spectra.BaselineSpectra`.
    table : SteeringTable
        Of the same bins and microphones.

    Returns
    -------
    ndarray of float32, shape (S, G, N)
        Of each group of bins [square of the spectrum's unit], >= 0. Divided by the frames summed,
        by :func:`~soundmap.scan.spectrum.hann_power` and by :math:`Q^2` it is :math:`J_n`.
    """
    steered = [
        (
            _product(group.cosine, spectra[:, 0, group.blocks]),
            _product(group.sine, spectra[:, 1, group.blocks]),
        )
        for group in table.groups
    ]
    even, odd = (np.stack(part).transpose(2, 0, 1) for part in zip(*steered, strict=True))
    power = np.concatenate([even + odd, even - odd], axis=2) if table.halved else even + odd
    # Where the array hears nothing, rounding may leave a little less than nothing.
    return np.maximum(power, np.float32(0.0))


def _product(table: NDArray[np.float32], parts: NDArray[np.float32]) -> NDArray[np.float32]:
    return table.reshape(len(table), -1) @ parts.reshape(len(parts), -1).T


def whitened_spectra(spectra: NDArray[np.float32], table: SteeringTable) -> NDArray[np.float32]:
    r"""Cross-spectra in which each bin is as loud as its frequency squared, whatever it was.

    How sharply a bin tells the bearing of a wave grows with its frequency, and how far reflections
    pull it off falls. Sounds that fade toward high frequencies, or hum in a few bins, hide that;
    with

    .. math:: R'_f = \frac{w_f f^2}{\mathrm{tr} R_f} R_f

    normalised over the bins, a plane wave alone gives :math:`Q` where the beam looks along it and
    noise that no two microphones share gives 1 on every bearing.

    Parameters
    ----------
    spectra : ndarray of float32, shape (S, 2, M, B, LANES)
        As `steered_response_power` takes them.
    table : SteeringTable
    """
    square = (table.block_bin[:, None] + np.arange(LANES)) ** 2.0
    own = spectra[:, 0, :, 0]
    least = SILENT * own.mean(axis=(1, 2), keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        loudness = np.where(own > 0.0, square / np.maximum(own, least), 0.0)
    weight = (loudness / np.sum(table.weight * square)).astype(np.float32)
    return np.asarray(spectra * weight[:, None, :, None])


def steered_response_power_direct(
    channels: ArrayLike,
    positions_m: FloatArray,
    bearing_rad: FloatArray,
    *,
    rate_hz: float,
    framing: Framing,
    low_hz: float,
    high_hz: float,
    speed_of_sound_m_s: float,
) -> FloatArray:
    r"""Eqs. (1)-(2) as they stand, in double precision: the reference for the fast form.

    .. math::
        s_{f,k}(\theta) = \frac{1}{Q} \sum_q a_q^*(\theta) V_{q,f,k}, \qquad
        J(\theta) = \frac{1}{F} \sum_{f,k} w_k \frac{|s_{f,k}(\theta)|^2}{L \sum h^2}

    with the Hann window h of L samples; by Parseval the second is the mean square over the band.

    Parameters
    ----------
    channels : array_like, shape (Q, T)
        :math:`v_q`, the ``framing.span`` samples of a scan or more (the rest is not looked at).
    positions_m : ndarray, shape (Q, 3)
        Microphones in the array's frame [m].
    bearing_rad : ndarray, shape (N,)
        :math:`\theta_n` [rad].
    rate_hz : float
        Sample rate [Hz].
    framing : Framing
    low_hz, high_hz : float
        Band [Hz].
    speed_of_sound_m_s : float
        c [m/s].

    Returns
    -------
    ndarray, shape (N,)
        :math:`J_n` [square of the samples' unit].

    Raises
    ------
    ValueError
        If the band does not fit the sample rate.
    """
    band = band_bins(rate_hz, framing.window, low_hz=low_hz, high_hz=high_hz)
    observed = np.asarray(channels, dtype=np.float64)[:, : framing.span]
    observed = observed - observed.mean(axis=1, keepdims=True)
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(framing.window) / framing.window)
    power = np.zeros(len(bearing_rad))
    for frame in range(framing.frames):
        start = frame * framing.hop
        spectrum = np.fft.rfft(window * observed[:, start : start + framing.window])
        for k, (frequency_hz, weight) in enumerate(
            zip(band.frequency_hz, band.weight, strict=True), start=band.first
        ):
            response = steering_vectors(
                positions_m, bearing_rad, frequency_hz, speed_of_sound_m_s=speed_of_sound_m_s
            )
            focused = (response.conj() * spectrum[:, k]).mean(axis=1)  # Eq. (1)
            power += weight * np.abs(focused) ** 2  # Eq. (2)
    return power / (framing.frames * hann_power(framing.window))
