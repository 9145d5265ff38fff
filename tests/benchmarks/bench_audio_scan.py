"""How fast audio scans are made, beside other programs and plain forms of the same sums.

    python tests/benchmarks/bench_audio_scan.py [--seconds 30] [--repeats 5]

30 s of 16 channels, 48 kHz, 16 bit, with two sources in noise; one thread. CPU seconds, best and
worst of the repeats, in which the forms take turns: steadier than the wall clock on a busy machine.
The program's form is timed from blocks of samples to audio scans, as the pipeline runs it; the
others get their samples whole.

pyroomacoustics' SRP gets the frames' spectra made by itself (its phase transform is always on).
Acoular's BeamformerBase is timed twice: from samples, with its own cross-spectra, as its manual
shows, and alone, on cross-spectra that are there already. Its frames have a power of two samples
and overlap by half, so they are about the same sound, not the same frames. Neither is a part of
the project: `pip install acoular` to have it measured. Slow forms are timed on a part.

The yardstick is the best that was had from ready-made parts: scipy's real transforms of bare frames
in single precision, the window as three taps on the bins, cross-spectra of baselines by a loop that
numba compiles, and a product of matrices for half of the bearings. It tells the band as a whole,
where the program tells four parts of it apart.

The last row is a limit: the arithmetic of the program's form at the speed of a large product of
single-precision matrices. Below the table stand the figures that the program is held to; what is in
brackets is the ratio of the worst to the best time and of the best to the worst. Two threads are
timed by the wall clock, which means something on an idle machine.
"""

from __future__ import annotations

import os

if __name__ == "__main__":  # read when numpy and numba are first imported
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
from dataclasses import dataclass, field

import numpy as np
import scipy.fft
from machine import machine
from numba import njit

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
BAND = band_bins(RATE_HZ, FRAMING.window, low_hz=CONFIG.low_hz, high_hz=CONFIG.high_hz)
TABLE = steering_table(
    POSITIONS,
    CONFIG.bearings,
    first_bin=BAND.first,
    frequency_hz=BAND.frequency_hz,
    weight=BAND.weight,
    speed_of_sound_m_s=CONFIG.speed_of_sound_m_s,
)
HALF = CONFIG.bearings // 2
COSINE, SINE = (
    np.ascontiguousarray(table[..., :HALF].transpose(2, 1, 0)).reshape(HALF, -1)
    for table in (TABLE.cosine, TABLE.sine)
)
OWN = "soundmap, blocks of 20 ms"
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


def fast(samples: np.ndarray, block: int, threads: int = 1) -> np.ndarray:
    """The package's form, from blocks of so many samples."""
    array = MicArray(POSITIONS, Mount.planar(0.0, 0.0, 0.0, 0.0), None)

    def blocks() -> Iterator[AudioBlock]:
        for start in range(0, len(samples), block):
            time_ns = round(start * 1e9 / RATE_HZ)
            yield AudioBlock(time_ns, RATE_HZ, samples[start : start + block], 32768.0, start > 0)

    scans = audio_scans(blocks(), array, CONFIG, threads=threads)
    return np.array([scan.power for scan in scans])


def per_frame(samples: np.ndarray) -> np.ndarray:
    """Plain numpy in double precision: each frame windowed, transformed, steered by an einsum."""
    steering = np.stack(
        [
            steering_vectors(POSITIONS, scan_bearings(CONFIG.bearings), f, speed_of_sound_m_s=343.0)
            for f in BAND.frequency_hz
        ]
    ).conj()
    window = np.hanning(FRAMING.window + 1)[:-1, None]
    scans = (len(samples) - FRAMING.span) // FRAMING.advance + 1
    power = np.zeros((scans, CONFIG.bearings))
    for scan in range(scans):
        for frame in range(FRAMING.frames):
            start = scan * FRAMING.advance + frame * FRAMING.hop
            excerpt = samples[start : start + FRAMING.window] / 32768.0
            spectrum = np.fft.rfft(window * excerpt, axis=0)[BAND.first : BAND.first + len(BAND)]
            focused = np.einsum("knq,kq->kn", steering, spectrum) / len(POSITIONS)
            power[scan] += BAND.weight @ np.abs(focused) ** 2
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


@njit(cache=True, nogil=True)
def apart(samples, channels):  # type: ignore[no-untyped-def]
    """Interleaved samples (T, Q) as channels (Q, T), a few at a time."""
    length, count = samples.shape
    for first in range(0, length, 64):
        for q in range(count):
            for t in range(first, min(first + 64, length)):
                channels[q, t] = np.float32(samples[t, q])


@njit(cache=True, nogil=True, fastmath=True)
def products(re, im, first, second, baseline, sums):  # type: ignore[no-untyped-def]
    """Sums (2, B, K) over pairs and frames of spectra (Q, F, K)."""
    sums[:] = 0.0
    for i in range(len(first)):
        m, n, line = first[i], second[i], baseline[i]
        for f in range(re.shape[1]):
            for k in range(re.shape[2]):
                sums[0, line, k] += re[m, f, k] * re[n, f, k] + im[m, f, k] * im[n, f, k]
                sums[1, line, k] += im[m, f, k] * re[n, f, k] - re[m, f, k] * im[n, f, k]


def yardstick(samples: np.ndarray) -> np.ndarray:
    """The form of ready-made parts, in batches of 32 scans."""
    lines, batch = TABLE.baselines, 32
    scans = (len(samples) - FRAMING.span) // FRAMING.advance + 1
    power = np.empty((scans, CONFIG.bearings), dtype=np.float32)
    channels = np.empty((len(POSITIONS), FRAMING.span), dtype=np.float32)
    frames = np.lib.stride_tricks.sliding_window_view(channels, FRAMING.window, axis=1)
    frames = frames[:, :: FRAMING.hop]
    sums = np.empty((batch, 2, len(lines), len(BAND)), dtype=np.float32)
    for start in range(0, scans, batch):
        count = min(batch, scans - start)
        for i in range(count):
            apart(samples[(start + i) * FRAMING.advance :][: FRAMING.span], channels)
            bare = scipy.fft.rfft(frames)[..., BAND.first - 1 : BAND.first + len(BAND) + 1]
            windowed = 0.5 * bare[..., 1:-1] - 0.25 * (bare[..., :-2] + bare[..., 2:])
            re, im = np.ascontiguousarray(windowed.real), np.ascontiguousarray(windowed.imag)
            products(re, im, lines.first, lines.second, lines.baseline, sums[i])
        even = sums[:count, 0].reshape(count, -1) @ COSINE.T
        odd = sums[:count, 1].reshape(count, -1) @ SINE.T
        power[start : start + count] = np.concatenate([even + odd, even - odd], axis=1)
    return power / (FRAMING.frames * hann_power(FRAMING.window) * len(POSITIONS) ** 2 * 32768.0**2)


def transforms_alone(samples: np.ndarray) -> np.ndarray:
    """Nothing but the real transforms of all frames, single precision, channel by channel."""
    channels = np.ascontiguousarray(samples[: FRAMING.span].T).astype(np.float32)
    frames = np.lib.stride_tricks.sliding_window_view(channels, FRAMING.window, axis=1)
    for _ in excerpts(samples):
        scipy.fft.rfft(frames[:, :: FRAMING.hop])
    return np.empty(0)


def excerpts(samples: np.ndarray) -> Iterator[np.ndarray]:
    """The samples of each scan."""
    for start in range(0, len(samples) - FRAMING.span + 1, FRAMING.advance):
        yield samples[start : start + FRAMING.span]


def pyroomacoustics_srp(samples: np.ndarray) -> np.ndarray:
    """Steered response power with phase transform, as pyroomacoustics has it."""
    import pyroomacoustics as pra

    bearing = scan_bearings(CONFIG.bearings)
    bins = np.arange(BAND.first, BAND.first + len(BAND))
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

    spectra = acoular.PowerSpectraImport()
    spectra.frequencies = BAND.frequency_hz
    beamformer = acoular.BeamformerBase(freq_data=spectra, steer=_acoular_steering(), cached=False)
    power = []
    for matrix in matrices:
        spectra.csm = matrix
        power.append(beamformer.result[:].sum(axis=0))
    return np.array(power)


def matrices_of(samples: np.ndarray) -> list[np.ndarray]:
    """Cross-spectral matrices of all scans, double precision."""
    return [
        np.ascontiguousarray(
            cross_spectral_matrix(band_spectrum(excerpt.T / 32768.0, FRAMING, BAND))
        )
        for excerpt in excerpts(samples)
    ]


def limit_s(scans: int) -> float:
    """CPU time of the form's arithmetic at the speed of a large matrix product."""
    q, length, frames = len(POSITIONS), FRAMING.window, FRAMING.frames
    transforms = 2.5 * length * np.log2(length) * q * frames
    window = 10.0 * len(BAND) * q * frames
    products = 8.0 * len(BAND) * len(TABLE.baselines.first) * frames
    steering = 2.0 * (COSINE.size + SINE.size)
    a, b = np.ones((2, 1024, 1024), dtype=np.float32)
    speed = 2.0 * 1024**3 / min(seconds_of(lambda: a @ b)[0] for _ in range(5))
    return float(scans * (transforms + window + products + steering) / speed)


def seconds_of(action: Callable[[], np.ndarray]) -> tuple[float, float, np.ndarray]:
    """CPU and wall time of a call, and what it returned."""
    cpu, wall = time.process_time(), time.perf_counter()
    result = action()
    return time.process_time() - cpu, time.perf_counter() - wall, result


def loudest_deg(power: np.ndarray) -> float:
    """Bearing of the highest peak of the mean over all scans."""
    scan = AudioScan(0, scan_bearings(CONFIG.bearings), power.mean(axis=0))
    return float(np.degrees(scan.peaks()[0][0]))


@dataclass
class Form:
    """A form, the audio it is timed on, and its times for each second of audio."""

    name: str
    audio: np.ndarray
    action: Callable[[], np.ndarray]
    repeats: int
    cpu_s: list[float] = field(default_factory=list)
    wall_s: list[float] = field(default_factory=list)
    power: np.ndarray = field(default_factory=lambda: np.empty(0))

    def run(self) -> None:
        """Take the time once more."""
        cpu, wall, self.power = seconds_of(self.action)
        seconds = len(self.audio) / RATE_HZ
        self.cpu_s.append(cpu / seconds)
        self.wall_s.append(wall / seconds)

    def row(self, own: Form) -> str:
        """Its line of the table."""
        best = min(self.cpu_s)
        spread = f" to {max(self.cpu_s):.5f}" if len(self.cpu_s) > 1 else ""
        found, off = "-", "-"
        if len(self.power):
            found = f"{loudest_deg(self.power):.2f}"
            if not self.name.startswith(("pyroom", "Acoular")):  # those have other units
                difference = np.abs(self.power - own.power[: len(self.power)]).max()
                off = f"{difference / own.power.max():.1e}"
        ratio = best / min(own.cpu_s)
        return (
            f"| {self.name} | {best:.5f}{spread} | {1 / best:.1f} | {ratio:.2f} | {found} | {off} |"
        )


def forms(samples: np.ndarray, repeats: int) -> list[Form]:
    """All forms, the program's first."""
    part = samples[: round(3.0 * RATE_HZ)]
    second = samples[: round(RATE_HZ)]
    few = min(repeats, 3)
    result = [
        Form(OWN, samples, lambda: fast(samples, 960), repeats),
        Form("soundmap, blocks of 1 s", samples, lambda: fast(samples, 48000), repeats),
        Form("soundmap, two threads", samples, lambda: fast(samples, 960, threads=2), repeats),
        Form("yardstick of ready-made parts", samples, lambda: yardstick(samples), repeats),
        Form("scipy's transforms alone", samples, lambda: transforms_alone(samples), repeats),
        Form("plain numpy, einsum a frame", samples, lambda: per_frame(samples), 1),
        Form("direct reference", second, lambda: direct(second), 1),
        Form("pyroomacoustics SRP", part, lambda: pyroomacoustics_srp(part), few),
    ]
    if importlib.util.find_spec("acoular"):
        matrices = matrices_of(part)
        acoular_alone(matrices[:2])  # compiles
        result += [
            Form("Acoular from samples", part, lambda: acoular_from_samples(part), few),
            Form("Acoular BeamformerBase alone", part, lambda: acoular_alone(matrices), few),
        ]
    return result


def verdict(measured: dict[str, Form], limit: float) -> list[str]:
    """What the program is held to, and what it reaches."""
    own = measured[OWN].cpu_s

    def against(name: str) -> str:
        other = measured[name].cpu_s
        low, high = min(other) / max(own), max(other) / min(own)
        return f"{min(other) / min(own):.1f} x ({low:.1f} to {high:.1f}) as fast as {name}"

    threads, one = measured["soundmap, two threads"].wall_s, measured[OWN].wall_s
    return [
        *(f"{against(name)}; held to 50" for name in measured if name.startswith("pyroom")),
        *(f"{against(name)}; held to 50" for name in measured if name.startswith("Acoular")),
        f"{against('yardstick of ready-made parts')}; held to 1 / 1.5",
        f"{min(own) / limit:.1f} x ({max(own) / limit:.1f}) the time of its arithmetic alone",
        f"two threads, wall clock: {1 / min(threads):.0f} x real time, "
        f"{min(one) / min(threads):.2f} x as fast as one",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    samples = recording(options.seconds)
    fast(samples[: round(4 * RATE_HZ)], 960)  # compiles
    yardstick(samples[: round(RATE_HZ)])
    measured = forms(samples, options.repeats)
    for turn in range(options.repeats):
        for form in measured:
            if turn < form.repeats:
                form.run()
    packages = ("numpy", "scipy", "numba", "pyroomacoustics", "acoular")
    print(f"{machine(*packages)}; one thread")
    print(f"{options.seconds:g} s, {len(POSITIONS)} channels, {RATE_HZ:g} Hz, int16\n")
    print("| form | CPU s per s of audio | x real time | ratio | loudest [deg] | difference |")
    print("|---|---|---|---|---|---|")
    own = measured[0]
    for form in measured:
        print(form.row(own))
    limit = limit_s(len(own.power)) / options.seconds
    share = limit / min(own.cpu_s)
    print(f"| limit by arithmetic | {limit:.5f} | {1 / limit:.0f} | {share:.2f} | - | - |\n")
    for line in verdict({form.name: form for form in measured}, limit):
        print(f"- {line}")
    sys.exit(0 if abs(loudest_deg(own.power) - SOURCES[0][0]) < 0.3 else 1)


if __name__ == "__main__":
    main()
