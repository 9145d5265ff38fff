r"""Propagation: what a moving microphone hears of a sound that arrives with changing delay.

A sound is a table, one period of a signal, sampled more densely than the microphone samples.
What microphone m hears is :math:`g_m(t) s(t - \tau_m(t))`: the delay varies smoothly, so that
the Doppler shift is not modelled but simply comes out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray

FloatTable = NDArray[np.float32]
KNOT_STEP = 96
"""Samples between the moments at which delays and gains are computed; linear between (2 ms).

At 1 m/s and 0.3 m from a source a delay is bent by at most 0.0003 samples within 2 ms.
"""


@dataclass(frozen=True)
class SoundTable:
    """One period of a sound, sampled ``oversampling`` times as densely as microphones sample.

    Attributes
    ----------
    phases : ndarray of float32, shape (oversampling, 1 + L + guard)
        Sound pressure [Pa]: row r holds every ``oversampling``-th value from the r-th on, the
        last one of the period in front and the first ones again behind. Neighbours in time of
        samples that follow one another thus lie side by side.
    length : int
        :math:`L`, samples of a period at the microphones' nominal rate.
    rate_hz : float
        That rate.
    """

    phases: FloatTable
    length: int
    rate_hz: float

    @classmethod
    def from_period(cls, one_period: FloatTable, oversampling: int, rate_hz: float) -> SoundTable:
        """A table of one period, shape (L * oversampling,); ``rate_hz`` is the microphones'."""
        rows = np.asarray(one_period, dtype=np.float32).reshape(-1, oversampling).T
        guard = np.resize(np.arange(rows.shape[1]), 2 * KNOT_STEP)
        phases = np.concatenate([rows[:, -1:], rows, rows[:, guard]], axis=1)
        return cls(np.ascontiguousarray(phases), rows.shape[1], rate_hz)


def add_delayed(
    out: FloatTable,
    table: SoundTable,
    emission_s: FloatArray,
    gain: FloatArray,
) -> None:
    """Add a sound, as heard by every microphone, to ``out``.

    Parameters
    ----------
    out : ndarray of float32, shape (Q, K * KNOT_STEP)
        One row a microphone; added to.
    table : SoundTable
    emission_s : ndarray, shape (Q, K + 1)
        When the sound left its source that is heard at each knot [s].
    gain : ndarray, shape (Q, K + 1)
        Amplitude at each knot.
    """
    place = np.ascontiguousarray(emission_s * table.rate_hz * len(table.phases))
    gain = np.ascontiguousarray(gain, dtype=np.float64)
    _add_delayed(out, table.phases, table.length, place, gain)


@numba.njit(cache=True, nogil=True, fastmath=True)
def _add_delayed(
    out: FloatTable,
    phases: FloatTable,
    length: int,
    place: FloatArray,
    gain: FloatArray,
) -> None:
    """Cubic Lagrange interpolation at linearly moving places, given in steps of the table.

    From one sample to the next the place moves on by nearly one row's step, so that for long
    stretches all four neighbours come from fixed rows: such a stretch is one plain loop.
    """
    dense = len(phases)
    for m in range(len(out)):
        for k in range(place.shape[1] - 1):
            if gain[m, k] == 0.0 and gain[m, k + 1] == 0.0:
                continue
            start = place[m, k]
            creep = (place[m, k + 1] - start) / KNOT_STEP - dense
            start -= np.floor(start / (length * dense)) * (length * dense)
            whole = int(np.floor(start))
            start -= whole
            rise = (gain[m, k + 1] - gain[m, k]) / KNOT_STEP
            i = 0
            while i < KNOT_STEP:
                at = start + creep * i
                left = np.floor(at)
                end = KNOT_STEP
                if creep > 0.0:
                    end = min(end, max(i + 1, int(np.ceil((left + 1.0 - start) / creep))))
                elif creep < 0.0:
                    end = min(end, max(i + 1, int(np.floor((left - start) / creep)) + 1))
                _add_stretch(
                    out[m],
                    k * KNOT_STEP + i,
                    end - i,
                    phases,
                    whole + int(left) + dense * i,
                    (at - left, creep, gain[m, k] + rise * i, rise),
                )
                i = end


@numba.njit(cache=True, nogil=True, fastmath=True)
def _add_stretch(
    row: FloatTable,
    first: int,
    count: int,
    phases: FloatTable,
    left: int,
    line: tuple[float, float, float, float],
) -> None:
    """Add a stretch that begins between the entries ``left`` and ``left + 1`` of the table.

    ``line``: share of the way between the two and its change a sample, gain and its change.
    Indices are unsigned: signed ones might count from the end, which keeps the compiler from
    computing several samples at once (0.4 instead of 4 ns a sample).
    """
    dense = len(phases)
    before, here = phases[(left - 1) % dense], phases[left % dense]
    after, beyond = phases[(left + 1) % dense], phases[(left + 2) % dense]
    q0, q1 = np.uintp((left - 1) // dense + 1), np.uintp(left // dense + 1)
    q2, q3 = np.uintp((left + 1) // dense + 1), np.uintp((left + 2) // dense + 1)
    d0, dd = np.float32(line[0]), np.float32(line[1])
    g0, dg = np.float32(line[2]), np.float32(line[3])
    third, half, sixth = np.float32(1 / 3), np.float32(0.5), np.float32(1 / 6)
    start = np.uintp(first)
    for i in range(np.uintp(count)):
        step = np.float32(np.int32(i))
        d = d0 + dd * step
        a, b, c, e = before[q0 + i], here[q1 + i], after[q2 + i], beyond[q3 + i]
        c1 = c - a * third - b * half - e * sixth
        c2 = (a + c) * half - b
        c3 = (e - a) * sixth + (b - c) * half
        row[start + i] += (g0 + dg * step) * (((c3 * d + c2) * d + c1) * d + b)
