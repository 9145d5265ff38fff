r"""Steered response power: how loud the array's output is when it looks along each bearing.

Eqs. (1)-(2) for a delay-and-sum beamformer in the frequency domain. The power of the output,
summed over frames, is a quadratic form of the cross-spectral matrix R,

.. math:: J(\theta) \propto a^H R a
    = \mathrm{tr} R + 2 \sum_{m<n} \mathrm{Re} R_{mn} \cos\phi_{mn}
    + \mathrm{Im} R_{mn} \sin\phi_{mn}, \quad \phi_{mn} = 2 \pi f (r_m - r_n) \cdot u(\theta) / c,

a real matrix product, made here bin by bin. Beside it stands the sum as the paper writes it, which
is slower by far.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from soundmap.geometry import FloatArray
from soundmap.scan.lanes import LANES, constant, lanes_array, load, plus_product, spread, store
from soundmap.scan.spectrum import Framing, band_bins, hann_power
from soundmap.scan.steering import BEARINGS_A_TILE, SteeringTable, steering_vectors

SILENT = 1e-4
"""A bin with less than this share of the mean power of a scan's bins is not made any louder."""


def steered_response_power(
    spectra: NDArray[np.float32],
    table: SteeringTable,
    extra_weight: NDArray[np.float32] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    r"""Weighted sum over bins of :math:`a^H R a` on every bearing, of many scans at a time.

    Parameters
    ----------
    spectra : ndarray of float32, shape (S, 2, K, B)
        Cross-spectra of each scan, real and imaginary, summed over the pairs of each baseline: see
        :class:`~soundmap.scan.cross_spectra.BaselineSpectra`.
    table : SteeringTable
        Of the same bins and microphones.
    extra_weight : ndarray of float32, shape (S, K), optional
        Weights of the bins of each scan, beside the table's, for a second sum.

    Returns
    -------
    power : ndarray of float32, shape (S, G, N)
        Of each group of bins [square of the spectrum's unit], >= 0. Divided by the frames summed,
        by :func:`~soundmap.scan.spectrum.hann_power` and by :math:`Q^2` it is :math:`J_n`.
    extra : ndarray of float32, shape (S, N)
        The second sum, over all bins; nought without its weights.
    """
    scans, bearings = len(spectra), len(table.bearing_rad)
    if extra_weight is None:
        extra_weight = np.empty((scans, 0), dtype=np.float32)
    steered = lanes_array(table.groups + 1, 2, scans, table.cosine.shape[2])
    _steer(spectra, table.cosine, table.sine, table.group, extra_weight, steered)
    even, odd = steered[..., : bearings // 2 if table.halved else bearings].swapaxes(0, 1)
    power = np.concatenate([even + odd, even - odd], axis=2) if table.halved else even + odd
    # Where the array hears nothing, rounding may leave a little less than nothing.
    power = np.maximum(power, np.float32(0.0))
    return power[:-1].swapaxes(0, 1), power[-1]


@njit(cache=True, nogil=True)
def _steer(spectra, cosine, sine, group, extra_weight, steered):  # type: ignore[no-untyped-def]
    """Adds the steered power of all bins, their even and odd parts, to (G + 1, 2, S, C).

    A bin's tables serve all scans while they are in the processor's cache, and sums of four scans
    on `BEARINGS_A_TILE` bearings fill its registers. A scan's own do not depend on the others.
    """
    scans, _, bins, baselines = spectra.shape
    columns, sums = cosine.shape[2], 2 * len(steered) - 2
    weighted = extra_weight.shape[1] > 0
    for k in range(bins):
        for part in range(2):
            table = cosine if part == 0 else sine
            for s in range(0, scans, 4):
                of_scan = (part * bins + k) * baselines
                for c in range(0, columns, BEARINGS_A_TILE):
                    rows = _tile(
                        table,
                        k * baselines * columns + c,
                        columns,
                        baselines,
                        spectra,
                        2 * s * bins * baselines + of_scan,
                        2 * min(s + 1, scans - 1) * bins * baselines + of_scan,
                        2 * min(s + 2, scans - 1) * bins * baselines + of_scan,
                        2 * min(s + 3, scans - 1) * bins * baselines + of_scan,
                    )
                    for row in range(min(4, scans - s)):
                        at = (s + row) * columns + c
                        _add(
                            rows[row],
                            constant(1.0),
                            steered,
                            (2 * group[k] + part) * scans * columns + at,
                        )
                        if weighted:
                            weight = spread(extra_weight, (s + row) * bins + k)
                            _add(rows[row], weight, steered, (sums + part) * scans * columns + at)


@njit(cache=True, nogil=True)
def _tile(table, at, columns, baselines, spectra, first, second, third, fourth):  # type: ignore[no-untyped-def]
    """Sums over baselines on 64 bearings, of the four scans whose spectra begin at these places."""
    a = a_1 = a_2 = a_3 = b = b_1 = b_2 = b_3 = constant(0.0)
    c = c_1 = c_2 = c_3 = d = d_1 = d_2 = d_3 = constant(0.0)
    for line in range(baselines):
        w, w_1 = load(table, at), load(table, at + LANES)
        w_2, w_3 = load(table, at + 2 * LANES), load(table, at + 3 * LANES)
        at += columns
        x = spread(spectra, first + line)
        a, a_1 = plus_product(a, x, w), plus_product(a_1, x, w_1)
        a_2, a_3 = plus_product(a_2, x, w_2), plus_product(a_3, x, w_3)
        x = spread(spectra, second + line)
        b, b_1 = plus_product(b, x, w), plus_product(b_1, x, w_1)
        b_2, b_3 = plus_product(b_2, x, w_2), plus_product(b_3, x, w_3)
        x = spread(spectra, third + line)
        c, c_1 = plus_product(c, x, w), plus_product(c_1, x, w_1)
        c_2, c_3 = plus_product(c_2, x, w_2), plus_product(c_3, x, w_3)
        x = spread(spectra, fourth + line)
        d, d_1 = plus_product(d, x, w), plus_product(d_1, x, w_1)
        d_2, d_3 = plus_product(d_2, x, w_2), plus_product(d_3, x, w_3)
    return (a, a_1, a_2, a_3), (b, b_1, b_2, b_3), (c, c_1, c_2, c_3), (d, d_1, d_2, d_3)


@njit(cache=True, nogil=True)
def _add(row, weight, steered, at):  # type: ignore[no-untyped-def]
    for lanes in row:
        store(steered, at, plus_product(load(steered, at), weight, lanes))
        at += LANES


def whitening(spectra: NDArray[np.float32], table: SteeringTable) -> NDArray[np.float32]:
    r"""Weights with which each bin is as loud as its frequency squared, whatever it was.

    How sharply a bin tells the bearing of a wave grows with its frequency, and how far reflections
    pull it off falls. Sounds that fade toward high frequencies, or hum in a few bins, hide that;
    with

    .. math:: R'_f = \frac{w_f f^2}{\mathrm{tr} R_f} R_f

    normalised over the bins, a plane wave alone gives :math:`Q` where the beam looks along it and
    noise that no two microphones share gives 1 on every bearing.

    Parameters
    ----------
    spectra : ndarray of float32, shape (S, 2, K, B)
        As `steered_response_power` takes them.
    table : SteeringTable

    Returns
    -------
    ndarray of float32, shape (S, K)
        Its ``extra_weight``.
    """
    square = (table.first_bin + np.arange(len(table.weight))) ** 2.0
    own = spectra[:, 0, :, 0]
    least = SILENT * own.mean(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        loudness = np.where(own > 0.0, square / np.maximum(own, least), 0.0)
    return (loudness / np.sum(table.weight * square)).astype(np.float32)


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
