import wave
from pathlib import Path

import numpy as np
import pytest

from soundmap.errors import ConfigError
from soundmap.simulate.spectra import (
    a_weighting,
    band_level_db,
    level_dba,
    noise_spectrum,
    one_period,
    read_wav,
    with_level,
)

# IEC 61672-1, table of A-weightings at nominal third-octave frequencies [dB]
A_TABLE = {
    31.5: -39.4, 63: -26.2, 125: -16.1, 250: -8.6, 500: -3.2, 1000: 0.0,
    2000: 1.2, 4000: 1.0, 8000: -1.1, 16000: -6.6,
}  # fmt: skip


def test_the_a_weighting_is_that_of_the_standard() -> None:
    exact = [10 ** (round(10 * np.log10(nominal)) / 10) for nominal in A_TABLE]
    weighting = 20 * np.log10(a_weighting(exact))
    assert weighting == pytest.approx(list(A_TABLE.values()), abs=0.1)


@pytest.mark.parametrize("sound", ["air_conditioner", "fan", "server_rack", "pump", "leak"])
def test_a_sound_has_the_level_asked_for(sound: str) -> None:
    length, rate = 1 << 16, 48000.0
    spectrum = with_level(
        noise_spectrum(sound, length, rate, np.random.default_rng(2)), length, rate, 52.0
    )
    assert level_dba(spectrum, length, rate) == pytest.approx(52.0, abs=1e-9)
    signal = one_period(spectrum, length, 2)
    tones = np.abs(np.fft.rfft(signal[::2]))[1:] ** 2 * 2 / length**2
    frequency = np.arange(1, length // 2 + 1) * rate / length
    table = np.interp(np.log(frequency), np.log(list(A_TABLE)), list(A_TABLE.values()))
    measured = 10 * np.log10(np.sum(tones * 10 ** (table / 10)) / 20e-6**2)
    assert measured == pytest.approx(52.0, abs=0.3)


def test_the_level_in_a_band_of_white_noise_is_its_share_of_the_power() -> None:
    length, rate = 1 << 16, 48000.0
    spectrum = noise_spectrum("white", length, rate, np.random.default_rng(2))
    share = band_level_db(spectrum, length, rate, 1000.0, 6000.0) - band_level_db(
        spectrum, length, rate, 0.0, 24000.0
    )
    assert share == pytest.approx(10 * np.log10(5000 / 24000), abs=0.1)


@pytest.mark.parametrize("width", [1, 2, 3, 4])
def test_wav_files_of_every_width_are_read_to_scale(tmp_path: Path, width: int) -> None:
    signal = np.array([0.0, 0.5, -0.5, 0.25])
    whole = np.round(signal * 2 ** (8 * width - 1)).astype("<i4")
    data = (
        (whole + 128).astype(np.uint8).tobytes()
        if width == 1
        else b"".join(int(v).to_bytes(width, "little", signed=True) for v in whole)
    )
    with wave.open(str(tmp_path / "a.wav"), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(width)
        file.setframerate(8000)
        file.writeframes(data)
    values, rate = read_wav(tmp_path / "a.wav")
    assert rate == 8000.0
    assert values == pytest.approx(signal)


def test_a_file_that_is_no_wav_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "b.wav").write_text("no sound")
    with pytest.raises(ConfigError, match=r"b\.wav: not a PCM wav file"):
        read_wav(tmp_path / "b.wav")
