"""How fast audio scans are made, beside plain numpy forms of the same sums.

    python tests/benchmarks/bench_audio_scan.py [--seconds 30] [--repeats 5]

30 s of 16 channels, 48 kHz, 16 bit, with two sources in noise; one thread. CPU seconds, best of
the repeats: steadier than the wall clock on a busy machine. The fast form is timed from blocks
of samples to audio scans, as the pipeline runs it; the plain forms get their samples whole. The
slow reference is timed on one second.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MKL_NUM_THREADS", "1")

import argparse
import platform
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import scipy

from soundmap.config import ArrayConfig, ScanConfig
from soundmap.geometry import Mount
from soundmap.scan.audio_scan import audio_scans
from soundmap.scan.response import steered_response_power_direct
from soundmap.scan.spectrum import Framing, band_bins, hann_power
from soundmap.scan.steering import scan_bearings, steering_vectors
from soundmap.sensors import AudioBlock, MicArray
from soundmap.sound import AudioScan

RATE_HZ = 48000.0
CONFIG = ScanConfig()
POSITIONS = ArrayConfig().microphone_positions()
FRAMING = Framing.from_times(RATE_HZ, window_s=0.025, hop_s=0.010, frames=10)
SOURCES = ((47.0, 1.0), (200.0, 0.7))
"""Bearing [deg] and strength."""


def recording(seconds: float) -> np.ndarray:
    """Two far sources and noise, shape (T, 16), int16."""
    rng = np.random.default_rng(1)
    length = round(seconds * RATE_HZ)
    frequency = np.fft.rfftfreq(length, 1.0 / RATE_HZ)
    samples = 0.3 * rng.standard_normal((length, len(POSITIONS)))
    for degrees, strength in SOURCES:
        spectrum = np.fft.rfft(strength * rng.standard_normal(length))
        toward = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0.0])
        for q, lead_s in enumerate(POSITIONS @ toward / CONFIG.speed_of_sound_m_s):
            shift = np.exp(2j * np.pi * frequency * lead_s)
            samples[:, q] += np.fft.irfft(spectrum * shift, length)
    return np.rint(2000.0 * samples).astype(np.int16)


def fast(samples: np.ndarray, block: int) -> np.ndarray:
    """The package's form, from blocks of so many samples."""
    array = MicArray(POSITIONS, Mount.planar(0.0, 0.0, 0.0, 0.0), None)

    def blocks() -> Iterator[AudioBlock]:
        for start in range(0, len(samples), block):
            time_ns = round(start * 1e9 / RATE_HZ)
            yield AudioBlock(time_ns, RATE_HZ, samples[start : start + block], 32768.0, start > 0)

    return np.array([scan.power for scan in audio_scans(blocks(), array, CONFIG)])


def per_frame(samples: np.ndarray) -> np.ndarray:
    """Plain numpy in double precision: each frame windowed, transformed, steered by an einsum."""
    band = band_bins(RATE_HZ, FRAMING.window, low_hz=CONFIG.low_hz, high_hz=CONFIG.high_hz)
    steering = np.stack(
        [
            steering_vectors(POSITIONS, scan_bearings(CONFIG.bearings), f, speed_of_sound_m_s=343.0)
            for f in band.frequency_hz
        ]
    ).conj()
    window = np.hanning(FRAMING.window + 1)[:-1, None]
    scans = (len(samples) - FRAMING.span) // FRAMING.advance + 1
    power = np.zeros((scans, CONFIG.bearings))
    for scan in range(scans):
        for frame in range(FRAMING.frames):
            start = scan * FRAMING.advance + frame * FRAMING.hop
            excerpt = samples[start : start + FRAMING.window] / 32768.0
            spectrum = np.fft.rfft(window * excerpt, axis=0)[band.first : band.first + len(band)]
            focused = np.einsum("knq,kq->kn", steering, spectrum) / len(POSITIONS)
            power[scan] += band.weight @ np.abs(focused) ** 2
    return power / (FRAMING.frames * hann_power(FRAMING.window))


def direct(samples: np.ndarray) -> np.ndarray:
    """The package's reference: one steering per frame, bin and bearing; double precision."""
    scans = (len(samples) - FRAMING.span) // FRAMING.advance + 1
    return np.array(
        [
            steered_response_power_direct(
                samples[scan * FRAMING.advance :][: FRAMING.span].T / 32768.0,
                POSITIONS,
                scan_bearings(CONFIG.bearings),
                rate_hz=RATE_HZ,
                framing=FRAMING,
                low_hz=CONFIG.low_hz,
                high_hz=CONFIG.high_hz,
                speed_of_sound_m_s=CONFIG.speed_of_sound_m_s,
            )
            for scan in range(scans)
        ]
    )


def cpu_seconds(action: Callable[[], np.ndarray], repeats: int) -> tuple[float, np.ndarray]:
    """CPU time of the best of several calls, and what it returned."""
    best, result = np.inf, np.empty(0)
    for _ in range(repeats):
        start = time.process_time()
        result = action()
        best = min(best, time.process_time() - start)
    return best, result


def processor() -> str:
    """Name of the processor."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    samples = recording(options.seconds)
    second = samples[: round(RATE_HZ)]
    fast(second, 960)  # warm
    forms = [
        ("audio_scans, blocks of 20 ms", samples, lambda: fast(samples, 960), options.repeats),
        ("audio_scans, blocks of 1 s", samples, lambda: fast(samples, 48000), options.repeats),
        ("plain numpy, einsum a frame", samples, lambda: per_frame(samples), 1),
        ("direct reference", second, lambda: direct(second), 1),
    ]
    print(f"{processor()}, {platform.system()}, Python {platform.python_version()}, ", end="")
    print(f"numpy {np.__version__}, scipy {scipy.__version__}, one thread")
    print(f"{options.seconds:g} s, {len(POSITIONS)} channels, {RATE_HZ:g} Hz, int16\n")
    print("| form | CPU s per s of audio | x real time | ratio | largest difference |")
    print("|---|---|---|---|---|")
    baseline, truth = None, None
    for name, audio, action, repeats in forms:
        seconds, power = cpu_seconds(action, repeats)
        per_second = seconds / (len(audio) / RATE_HZ)
        baseline = baseline or per_second
        truth = power if truth is None else truth
        difference = np.abs(power - truth[: len(power)]).max() / truth.max()
        print(f"| {name} | {per_second:.5f} | {1.0 / per_second:.1f} ", end="")
        print(f"| {per_second / baseline:.2f} | {difference:.1e} |")
    mean = AudioScan(0, scan_bearings(CONFIG.bearings), truth.mean(axis=0))
    loudest = np.degrees(mean.peaks()[0][0])
    error = abs(loudest - SOURCES[0][0])
    print(f"\nstronger source at {loudest:.2f} deg, {error:.2f} deg off")
    sys.exit(0 if error < 0.3 else 1)


if __name__ == "__main__":
    main()
