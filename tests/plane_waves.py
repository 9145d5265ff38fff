"""Plane waves on microphone arrays, from delays that are exact in the frequency domain.

The truth of the tests of the scan stage. Nothing here comes from the package but the nouns.
"""

from __future__ import annotations

import numpy as np

from soundmap.geometry import Mount
from soundmap.sensors import AudioBlock, MicArray

SPEED_OF_SOUND = 343.0
START_NS = 1_700_000_000_123_456_789


def mic_array(positions, pascal_per_count=None):
    positions = np.asarray(positions, dtype=np.float64)
    if positions.shape[1] == 2:
        positions = np.column_stack([positions, np.zeros(len(positions))])
    return MicArray(positions, Mount.planar(0.0, 0.0, 0.0, 0.0), pascal_per_count)


def circle(count, radius_m=0.155, first_angle_rad=0.0):
    angle = first_angle_rad + 2.0 * np.pi * np.arange(count) / count
    return radius_m * np.column_stack([np.cos(angle), np.sin(angle)])


def corner(count, spacing_m=0.04):
    """An L: microphones along both axes."""
    along_x = count // 2 + 1
    x = np.column_stack([np.arange(along_x) * spacing_m, np.zeros(along_x)])
    y = np.column_stack([np.zeros(count - along_x), np.arange(1, count - along_x + 1) * spacing_m])
    return np.vstack([x, y])


def scattered(count, rng, radius_m=0.15):
    """Anywhere on a disc, no two closer than 2 cm."""
    points = []
    while len(points) < count:
        point = rng.uniform(-radius_m, radius_m, 2)
        if np.hypot(*point) <= radius_m and all(np.hypot(*(point - p)) > 0.02 for p in points):
            points.append(point)
    return np.array(points)


def sweeps(rng, rate_hz, samples, rms, low_hz=1100.0, high_hz=5900.0):
    """A periodic sound in a band whose power is the same at all times: sweeps of about 20 ms.

    Lines of equal strength with Schroeder's phases; periodic in ``samples``.
    """
    periods = max(round(samples / rate_hz / 0.020), 1)
    spectrum = np.zeros(samples // 2 + 1, dtype=complex)
    line = np.arange(periods, samples // 2, periods)
    frequency = line * rate_hz / samples
    line = line[(frequency >= low_hz) & (frequency <= high_hz)]
    n = np.arange(len(line))
    spectrum[line] = np.exp(-1j * np.pi * n**2 / len(line) + 2j * np.pi * rng.random())
    return _with_rms(np.fft.irfft(spectrum, samples), rms)


def noise(rng, rate_hz, samples, rms, low_hz=1000.0, high_hz=6000.0):
    """Noise of random phases and equal strength in a band; periodic in ``samples``."""
    frequency = np.fft.rfftfreq(samples, 1.0 / rate_hz)
    inside = (frequency >= low_hz) & (frequency <= high_hz)
    spectrum = inside * np.exp(2j * np.pi * rng.random(len(frequency)))
    return _with_rms(np.fft.irfft(spectrum, samples), rms)


def _with_rms(signal, rms):
    return signal * (rms / np.sqrt(np.mean(signal**2)))


def heard(signal, bearing_rad, positions, rate_hz, speed=SPEED_OF_SOUND):
    """What each microphone hears of a wave whose sound at the origin is ``signal``: (T, Q).

    A microphone that lies toward the source hears it earlier.
    """
    toward = np.array([np.cos(bearing_rad), np.sin(bearing_rad)])
    lead_s = np.asarray(positions)[:, :2] @ toward / speed
    frequency = np.fft.rfftfreq(len(signal), 1.0 / rate_hz)
    spectrum = np.fft.rfft(signal)[:, None] * np.exp(2j * np.pi * np.outer(frequency, lead_s))
    return np.fft.irfft(spectrum, len(signal), axis=0)


def as_int16(samples):
    return np.rint(samples).astype(np.int16)


def blocks_of(samples, rate_hz, lengths=None, *, full_scale=1.0, start_ns=START_NS):
    """Consecutive blocks of the given lengths; what is left over is the last one."""
    first = 0
    for length in [*(lengths or []), len(samples)]:
        if first and first >= len(samples):
            return
        part = samples[first : first + length]
        time_ns = start_ns + round(first * 1e9 / rate_hz)
        yield AudioBlock(time_ns, rate_hz, part, full_scale, continues=first > 0)
        first += length


def angle_between(a_rad, b_rad):
    """Absolute difference of two bearings [rad]."""
    return abs((a_rad - b_rad + np.pi) % (2.0 * np.pi) - np.pi)
