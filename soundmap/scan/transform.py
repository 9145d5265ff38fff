r"""Fourier transforms of the frames of an audio scan: sixteen channels at a time, one band.

Samples of several channels lie side by side, so that what a transform does to one channel a wide
instruction does to sixteen. A transform of L samples is taken apart into :math:`L = n_1 m r`:

.. math:: k = i + n_1 l, \qquad X_k = \sum_{b<r} w_{kb} \sum_{a<m} e^{-2 \pi j a l / m}
    e^{-2 \pi j i (b + r a) / L} \sum_{c<n_1} x_{b + r a + m r c} e^{-2 \pi j i c / n_1}

The innermost sums are over real samples and come in conjugate pairs: half of them are made. The
next are over a power of two, by radix 4. The outermost are made for the bins of the band alone,
a small part of all. Any length will do; one that is a large prime is slow.
"""

from __future__ import annotations

from typing import NamedTuple

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
    spread,
    store,
)

ROW = 2 * LANES
"""Numbers in a row: real and imaginary parts of one bin, of sixteen channels."""


class TransformPlan(NamedTuple):
    r"""How a transform is taken apart, its factors as tables, and memory to work in.

    Attributes
    ----------
    reals, power, rest : int
        n_1, m and r.
    cosine, sine : ndarray, shape (n_1 // 2 + 1, (n_1 + 1) // 2)
        Of the angles :math:`-2 \pi i c / n_1`.
    turn : ndarray, shape (n_1 // 2 + 1, m r, 2)
        :math:`e^{-2 \pi j i n / L}`, real and imaginary part.
    twiddle : ndarray, shape (P, 6)
        Of the radix-4 passes one after the other, for each butterfly those of its last three.
    row : ndarray of int, shape (K,)
        Where the first term of each bin stands.
    weight : ndarray, shape (K, r, 2)
        :math:`w_{kb}`.
    sign : ndarray, shape (K,)
        -1 for bins that are the conjugate of the one computed.
    folded, work, other : ndarray
        Memory.
    """

    reals: int
    power: int
    rest: int
    cosine: NDArray[np.float32]
    sine: NDArray[np.float32]
    turn: NDArray[np.float32]
    twiddle: NDArray[np.float32]
    row: NDArray[np.intp]
    weight: NDArray[np.float32]
    sign: NDArray[np.float32]
    folded: NDArray[np.float32]
    work: NDArray[np.float32]
    other: NDArray[np.float32]


def transform_plan(window: int, first: int, bins: int) -> TransformPlan:
    """Plan for bins ``first``, ``first + 1``, ... of frames of so many samples.

    Parameters
    ----------
    window : int
        L.
    first, bins : int
        Bins from 0 to L - 1.
    """
    reals, power = _factors(window, bins)
    columns, halves = window // reals, reals // 2 + 1
    rest = columns // power
    i, c = np.arange(halves), np.arange((reals + 1) // 2)
    real_stage = _unit(np.outer(i, c) / reals)
    k = np.arange(first, first + bins)
    mirrored = k % reals > reals // 2
    computed = np.where(mirrored, window - k, k)
    line = computed // reals
    return TransformPlan(
        reals,
        power,
        rest,
        np.ascontiguousarray(real_stage[..., 0]),
        np.ascontiguousarray(real_stage[..., 1]),
        _unit(np.outer(i, np.arange(columns)) / window),
        _twiddles(power),
        computed % reals * columns + line % power,
        _unit(np.outer(line, np.arange(rest)) / columns),
        np.where(mirrored, np.float32(-1.0), np.float32(1.0)),
        lanes_array(len(c), ROW),
        lanes_array(halves * columns, ROW),
        lanes_array(halves * columns, ROW),
    )


def _factors(window: int, bins: int) -> tuple[int, int]:
    """The n_1 and m by which a transform takes the fewest instructions, roughly counted."""

    def instructions(reals: int, power: int) -> int:
        columns, halves = window // reals, reals // 2 + 1
        real_stage = columns * (reals * halves + reals + 4 * halves)
        passes = power.bit_length() // 2
        return real_stage + 4 * halves * columns * passes + 5 * bins * columns // power

    candidates = [
        (reals, 2**e)
        for reals in range(1, window + 1)
        if window % reals == 0
        for e in range(window.bit_length())
        if window // reals % 2**e == 0
    ]
    return min(candidates, key=lambda factors: instructions(*factors))


def _unit(turns: NDArray[np.float64]) -> NDArray[np.float32]:
    r""":math:`e^{-2 \pi j t}` as real and imaginary part, shape (..., 2)."""
    angle = -2.0 * np.pi * (turns % 1.0)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32)


def _twiddles(power: int) -> NDArray[np.float32]:
    tables = [np.empty((0, 6), dtype=np.float32)]
    while power >= 4:
        tables.append(_unit(np.outer(np.arange(power // 4), [1, 2, 3]) / power).reshape(-1, 6))
        power //= 4
    return np.concatenate(tables)


@njit(cache=True, nogil=True)
def transform(samples, at, step, hop, mean, plan, spectrum):  # type: ignore[no-untyped-def]
    """The band's spectrum of consecutive frames of sixteen channels.

    Parameters
    ----------
    samples : ndarray of float32
        The first frame begins at its position ``at``; consecutive samples are ``step`` numbers
        apart, consecutive frames ``hop``.
    mean : Lanes
        What to take off all samples.
    plan : TransformPlan
    spectrum : ndarray of float32, shape (F, rows, ROW)
        Its first rows become the bins.
    """
    # Parts are handed on one by one: to take them out of a tuple costs more than a short stage.
    reals, power, rest, cosine, sine, turn, twiddle, row, weight, sign, folded, work, other = plan
    for f in range(len(spectrum)):
        start = at + f * hop
        columns = power * rest
        _real_stage(samples, start, step, mean, reals, columns, cosine, sine, turn, folded, work)
        terms = _power_stage(reals, power, rest, twiddle, work, other)
        _band_stage(terms, power, rest, row, weight, sign, spectrum, f * spectrum[0].size)


@njit(cache=True, nogil=True)
def _real_stage(samples, at, step, mean, reals, columns, cosine, sine, turn, folded, work):  # type: ignore[no-untyped-def]
    """Sums over n_1 real samples: with those at both ends folded, products of real numbers."""
    folds, halves, jump = (reals + 1) // 2, reals // 2 + 1, columns * step
    nothing = constant(0.0)
    for n in range(columns):
        start = at + n * step
        first = load(samples, start) - mean
        middle = load(samples, start + reals // 2 * jump) - mean if reals % 2 == 0 else nothing
        total = first + middle
        for c in range(1, folds):
            a = load(samples, start + c * jump) - mean
            b = load(samples, start + (reals - c) * jump) - mean
            store(folded, ROW * c, a + b)
            store(folded, ROW * c + LANES, a - b)
            total = total + (a + b)
        store(work, ROW * n, total)
        store(work, ROW * n + LANES, nothing)
        for i in range(1, halves - 1, 2):  # two at a time share what they load
            re, next_re = first - middle, first + middle
            im = next_im = nothing
            at_i, at_next = i * folds, i * folds + folds
            for c in range(1, folds):
                even, odd = load(folded, ROW * c), load(folded, ROW * c + LANES)
                re = plus_product(re, spread(cosine, at_i + c), even)
                im = plus_product(im, spread(sine, at_i + c), odd)
                next_re = plus_product(next_re, spread(cosine, at_next + c), even)
                next_im = plus_product(next_im, spread(sine, at_next + c), odd)
            _store_turned(re, im, turn, i * columns + n, work)
            _store_turned(next_re, next_im, turn, (i + 1) * columns + n, work)
        if halves % 2 == 0:
            i = halves - 1
            re, im = first + middle if i % 2 == 0 else first - middle, nothing
            for c in range(1, folds):
                re = plus_product(re, spread(cosine, i * folds + c), load(folded, ROW * c))
                im = plus_product(im, spread(sine, i * folds + c), load(folded, ROW * c + LANES))
            _store_turned(re, im, turn, i * columns + n, work)


@njit(cache=True, nogil=True)
def _store_turned(re, im, turn, row, work):  # type: ignore[no-untyped-def]
    c, s = spread(turn, 2 * row), spread(turn, 2 * row + 1)
    store(work, ROW * row, minus_product(c * re, s, im))
    store(work, ROW * row + LANES, plus_product(c * im, s, re))


@njit(cache=True, nogil=True)
def _power_stage(reals, power, rest, twiddle, work, other):  # type: ignore[no-untyped-def]
    """Transforms of m samples, r of them interleaved; the memory in which they end up."""
    source, target = work, other
    for i in range(reals // 2 + 1):  # one after the other: each fits the fastest cache
        source, target = work, other
        apart, next_one, table = rest, 1, 0
        length, done = power, 1
        while length > 1:
            for b in range(rest):
                at = ROW * (i * power * rest + b * next_one)
                to = ROW * (i * rest + b) * power
                if length == 2:
                    _radix_2(source, at, ROW * apart, target, to, done)
                else:
                    _radix_4(source, at, ROW * apart, target, to, length // 4, done, twiddle, table)
            source, target = target, source
            apart, next_one, table = 1, power, table + 6 * (length // 4)
            length, done = length // 4, 4 * done
    return source


@njit(cache=True, nogil=True, inline="always")
def _radix_2(source, at, apart, target, to, done):  # type: ignore[no-untyped-def]
    """The last pass of a transform of 2, 8, 32, ... samples."""
    for q in range(done):
        for part in (0, LANES):
            a = load(source, at + apart * q + part)
            b = load(source, at + apart * (q + done) + part)
            store(target, to + ROW * q + part, a + b)
            store(target, to + ROW * (q + done) + part, a - b)


@njit(cache=True, nogil=True, inline="always")
def _radix_4(source, at, apart, target, to, quarter, done, twiddle, table):  # type: ignore[no-untyped-def]
    """One pass of Stockham's transform."""
    jump, leap = apart * done * quarter, ROW * done
    for p in range(quarter):
        for q in range(done):
            x = at + apart * (q + done * p)
            a, a_im = load(source, x), load(source, x + LANES)
            b, b_im = load(source, x + jump), load(source, x + jump + LANES)
            c, c_im = load(source, x + 2 * jump), load(source, x + 2 * jump + LANES)
            d, d_im = load(source, x + 3 * jump), load(source, x + 3 * jump + LANES)
            even, even_im, odd, odd_im = a + c, a_im + c_im, b + d, b_im + d_im
            a, a_im, b, b_im = a - c, a_im - c_im, b - d, b_im - d_im
            y = to + ROW * (q + done * 4 * p)
            w = table + 6 * p
            store(target, y, even + odd)
            store(target, y + LANES, even_im + odd_im)
            _store_twiddled(a + b_im, a_im - b, twiddle, w, p, target, y + leap)
            _store_twiddled(even - odd, even_im - odd_im, twiddle, w + 2, p, target, y + 2 * leap)
            _store_twiddled(a - b_im, a_im + b, twiddle, w + 4, p, target, y + 3 * leap)


@njit(cache=True, nogil=True)
def _store_twiddled(re, im, twiddle, w, p, target, to):  # type: ignore[no-untyped-def]
    if p == 0:
        store(target, to, re)
        store(target, to + LANES, im)
        return
    c, s = spread(twiddle, w), spread(twiddle, w + 1)
    store(target, to, minus_product(c * re, s, im))
    store(target, to + LANES, plus_product(c * im, s, re))


@njit(cache=True, nogil=True)
def _band_stage(terms, power, rest, row, weight, sign, spectrum, to):  # type: ignore[no-untyped-def]
    """Sums over r, for the bins that are wanted."""
    jump = ROW * power
    for k in range(len(row)):
        at, w = ROW * row[k], 2 * k * rest
        re, im = load(terms, at), load(terms, at + LANES)
        for _ in range(1, rest):
            at += jump
            w += 2
            a, a_im = load(terms, at), load(terms, at + LANES)
            c, s = spread(weight, w), spread(weight, w + 1)
            re = minus_product(plus_product(re, c, a), s, a_im)
            im = plus_product(plus_product(im, c, a_im), s, a)
        store(spectrum, to + ROW * k, re)
        store(spectrum, to + ROW * k + LANES, im * spread(sign, k))
