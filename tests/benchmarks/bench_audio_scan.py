"""How fast audio scans are made, beside other programs and plain forms of the same sums.

    python tests/benchmarks/bench_audio_scan.py [--seconds 30] [--repeats 5]

30 s of 16 channels, 48 kHz, 16 bit, with two sources in noise; one thread. CPU seconds, best and
worst of the repeats: steadier than the wall clock on a busy machine. The program's form is timed
from blocks of samples to audio scans, as the pipeline runs it; the others get their samples whole.

pyroomacoustics' SRP gets the frames' spectra made by itself (its phase transform is always on).
Acoular's BeamformerBase is timed twice: from samples, with its own cross-spectra, as its manual
shows, and alone, on cross-spectra that are there already. Its frames have a power of two samples
and overlap by half, so they are about the same sound, not the same frames. Neither is a part of
the project: `pip install acoular` to have it measured. Slow forms are timed on a part.

The last row is a limit: the arithmetic of the program's form at the speed of a large product of
single-precision matrices.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MKL_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_NUM_THREADS", "1")

import argparse
import importlib.util
import sys
import time
import warnings
from collections.abc import Callable, Iterator

import numpy as np
import scipy.fft
from machine import machine

from soundmap.config import ArrayConfig, ScanConfig
from soundmap.geometry import Mount
from soundmap.scan.audio_scan import audio_scans
from soundmap.scan.response import steered_response_power_direct
from soundmap.scan.spectrum import (
    Framing,
    band_bins,
    band_spectrum,
    cross_spectral_matrix,
    hann_power,
)
from soundmap.scan.steering import scan_bearings, steering_table, steering_vectors
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


def transforms_alone(samples: np.ndarray) -> np.ndarray:
    """Nothing but the real transforms of all frames, single precision, channel by channel."""
    channels = np.ascontiguousarray(samples.T).astype(np.float32)
    frames = np.lib.stride_tricks.sliding_window_view(channels, FRAMING.window, axis=1)
    for start in range(0, frames.shape[1], FRAMING.advance):
        scipy.fft.rfft(frames[:, start : start + FRAMING.advance : FRAMING.hop])
    return np.empty(0)


def excerpts(samples: np.ndarray) -> Iterator[np.ndarray]:
    """The samples of each scan."""
    for start in range(0, len(samples) - FRAMING.span + 1, FRAMING.advance):
        yield samples[start : start + FRAMING.span]


def pyroomacoustics_srp(samples: np.ndarray) -> np.ndarray:
    """Steered response power with phase transform, as pyroomacoustics has it."""
    import pyroomacoustics as pra

    bearing = scan_bearings(CONFIG.bearings)
    band = band_bins(RATE_HZ, FRAMING.window, low_hz=CONFIG.low_hz, high_hz=CONFIG.high_hz)
    bins = np.arange(band.first, band.first + len(band))
    srp = pra.doa.SRP(POSITIONS.T[:2], RATE_HZ, FRAMING.window, c=343.0, azimuth=bearing)
    window = np.hanning(FRAMING.window + 1)[:-1]
    power = []
    for excerpt in excerpts(samples):
        spectrum = pra.transform.stft.analysis(
            excerpt.astype(float), FRAMING.window, FRAMING.hop, win=window
        )
        srp.locate_sources(spectrum.transpose(2, 1, 0), freq_bins=bins)
        power.append(srp.grid.values.copy())
    return np.array(power)


def _acoular_steering():  # type: ignore[no-untyped-def]
    import acoular

    warnings.simplefilter("ignore")
    acoular.config.global_caching = "none"
    bearing = scan_bearings(CONFIG.bearings)
    far = 1e4 * np.array([np.cos(bearing), np.sin(bearing), np.zeros_like(bearing)])
    return acoular.SteeringVector(
        grid=acoular.ImportGrid(pos=far),
        mics=acoular.MicGeom(pos_total=POSITIONS.T.copy()),
        env=acoular.Environment(c=343.0),
    )


def acoular_from_samples(samples: np.ndarray) -> np.ndarray:
    """Acoular's own cross-spectra and BeamformerBase, one set of objects a scan."""
    import acoular

    steering, power = _acoular_steering(), []
    for excerpt in excerpts(samples):
        source = acoular.TimeSamples(data=excerpt / 32768.0, sample_freq=RATE_HZ)
        spectra = acoular.PowerSpectra(
            source=source, block_size=1024, window="Hanning", overlap="50%", cached=False
        )
        spectra.freq_range = (CONFIG.low_hz, CONFIG.high_hz)
        beamformer = acoular.BeamformerBase(freq_data=spectra, steer=steering, cached=False)
        power.append(beamformer.result[:].sum(axis=0))
    return np.array(power)


def acoular_alone(matrices: list[np.ndarray]) -> np.ndarray:
    """Acoular's BeamformerBase on cross-spectral matrices that are there."""
    import acoular

    band = band_bins(RATE_HZ, FRAMING.window, low_hz=CONFIG.low_hz, high_hz=CONFIG.high_hz)
    spectra = acoular.PowerSpectraImport()
    spectra.frequencies = band.frequency_hz
    beamformer = acoular.BeamformerBase(freq_data=spectra, steer=_acoular_steering(), cached=False)
    power = []
    for matrix in matrices:
        spectra.csm = matrix
        power.append(beamformer.result[:].sum(axis=0))
    return np.array(power)


def matrices_of(samples: np.ndarray) -> list[np.ndarray]:
    """Cross-spectral matrices of all scans, double precision."""
    band = band_bins(RATE_HZ, FRAMING.window, low_hz=CONFIG.low_hz, high_hz=CONFIG.high_hz)
    return [
        np.ascontiguousarray(
            cross_spectral_matrix(band_spectrum(excerpt.T / 32768.0, FRAMING, band))
        )
        for excerpt in excerpts(samples)
    ]


def limit_s(scans: int) -> float:
    """CPU time of the form's arithmetic at the speed of a large matrix product."""
    band = band_bins(RATE_HZ, FRAMING.window, low_hz=CONFIG.low_hz, high_hz=CONFIG.high_hz)
    table = steering_table(
        POSITIONS,
        CONFIG.bearings,
        first_bin=band.first,
        frequency_hz=band.frequency_hz,
        weight=band.weight,
        speed_of_sound_m_s=343.0,
    )
    q, length, frames = len(POSITIONS), FRAMING.window, FRAMING.frames
    transforms = 2.5 * length * np.log2(length) * q * frames
    window = 10.0 * len(band) * q * frames
    products = 8.0 * len(band) * len(table.baselines.first) * frames
    steering = 4.0 * table.groups[0].cosine.size
    a, b = np.ones((2, 1024, 1024), dtype=np.float32)
    speed = 2.0 * 1024**3 / cpu_seconds(lambda: a @ b, 5)[0]
    return float(scans * (transforms + window + products + steering) / speed)


def cpu_seconds(action: Callable[[], np.ndarray], repeats: int) -> tuple[float, float, np.ndarray]:
    """CPU time of the best and the worst of several calls, and what they returned."""
    times, result = [], np.empty(0)
    for _ in range(repeats):
        start = time.process_time()
        result = action()
        times.append(time.process_time() - start)
    return min(times), max(times), result


def loudest_deg(power: np.ndarray) -> float:
    """Bearing of the highest peak of the mean over all scans."""
    scan = AudioScan(0, scan_bearings(CONFIG.bearings), power.mean(axis=0))
    return float(np.degrees(scan.peaks()[0][0]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    samples = recording(options.seconds)
    fast(samples[: round(4 * RATE_HZ)], 960)  # compiles
    part = samples[: round(min(3.0, options.seconds) * RATE_HZ)]
    second = samples[: round(RATE_HZ)]
    once, few = 1, min(options.repeats, 3)
    forms = [
        ("soundmap, blocks of 20 ms", samples, lambda: fast(samples, 960), options.repeats),
        ("soundmap, blocks of 1 s", samples, lambda: fast(samples, 48000), options.repeats),
        ("scipy's transforms alone", samples, lambda: transforms_alone(samples), options.repeats),
        ("plain numpy, einsum a frame", samples, lambda: per_frame(samples), once),
        ("direct reference", second, lambda: direct(second), once),
        ("pyroomacoustics SRP", part, lambda: pyroomacoustics_srp(part), few),
    ]
    if importlib.util.find_spec("acoular"):
        matrices = matrices_of(part)
        acoular_alone(matrices[:2])  # compiles
        forms += [
            ("Acoular from samples", part, lambda: acoular_from_samples(part), few),
            ("Acoular BeamformerBase alone", part, lambda: acoular_alone(matrices), few),
        ]
    packages = ("numpy", "scipy", "numba", "pyroomacoustics", "acoular")
    print(f"{machine(*packages)}; one thread")
    print(f"{options.seconds:g} s, {len(POSITIONS)} channels, {RATE_HZ:g} Hz, int16\n")
    print("| form | CPU s per s of audio | x real time | ratio | loudest [deg] | difference |")
    print("|---|---|---|---|---|---|")
    baseline, truth, own_deg = 0.0, np.empty(0), 0.0
    for name, audio, action, repeats in forms:
        best, worst, power = cpu_seconds(action, repeats)
        seconds = len(audio) / RATE_HZ
        if not baseline:
            baseline, truth, own_deg = best / seconds, power, loudest_deg(power)
        spread = f" to {worst / seconds:.5f}" if repeats > 1 else ""
        found, off = ("-", "-")
        if len(power):
            found = f"{loudest_deg(power):.2f}"
            if not name.startswith(("pyroom", "Acoular")):  # those have other units
                off = f"{np.abs(power - truth[: len(power)]).max() / truth.max():.1e}"
        print(f"| {name} | {best / seconds:.5f}{spread} | {seconds / best:.1f} ", end="")
        print(f"| {best / seconds / baseline:.2f} | {found} | {off} |", flush=True)
    limit = limit_s(len(truth)) / options.seconds
    print(
        f"| limit by arithmetic | {limit:.5f} | {1 / limit:.0f} | {limit / baseline:.2f} | - | - |"
    )
    sys.exit(0 if abs(own_deg - SOURCES[0][0]) < 0.3 else 1)


if __name__ == "__main__":
    main()
