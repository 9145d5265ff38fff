r"""Cross-spectra of audio scans, summed over frames and over the pairs of each baseline.

All that steering needs to know of the sound: with :math:`R_{mn} = \sum_f V_{m,f} V_{n,f}^*`, the
sum of :math:`R_{mn}` over the pairs (m, n) of a baseline. Samples stay as recorded, channels side
by side, while they are transformed; then bins take their place, for products of any two channels.
Beside the compiled form stands one in plain numpy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from soundmap.scan.lanes import (
    LANES,
    constant,
    lanes_array,
    load,
    minus_product,
    plus_product,
    store,
    transpose,
    whole_lanes,
)
from soundmap.scan.spectrum import Band, Framing, band_spectrum, cross_spectral_matrix
from soundmap.scan.steering import SteeringTable
from soundmap.scan.transform import ROW, transform, transform_plan

_ROWS_A_SUM = 64
"""Samples that are summed in single precision; sums of many would lose digits."""


class BaselineSpectra:
    """Turns samples into cross-spectra; keeps the memory that this takes for the next scans.

    Parameters
    ----------
    microphones : int
        :math:`Q`.
    framing : Framing
    table : SteeringTable
    """

    def __init__(self, microphones: int, framing: Framing, table: SteeringTable) -> None:
        bins, baselines = table.spectra_shape[1:]
        lanes = whole_lanes(microphones)
        self._framing = framing
        self._plan = transform_plan(framing.window, table.first_bin - 1, bins + 2)
        self._samples = lanes_array(framing.span, lanes)
        # Rows behind the band's last stay 0: bins are worked on in whole lanes.
        self._spectrum = lanes_array(framing.frames, whole_lanes(bins) + 2, ROW)
        self._parts = lanes_array(whole_lanes(bins) // LANES, lanes, framing.frames, ROW)
        self._sums = lanes_array(2, baselines, LANES)
        self._pairs = _pairs_by_baseline(table, self._parts[0, 0].size)

    def write(
        self, samples: NDArray[Any], advance: int, spectra: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """Writes the cross-spectra of consecutive scans.

        Parameters
        ----------
        samples : ndarray, shape (T, Q)
            Of all scans, in whatever type they were recorded.
        advance : int
            Samples from the start of one scan to that of the next.
        spectra : ndarray of float32, shape (S, 2, K, B)
            Where real and imaginary parts go, as `SteeringTable.spectra_shape` says; nought for a
            scan whose samples are not all finite.

        Returns
        -------
        ndarray of bool, shape (S,)
            Whether the samples of each scan are all finite.
        """
        finite = np.empty(len(spectra), dtype=bool)
        _write_scans(
            np.ascontiguousarray(samples),
            advance,
            self._framing.hop,
            self._plan,
            self._samples,
            self._spectrum,
            self._parts,
            *self._pairs,
            self._sums,
            spectra,
            finite,
        )
        return finite


def _pairs_by_baseline(
    table: SteeringTable, channel_size: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """First pair of each baseline and behind the last; where a pair's two channels begin."""
    lines = table.baselines
    starts = np.searchsorted(lines.baseline, np.arange(len(lines) + 1)).astype(np.intp)
    first, second = (channel_size * side.astype(np.intp) for side in (lines.first, lines.second))
    return starts, first, second


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
    ndarray, shape (2, K, B)
    """
    matrix = cross_spectral_matrix(band_spectrum(channels, framing, band))
    lines = table.baselines
    summed = np.zeros((len(band), len(lines)), dtype=matrix.dtype)
    np.add.at(summed.T, lines.baseline, matrix[:, lines.first, lines.second].T)
    return np.stack([summed.real, summed.imag])


@njit(cache=True, nogil=True)
def _write_scans(  # type: ignore[no-untyped-def]
    samples,
    advance,
    hop,
    plan,
    lanes,
    spectrum,
    parts,
    starts,
    first,
    second,
    sums,
    spectra,
    finite,
):
    for scan in range(len(spectra)):
        begin = scan * advance
        mean = _as_lanes(samples[begin : begin + len(lanes)], lanes)
        finite[scan] = np.all(np.isfinite(mean))
        if finite[scan]:
            _write_parts(lanes, hop, mean, plan, spectrum, parts)
            _write_sums(parts, starts, first, second, sums, spectra[scan])
        else:
            spectra[scan] = 0.0


@njit(cache=True, nogil=True)
def _as_lanes(samples, lanes):  # type: ignore[no-untyped-def]
    """Samples (T, Q) in whole lanes; their mean, shape (1, lanes), not finite if one is not."""
    length, channels = samples.shape
    width = lanes.shape[1]
    if channels == width:  # nothing to insert: one long loop, not many short ones
        source, target = samples.reshape(-1), lanes.reshape(-1)
        for i in range(len(target)):
            target[i] = np.float32(source[i])
    else:
        for t in range(length):
            for q in range(channels):
                lanes[t, q] = np.float32(samples[t, q])
    total = np.zeros(width)
    part = np.empty(LANES, dtype=np.float32)
    for lane in range(0, width, LANES):
        for first in range(0, length, _ROWS_A_SUM):
            last = min(first + _ROWS_A_SUM, length) - 1
            summed, next_summed = constant(0.0), constant(0.0)
            for t in range(first, last, 2):  # no sum waits for the other
                summed = summed + load(lanes, t * width + lane)
                next_summed = next_summed + load(lanes, (t + 1) * width + lane)
            if (last - first) % 2 == 0:
                summed = summed + load(lanes, last * width + lane)
            store(part, 0, summed + next_summed)
            for i in range(LANES):
                total[lane + i] += part[i]
    return (total / length).astype(np.float32)


@njit(cache=True, nogil=True)
def _write_parts(samples, hop, mean, plan, spectrum, parts):  # type: ignore[no-untyped-def]
    """Real and imaginary parts (K / LANES, Q, F, ROW) of Hann-windowed spectra, from samples.

    The window of one period of a cosine is three taps on the bins: see
    :func:`~soundmap.scan.spectrum.band_spectrum`.
    """
    width = samples.shape[1]
    blocks, _, frames, _ = parts.shape
    half, quarter = constant(0.5), constant(0.25)
    tile = np.empty((2, LANES, LANES), dtype=np.float32)
    for group in range(0, width, LANES):
        transform(samples, group, width, hop * width, load(mean, group), plan, spectrum)
        for f in range(frames):
            frame = f * spectrum[0].size
            for block in range(blocks):
                for bin_ in range(LANES):
                    at = frame + ROW * (block * LANES + bin_ + 1)
                    for part in range(2):
                        beside = load(spectrum, at - ROW) + load(spectrum, at + ROW)
                        windowed = minus_product(half * load(spectrum, at), quarter, beside)
                        store(tile, (part * LANES + bin_) * LANES, windowed)
                        at += LANES
                to = ((block * width + group) * frames + f) * ROW
                transpose(tile, 0, parts, to, frames * ROW)
                transpose(tile, LANES * LANES, parts, to + LANES, frames * ROW)


@njit(cache=True, nogil=True)
def _write_sums(parts, starts, first, second, sums, spectra):  # type: ignore[no-untyped-def]
    """Sums (2, K, B) over frames and pairs of one channel times the other's conjugate."""
    blocks, width, frames, _ = parts.shape
    _, bins, baselines = spectra.shape
    for block in range(blocks):
        base = block * width * frames * ROW
        for line in range(baselines):
            re_re = im_im = im_re = re_im = constant(0.0)
            for pair in range(starts[line], starts[line + 1]):
                m, n = base + first[pair], base + second[pair]
                for _ in range(frames):
                    re, im = load(parts, m), load(parts, m + LANES)
                    other_re, other_im = load(parts, n), load(parts, n + LANES)
                    re_re = plus_product(re_re, re, other_re)
                    im_im = plus_product(im_im, im, other_im)
                    im_re = plus_product(im_re, im, other_re)
                    re_im = plus_product(re_im, re, other_im)
                    m += ROW
                    n += ROW
            store(sums, line * LANES, re_re + im_im)
            store(sums, (baselines + line) * LANES, im_re - re_im)
        for part in range(2):
            for bin_ in range(min(LANES, bins - block * LANES)):
                for line in range(baselines):
                    spectra[part, block * LANES + bin_, line] = sums[part, line, bin_]
