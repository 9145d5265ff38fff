r"""Spectra of the microphones over the frames of one audio scan, and what they have in common.

Sect. 2.3: a short-time Fourier transform of the observed signals, the bins of a frequency band,
and the cross-spectra of all pairs of microphones summed over the frames. The steered response
power is linear in the cross-spectra, so that an array is steered once a scan instead of once a
frame. This room knows neither where the microphones are nor where the array looks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from soundmap.geometry import FloatArray

Complex = NDArray[np.complexfloating[Any, Any]]

CHANNELS_A_TRANSFORM = 8
"""Transforming few channels at a time keeps samples and spectra in the processor's cache."""


@dataclass(frozen=True)
class Framing:
    """The frames of one audio scan, in whole samples.

    Attributes
    ----------
    window : int
        Length of a frame [samples].
    hop : int
        Shift from one frame to the next [samples].
    frames : int
        Frames averaged into a scan.
    """

    window: int
    hop: int
    frames: int

    def __post_init__(self) -> None:
        if self.window < 4 or self.hop < 1 or self.frames < 1:
            raise ValueError(
                f"a scan of {self.frames} frames of {self.window} samples, shifted by {self.hop}, "
                "holds no sound: windows need 4 samples or more, the shift 1 or more"
            )

    @classmethod
    def from_times(cls, rate_hz: float, *, window_s: float, hop_s: float, frames: int) -> Framing:
        """Frames whose lengths are given in seconds, each rounded to whole samples.

        The shift stays whole: at 11025 Hz a hop of 10 ms is 110 samples, 9.977 ms, on and on.
        Nothing drifts, because time is counted in samples, never in hops.

        Examples
        --------
        >>> Framing.from_times(48000.0, window_s=0.025, hop_s=0.010, frames=10)
        Framing(window=1200, hop=480, frames=10)
        """
        return cls(round(window_s * rate_hz), round(hop_s * rate_hz), frames)

    @property
    def span(self) -> int:
        """Samples from the first of the first frame to the last of the last, both included."""
        return (self.frames - 1) * self.hop + self.window

    @property
    def advance(self) -> int:
        """Samples from the start of one scan to that of the next."""
        return self.frames * self.hop


@dataclass(frozen=True)
class Band:
    """The bins of a Fourier transform that cover a frequency band.

    Attributes
    ----------
    first : int
        Index of the lowest bin, at least 1.
    frequency_hz : ndarray, shape (K,)
        Centre of each bin [Hz].
    weight : ndarray, shape (K,)
        What the squared magnitude of each bin counts for in a one-sided power [-]: 2 inside the
        band, less for the bins that the edges cut.
    """

    first: int
    frequency_hz: FloatArray
    weight: FloatArray

    def __len__(self) -> int:
        return len(self.weight)


def band_bins(rate_hz: float, window: int, *, low_hz: float, high_hz: float) -> Band:
    """The bins that cover a band, each weighted with the share of its width inside the band.

    Bin k stands for the frequencies from k - 1/2 to k + 1/2 bin widths. White noise thus has the
    power of the band as it is, and not that of the band rounded to whole bins. Bin 0 is left out:
    it is the offset of the recorder, not sound.

    Parameters
    ----------
    rate_hz : float
        Sample rate [Hz].
    window : int
        Length of the transform [samples].
    low_hz, high_hz : float
        Edges of the band [Hz].

    Raises
    ------
    ValueError
        If the band is empty, or reaches above half the sample rate.

    Examples
    --------
    >>> band = band_bins(48000.0, 1200, low_hz=1000.0, high_hz=6000.0)
    >>> band.first, len(band), band.weight[:3].tolist(), band.weight[-1].item()
    (25, 126, [1.0, 2.0, 2.0], 1.0)
    """
    if not 0.0 < low_hz < high_hz:
        raise ValueError(f"the band {low_hz:g} Hz to {high_hz:g} Hz is empty: low_hz must be lower")
    if high_hz > rate_hz / 2.0:
        raise ValueError(
            f"the band {low_hz:g} Hz to {high_hz:g} Hz reaches above {rate_hz / 2.0:g} Hz, half "
            f"the sample rate of {rate_hz:g} Hz, where nothing is recorded: "
            f"set high_hz to {rate_hz / 2.0:g} or less"
        )
    width = rate_hz / window
    bins = np.arange(1, window // 2 + 1)
    inside = np.minimum(bins + 0.5, high_hz / width) - np.maximum(bins - 0.5, low_hz / width)
    bins, inside = bins[inside > 1e-9], inside[inside > 1e-9]
    if len(bins) == 0:
        raise ValueError(
            f"the band {low_hz:g} Hz to {high_hz:g} Hz lies below the first bin of a window of "
            f"{window} samples ({width:g} Hz): use a longer window or a higher band"
        )
    return Band(int(bins[0]), bins * width, 2.0 * inside)


def band_spectrum(channels: NDArray[np.floating[Any]], framing: Framing, band: Band) -> Complex:
    r"""Hann-windowed Fourier transforms of every frame and microphone, in a band.

    The frames are transformed as they are. The periodic Hann window is a cosine of one period a
    frame, which in the spectrum is three taps:
    :math:`V_k = X_k / 2 - (X_{k-1} + X_{k+1}) / 4`, exactly.

    Parameters
    ----------
    channels : ndarray, shape (Q, T)
        :math:`v_q`, at least ``framing.span`` samples of each microphone; float32 stays float32.
    framing : Framing
    band : Band
        Of a transform of ``framing.window`` samples.

    Returns
    -------
    ndarray of complex, shape (K, Q, F)
        :math:`V_q` by bin, microphone and frame, the bins first: the cross-spectra of each bin
        are then one matrix product.
    """
    views = np.lib.stride_tricks.sliding_window_view(channels, framing.window, axis=1)
    views = views[:, : framing.span - framing.window + 1 : framing.hop]
    return np.concatenate(
        [
            _hann_taps(scipy.fft.rfft(views[start : start + CHANNELS_A_TRANSFORM]), framing, band)
            for start in range(0, len(channels), CHANNELS_A_TRANSFORM)
        ],
        axis=1,
    )


def _hann_taps(spectrum: Complex, framing: Framing, band: Band) -> Complex:
    """Spectra (Q, F, L // 2 + 1) of bare frames as those of windowed frames, shape (K, Q, F)."""
    last = band.first + len(band)
    near = spectrum.transpose(2, 0, 1)[band.first - 1 : last + 1]
    if last == spectrum.shape[-1]:  # the tap above half the rate is the mirror of one below it
        near = np.concatenate([near, spectrum[None, ..., framing.window - last].conj()])
    near = np.ascontiguousarray(near)
    windowed = near[:-2] + near[2:]
    windowed *= -0.25
    windowed += 0.5 * near[1:-1]
    return windowed


def hann_power(window: int) -> float:
    r"""Sum of the squares of a periodic Hann window times its length, :math:`3 L^2 / 8`.

    What the squared bins of :func:`band_spectrum` are divided by to be powers (Parseval).
    """
    return 3.0 * window**2 / 8.0


def cross_spectral_matrix(spectrum: Complex) -> Complex:
    r"""Cross-spectra of all pairs of microphones, summed over frames.

    .. math:: R_{mn} = \sum_f V_{m,f} V_{n,f}^*

    Parameters
    ----------
    spectrum : ndarray of complex, shape (K, Q, F)

    Returns
    -------
    ndarray of complex, shape (K, Q, Q)
        Hermitian; its diagonal holds the microphones' own powers.
    """
    return np.matmul(spectrum, spectrum.conj().transpose(0, 2, 1))
