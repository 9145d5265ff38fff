"""Spectra: what machines sound like, and how loud that is.

Every sound is one period of a stationary signal, drawn in the frequency domain. Its level is
therefore exact, and so are denser samplings of it.
"""

from __future__ import annotations

import wave
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from soundmap.errors import ConfigError
from soundmap.geometry import FloatArray
from soundmap.simulate.propagation import FloatTable

ComplexArray = NDArray[np.complex128]
REFERENCE_PA = 20e-6
"""Sound pressure of 0 dB."""

# Power density [dB] at frequencies [Hz], straight lines on a logarithmic axis between, and tones
# (frequency [Hz], level over the density at 1 kHz in a 100 Hz band [dB]). Shapes are plausible
# for the machine named, not measured.
_DENSITY_DB: dict[str, list[tuple[float, float]]] = {
    "air_conditioner": [(20, 4), (100, 8), (300, 6), (1000, 0), (4000, -11), (16000, -30)],
    "fan": [(20, -6), (150, 4), (500, 4), (1000, 0), (3000, -6), (8000, -16), (20000, -34)],
    "server_rack": [(20, -12), (200, -2), (600, 1), (2000, 0), (6000, -6), (20000, -25)],
    "pump": [(20, 6), (60, 12), (250, 8), (1000, 0), (3000, -8), (20000, -32)],
    "leak": [(20, -30), (500, -10), (1000, 0), (4000, 10), (9000, 12), (20000, 2)],
    "transformer": [(20, 0), (1000, 0), (3000, -6), (20000, -30)],
    "speech_like": [(20, -30), (100, -6), (250, 8), (500, 9), (1000, 0), (4000, -14), (2e4, -40)],
    "ambient": [(20, 22), (60, 20), (250, 9), (1000, 0), (4000, -11), (20000, -32)],
    "drive": [(20, 8), (100, 14), (400, 8), (1000, 0), (2500, -9), (20000, -40)],
    "white": [(1, 0), (24000, 0)],
}
_TONES: dict[str, list[tuple[float, float]]] = {
    "air_conditioner": [(98.0, 14), (196.0, 8), (294.0, 4)],
    "fan": [(420.0, 8), (840.0, 6), (1260.0, 2)],
    "server_rack": [(1180.0, 6), (2360.0, 3), (3540.0, 0)],
    "pump": [(49.3, 14), (98.6, 12), (345.0, 8), (1035.0, 5)],
    "transformer": [(100.0, 25), (200.0, 18), (300.0, 15), (400.0, 10), (1200.0, 4)],
    "drive": [(310.0, 12), (620.0, 6)],
}


def a_weighting(frequency_hz: ArrayLike) -> FloatArray:
    """Amplitude weighting A of IEC 61672-1, 1 at 1 kHz, any shape.

    Examples
    --------
    >>> (20.0 * np.log10(a_weighting([100.0, 1000.0, 8000.0]))).round(1).tolist()
    [-19.1, 0.0, -1.1]
    """
    square = np.asarray(frequency_hz, dtype=np.float64) ** 2
    weight = 12194.0**2 * square**2
    weight = weight / ((square + 20.6**2) * (square + 12194.0**2))
    weight = weight / np.sqrt((square + 107.7**2) * (square + 737.9**2))
    return np.asarray(weight * 10.0 ** (2.0 / 20.0))


def machine_density(sound: str, frequency_hz: FloatArray) -> FloatArray:
    """Power density of a built-in sound at each frequency [arbitrary unit], >= 0."""
    points = np.array(_DENSITY_DB[sound])
    safe = np.maximum(frequency_hz, 1.0)
    level = np.interp(np.log(safe), np.log(points[:, 0]), points[:, 1])
    density = 10.0 ** (level / 10.0)
    for tone, tone_db in _TONES.get(sound, []):
        line = np.exp(-0.5 * ((frequency_hz - tone) / 0.7) ** 2) / (0.7 * np.sqrt(2.0 * np.pi))
        density = density + 100.0 * 10.0 ** (tone_db / 10.0) * line
    return np.asarray(np.where(frequency_hz < 15.0, 0.0, density))


def noise_spectrum(
    sound: str, length: int, rate_hz: float, rng: np.random.Generator
) -> ComplexArray:
    """Half spectrum of one period of a built-in sound, shape (length // 2 + 1,)."""
    frequency = np.asarray(np.fft.rfftfreq(length, 1.0 / rate_hz), dtype=np.float64)
    amplitude = np.sqrt(machine_density(sound, frequency))
    random = rng.standard_normal((2, len(frequency)))
    spectrum = amplitude * (random[0] + 1j * random[1])
    spectrum[-1] = 0.0
    if sound == "speech_like":
        from scipy import fft

        time = np.arange(length) / rate_hz
        syllables = np.maximum(0.05, np.sin(2.0 * np.pi * 2.0 * time) ** 2)
        spectrum = fft.rfft(fft.irfft(spectrum, length) * syllables)
    return np.asarray(spectrum, dtype=np.complex128)


def wav_spectrum(path: Path, length: int, rate_hz: float) -> ComplexArray:
    """Half spectrum of a PCM wav file (mean of its channels), cut or repeated to ``length``.

    Raises
    ------
    ConfigError
        The file cannot be read as PCM of 8 to 32 bit.
    """
    from scipy import fft

    signal, rate = read_wav(path)
    wanted = max(round(len(signal) * rate_hz / rate), 1)
    if wanted != len(signal):
        spectrum = fft.rfft(signal)
        signal = fft.irfft(spectrum, wanted) * (wanted / len(signal))
    return np.asarray(fft.rfft(np.resize(signal, length)), dtype=np.complex128)


def read_wav(path: Path) -> tuple[FloatArray, float]:
    """Samples of a PCM wav file, mean of its channels, full scale 1, and its rate [Hz]."""
    try:
        with wave.open(str(path), "rb") as file:
            width, channels, rate = file.getsampwidth(), file.getnchannels(), file.getframerate()
            data = file.readframes(file.getnframes())
    except (OSError, EOFError, wave.Error) as error:
        raise ConfigError(f"{path}: not a PCM wav file ({error}).") from None
    if width == 1:
        values = np.frombuffer(data, dtype=np.uint8).astype(np.float64) - 128.0
    else:
        padded = np.zeros((len(data) // width, 4), dtype=np.uint8)
        padded[:, 4 - width :] = np.frombuffer(data, dtype=np.uint8).reshape(-1, width)
        values = padded.view("<i4")[:, 0].astype(np.float64) / 2.0 ** (32 - 8 * width)
    signal = values.reshape(-1, channels).mean(axis=1) / 2.0 ** (8 * width - 1)
    if not len(signal) or not np.any(signal):
        raise ConfigError(f"{path}: holds no sound.")
    return signal, float(rate)


def mean_square(spectrum: ComplexArray, length: int, weight: FloatArray | None = None) -> float:
    """Mean square of the signal with a half spectrum, each frequency weighted in amplitude."""
    power = np.abs(spectrum) ** 2
    if weight is not None:
        power = power * weight**2
    return float(2.0 * np.sum(power[1:])) / float(length) ** 2


def level_dba(spectrum: ComplexArray, length: int, rate_hz: float) -> float:
    """A-weighted level of a signal in pascal, given its half spectrum [dB re 20 uPa]."""
    weight = a_weighting(np.fft.rfftfreq(length, 1.0 / rate_hz))
    return float(10.0 * np.log10(mean_square(spectrum, length, weight) / REFERENCE_PA**2))


def band_level_db(
    spectrum: ComplexArray, length: int, rate_hz: float, low_hz: float, high_hz: float
) -> float:
    """Level within a band of a signal in pascal, given its half spectrum [dB re 20 uPa]."""
    frequency = np.fft.rfftfreq(length, 1.0 / rate_hz)
    inside = ((frequency >= low_hz) & (frequency <= high_hz)).astype(np.float64)
    return float(10.0 * np.log10(mean_square(spectrum, length, inside) / REFERENCE_PA**2))


def with_level(spectrum: ComplexArray, length: int, rate_hz: float, dba: float) -> ComplexArray:
    """A half spectrum scaled so that its signal has an A-weighted level [dB re 20 uPa]."""
    return spectrum * 10.0 ** ((dba - level_dba(spectrum, length, rate_hz)) / 20.0)


def one_period(spectrum: ComplexArray, length: int, oversampling: int = 1) -> FloatTable:
    """One period of the signal with a half spectrum, shape (length * oversampling,)."""
    from scipy import fft

    dense = length * oversampling
    padded = np.zeros(dense // 2 + 1, dtype=np.complex64)
    padded[: len(spectrum)] = spectrum
    return np.asarray(fft.irfft(padded, dense) * np.float32(oversampling), dtype=np.float32)
