r"""Which microphones can be believed, by what they deliver and nothing else.

All microphones of a small array hear nearly the same. One that is far quieter or louder than the
others is broken. Low frequencies reach neighbours in nearly the same phase: for a distance
:math:`d` and every direction of a sound, :math:`\cos(2 \pi f d / c) > 0` up to
:math:`f = c / 4d`, so the coherence of two sound microphones, averaged up to there, is well above
nought; well below it one is connected the wrong way round, and at nought one hears something else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray

SPEED_OF_SOUND = 343.0
SILENT, FAR_OFF = 1e-4, 1e-2
"""Powers against those of the others: 40 dB below is silence, 20 dB off is a fault."""

LEAST_RMS = 2.0
"""Below this many steps of a 16-bit recorder, levels say nothing."""

SILENT_PROBES = 3
"""A microphone is dead where this many probes in succession are silent."""

CLIPPED_SHARE, CLIPPED_STEPS = 1e-3, 200.0
"""More samples than this at the extremes, and extremes of this many 16-bit steps, are clipping."""

LOW_HZ, HIGH_HZ = 150.0, 2000.0
NEIGHBOURS = 4
COHERENT = 0.3
"""Coherence that microphones must have with their neighbours, in the median, to tell strangers."""

OPPOSED, UNRELATED = -0.5, 0.25
"""Shares of it: one that is the wrong way round has less, a stranger no more."""


@dataclass(frozen=True)
class MicrophoneHealth:
    """What probes of the audio say of each of Q microphones.

    Attributes
    ----------
    level_db : ndarray, shape (Q,)
        Median over the probes of the mean square, without the mean [dB re (full scale)^2]; -inf
        for silence.
    silent : ndarray of bool, shape (P, Q)
        In which of P probes a microphone is dead.
    odd_level, inverted, unrelated : ndarray of bool, shape (Q,)
        Far weaker or louder than the others; the wrong way round; hears something else.
    clipped_share : ndarray, shape (Q,)
        Of its samples; nought if there are too few to speak of.
    clipped : ndarray of bool, shape (P, Q)
        In which probes.
    """

    level_db: FloatArray
    silent: NDArray[np.bool_]
    odd_level: NDArray[np.bool_]
    inverted: NDArray[np.bool_]
    unrelated: NDArray[np.bool_]
    clipped_share: FloatArray
    clipped: NDArray[np.bool_]

    @property
    def dead(self) -> NDArray[np.bool_]:
        """Silent at some time, shape (Q,)."""
        return np.asarray(self.silent.any(axis=0))

    @property
    def sound(self) -> NDArray[np.bool_]:
        """Which may be used, shape (Q,)."""
        return ~(self.dead | self.odd_level | self.inverted | self.unrelated)


def microphone_health(
    probes: Sequence[NDArray[np.floating]],
    rate_hz: float,
    positions_m: FloatArray | None,
) -> MicrophoneHealth:
    """Judge microphones by short probes of what they recorded, spread over the log.

    Parameters
    ----------
    probes : sequence of ndarray, shape (n, Q)
        Consecutive samples of all microphones; 1 is full scale. At least one.
    rate_hz : float
    positions_m : ndarray, shape (Q, 3), or None
        Without them, nothing is said of coherence.
    """
    centred = [_centred(probe) for probe in probes]
    power = np.array([np.mean(probe**2, axis=0) for probe in centred])
    usual = np.quantile(power, 0.75, axis=1, method="higher")[:, None]
    audible = usual > (LEAST_RMS / 2**15) ** 2
    silent = _lasting(audible & (power < SILENT * usual))
    relative = np.where(audible & ~silent, power / np.where(audible, usual, 1.0), np.nan)
    ratio = np.array([_median(channel) for channel in relative.T])
    typical = _median(ratio)
    with np.errstate(invalid="ignore", divide="ignore"):
        odd = (ratio < FAR_OFF * typical) | (ratio > typical / FAR_OFF)
        level_db = 10.0 * np.log10(np.median(power, axis=0))
    believed = ~(odd | silent.any(axis=0))
    inverted, unrelated = _strangers(centred, rate_hz, positions_m, believed)
    share, clipped = _clipped(probes)
    return MicrophoneHealth(level_db, silent, odd, inverted, unrelated, share, clipped)


def _centred(probe: NDArray[np.floating]) -> FloatArray:
    """Without the mean, and without samples that are no numbers."""
    samples = np.where(np.isfinite(probe), probe, 0.0).astype(np.float64)
    return np.asarray(samples - np.mean(samples, axis=0))


def _median(values: FloatArray) -> float:
    """Median of what is known; NaN if nothing is."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan


def _lasting(silent: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Only what lasts over several probes, or over all if they are few; shape (P, Q)."""
    length = min(SILENT_PROBES, len(silent))
    windows = np.lib.stride_tricks.sliding_window_view(silent, length, axis=0)
    whole: NDArray[np.bool_] = np.asarray(windows.all(axis=-1))
    lasting = np.zeros_like(silent)
    for offset in range(length):
        lasting[offset : offset + len(whole)] |= whole
    return lasting


def _clipped(probes: Sequence[NDArray[np.floating]]) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Share of samples at the extremes that the channel ever reaches, and where."""
    highest = np.max([np.max(probe, axis=0) for probe in probes], axis=0)
    lowest = np.min([np.min(probe, axis=0) for probe in probes], axis=0)
    at_end = [np.sum((probe == highest) | (probe == lowest), axis=0) for probe in probes]
    share = np.sum(at_end, axis=0) / sum(len(probe) for probe in probes)
    clips = (share > CLIPPED_SHARE) & (np.minimum(highest, -lowest) > CLIPPED_STEPS / 2**15)
    return np.where(clips, share, 0.0), clips & (np.array(at_end) > 1)


def _strangers(
    centred: Sequence[FloatArray],
    rate_hz: float,
    positions_m: FloatArray | None,
    believed: NDArray[np.bool_],
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which microphones are the wrong way round, and which hear something else; shape (Q,)."""
    none = np.zeros(len(believed), dtype=bool)
    index = np.flatnonzero(believed)
    if positions_m is None or len(index) < 3:
        return none, none
    coherence = _coherence([probe[:, index] for probe in centred], rate_hz, positions_m[index])
    known = np.isfinite(coherence)
    _, vectors = np.linalg.eigh(np.where(known, coherence, 0.0))
    sign = np.where(vectors[:, -1] < 0.0, -1.0, 1.0)
    if np.sum(sign) < 0:
        sign = -sign
    near = _near(positions_m[index], known)
    towards = np.where(near, coherence * sign[None, :], np.nan)
    heard = np.array([_median(row) for row in towards])
    inverted, unrelated = none.copy(), none.copy()
    with np.errstate(invalid="ignore"):
        usual = _median(heard * sign)
        # If half of them were the wrong way round, nobody could say which half.
        if not usual > COHERENT or not np.sum(sign < 0) < 0.5 * len(index):
            return none, none
        inverted[index] = heard < OPPOSED * usual
        unrelated[index] = np.abs(heard) < UNRELATED * usual
    return inverted, unrelated


def _near(positions_m: FloatArray, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Nearest neighbours of each microphone among those whose coherence is known, shape (Q, Q)."""
    distance = np.linalg.norm(positions_m[:, None] - positions_m[None, :], axis=-1)
    distance[~known] = np.inf
    np.fill_diagonal(distance, np.inf)
    order = np.argsort(distance, axis=1, kind="stable")[:, :NEIGHBOURS]
    near = np.zeros_like(known)
    np.put_along_axis(near, order, True, axis=1)
    return near & np.isfinite(distance)


def _coherence(probes: Sequence[FloatArray], rate_hz: float, positions_m: FloatArray) -> FloatArray:
    """Mean coherence of all pairs over the frequencies at which they cannot be in opposition.

    Shape (Q, Q), in [-1, 1]; NaN where two are so far apart that no frequency is low enough.
    """
    length = min(len(probe) for probe in probes)
    frequency = np.fft.rfftfreq(length, 1.0 / rate_hz)
    # The lowest bins hold what the window lets through of a drift.
    used = (frequency >= max(LOW_HZ, 2.0 * rate_hz / length)) & (frequency <= HIGH_HZ)
    count = positions_m.shape[0]
    cross = np.zeros((int(np.count_nonzero(used)), count, count), dtype=np.complex128)
    window = np.hanning(length)[:, None]
    for probe in probes:
        spectrum = np.fft.rfft(window * probe[:length], axis=0)[used]
        power = np.mean(np.abs(spectrum) ** 2, axis=1)
        heard = power > 0.0
        # Loud moments tell more of how the microphones hear, but must not tell all.
        spectrum[heard] /= power[heard][:, None] ** 0.25
        cross += spectrum[:, :, None] * spectrum[:, None, :].conj()
    own = np.sqrt(np.einsum("kii->ki", cross).real)
    with np.errstate(invalid="ignore", divide="ignore"):
        coherence = cross.real / (own[:, :, None] * own[:, None, :])
    distance = np.linalg.norm(positions_m[:, None] - positions_m[None, :], axis=-1)
    low = frequency[used][:, None, None] * distance[None] <= SPEED_OF_SOUND / 4.0
    low &= np.isfinite(coherence)
    bins = np.sum(low, axis=0)
    total = np.sum(np.where(low, coherence, 0.0), axis=0)
    return np.where(bins > 0, total / np.maximum(bins, 1), np.nan)
