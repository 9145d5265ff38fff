r"""Cross-spectra of an audio scan, summed over its frames and over the pairs of each baseline.

All that steering needs to know of the sound: with :math:`R_{mn} = \sum_f V_{m,f} V_{n,f}^*`, the
sum of :math:`R_{mn}` over the pairs (m, n) of a baseline. Samples stay as recorded, channels side
by side: two real channels are transformed as one complex, and told apart in the few bins of the
band, where the Hann window is applied too. Beside the compiled form stands one in plain numpy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.fft
from numba import njit
from numpy.typing import NDArray

from soundmap.scan.spectrum import Band, Framing, band_spectrum, cross_spectral_matrix
from soundmap.scan.steering import LANES, SteeringTable

_QUARTER = np.float32(0.25)
_EIGHTH = np.float32(0.125)


class BaselineSpectra:
    """Turns samples into cross-spectra; keeps the memory that this takes for the next scan.

    Parameters
    ----------
    microphones : int
        :math:`Q`.
    framing : Framing
    table : SteeringTable
    """

    def __init__(self, microphones: int, framing: Framing, table: SteeringTable) -> None:
        self._table = table
        even = microphones + microphones % 2  # a silent channel makes the last one a pair
        self._centred = np.zeros((framing.span, even), dtype=np.float32)
        pairs = self._centred.view(np.complex64)
        step = pairs.strides[0]
        self._frames = np.lib.stride_tricks.as_strided(
            pairs,
            (framing.frames, even // 2, framing.window),
            (framing.hop * step, pairs.strides[1], step),
            writeable=False,
        )

    def add(self, samples: NDArray[Any], spectra: NDArray[np.float32]) -> bool:
        """Writes the cross-spectra of one scan.

        Parameters
        ----------
        samples : ndarray, shape (span, Q)
            In whatever type they were recorded.
        spectra : ndarray of float32, shape (2, M, B, LANES)
            Where real and imaginary parts go, as `SteeringTable.spectra_shape` says; unchanged if
            the samples are not finite.

        Returns
        -------
        bool
            Whether all samples are finite.
        """
        if not _centre(samples, self._centred):
            return False
        spectrum = scipy.fft.fft(self._frames, axis=2)
        lines = self._table.baselines
        _add_spectra(
            spectrum, self._table.block_bin, lines.first, lines.second, lines.baseline, spectra
        )
        return True


def baseline_spectra_plain(
    channels: NDArray[np.floating[Any]], framing: Framing, band: Band, table: SteeringTable
) -> NDArray[Any]:
    """The same in plain numpy, in the precision of its input: the reference.

    Parameters
    ----------
    channels : ndarray, shape (Q, T)
        At least ``framing.span`` samples of each microphone, their mean removed.
    framing : Framing
    band : Band
        Of the table.
    table : SteeringTable

    Returns
    -------
    ndarray, shape (2, M, B, LANES)
        0 in the lanes without weight.
    """
    matrix = cross_spectral_matrix(band_spectrum(channels, framing, band))
    lines = table.baselines
    summed = np.zeros((len(band), len(lines)), dtype=matrix.dtype)
    np.add.at(summed.T, lines.baseline, matrix[:, lines.first, lines.second].T)
    spectra = np.zeros(table.spectra_shape, dtype=matrix.real.dtype)
    ends = np.append(table.block_bin[1:], band.first + len(band))
    for block, (start, end) in enumerate(zip(table.block_bin, ends, strict=True)):
        part = summed[start - band.first : end - band.first].T
        spectra[0, block, :, : part.shape[1]] = part.real
        spectra[1, block, :, : part.shape[1]] = part.imag
    return spectra


@njit(cache=True, nogil=True)
def _centre(samples, centred):  # type: ignore[no-untyped-def]
    """Samples (T, Q) less the mean of their channel; False and nothing done if not finite."""
    length, channels = samples.shape
    total = np.zeros(channels)
    for t in range(length):
        for q in range(channels):
            total[q] += np.float32(samples[t, q])
    mean = np.empty(channels, dtype=np.float32)
    for q in range(channels):
        mean[q] = total[q] / length
        if not np.isfinite(mean[q]):
            return False
    for t in range(length):
        for q in range(channels):
            centred[t, q] = np.float32(samples[t, q]) - mean[q]
    return True


@njit(cache=True, nogil=True)
def _add_spectra(spectrum, block_bin, first, second, baseline, spectra):  # type: ignore[no-untyped-def]
    """Cross-spectra (2, M, B, LANES) of the spectra (F, Q / 2, L) of pairs of channels."""
    frames, pairs, _ = spectrum.shape
    parts = np.empty((frames, 2 * pairs, 2 * LANES), dtype=np.float32)
    sums = np.empty((spectra.shape[2], 2 * LANES), dtype=np.float32)
    for block in range(len(block_bin)):
        _windowed_parts(spectrum, block_bin[block] - 1, parts)
        _sum_products(parts, first, second, baseline, sums)
        spectra[0, block] = sums[:, :LANES]
        spectra[1, block] = sums[:, LANES:]


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def _windowed_parts(spectrum, start, parts):  # type: ignore[no-untyped-def]
    """Real and imaginary parts (F, Q, 2 LANES) of each channel, the Hann window applied.

    Of the bins that follow ``start``. With Z the spectrum of two channels as one and Z' that at
    the mirrored bins, they are (Z + Z'*) / 2 and (Z - Z'*) / 2j.
    """
    frames, pairs, length = spectrum.shape
    near = np.empty((4, LANES + 2), dtype=np.float32)
    for f in range(frames):
        for p in range(pairs):
            k = start % length
            for j in range(LANES + 2):
                mirror = length - k if k > 0 else 0
                near[0, j] = spectrum[f, p, k].real
                near[1, j] = spectrum[f, p, k].imag
                near[2, j] = spectrum[f, p, mirror].real
                near[3, j] = spectrum[f, p, mirror].imag
                k = k + 1 if k + 1 < length else 0
            for j in range(LANES):
                a = _QUARTER * near[0, j + 1] - _EIGHTH * (near[0, j] + near[0, j + 2])
                b = _QUARTER * near[1, j + 1] - _EIGHTH * (near[1, j] + near[1, j + 2])
                c = _QUARTER * near[2, j + 1] - _EIGHTH * (near[2, j] + near[2, j + 2])
                d = _QUARTER * near[3, j + 1] - _EIGHTH * (near[3, j] + near[3, j + 2])
                parts[f, 2 * p, j] = a + c
                parts[f, 2 * p, LANES + j] = b - d
                parts[f, 2 * p + 1, j] = b + d
                parts[f, 2 * p + 1, LANES + j] = c - a


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def _sum_products(parts, first, second, baseline, sums):  # type: ignore[no-untyped-def]
    """Sums (B, 2 LANES) over frames and pairs of one part times the other's conjugate."""
    sums[:] = 0.0
    for f in range(len(parts)):
        part = parts[f]
        for i in range(len(first)):
            m, n, b = first[i], second[i], baseline[i]
            for j in range(LANES):
                sums[b, j] += part[m, j] * part[n, j] + part[m, LANES + j] * part[n, LANES + j]
                sums[b, LANES + j] += (
                    part[m, LANES + j] * part[n, j] - part[m, j] * part[n, LANES + j]
                )
