from __future__ import annotations

import weakref
from pathlib import Path

import numpy as np
import pytest
from plane_waves import (
    SPEED_OF_SOUND,
    START_NS,
    angle_between,
    as_int16,
    blocks_of,
    circle,
    corner,
    heard,
    mic_array,
    noise,
    scattered,
    sweeps,
)

from soundmap.config import ScanConfig
from soundmap.losses import LossLedger
from soundmap.scan.audio_scan import audio_scans
from soundmap.scan.response import steered_response_power_direct
from soundmap.scan.spectrum import Framing
from soundmap.sensors import AudioBlock
from soundmap.sound import AudioScan

RATE = 48000.0
PAPER = ScanConfig()


def scans_of(samples, positions, rate_hz=RATE, *, config=PAPER, full_scale=1.0, pascal=None):
    array = mic_array(positions, pascal)
    return list(audio_scans(blocks_of(samples, rate_hz, full_scale=full_scale), array, config))


def mean_power(scans):
    return np.mean([scan.power for scan in scans], axis=0)


def decibels_between(a, b):
    return 10.0 * np.log10(a / b)


@pytest.mark.parametrize("rate_hz", [16000.0, 44100.0, 48000.0])
@pytest.mark.parametrize("encoding", ["int16", "float32", "float64"])
@pytest.mark.parametrize("shape", ["circle", "corner", "scattered"])
def test_a_plane_wave_is_found_where_it_comes_from_and_as_loud_as_it_is(rate_hz, encoding, shape):
    rng = np.random.default_rng([int(rate_hz), *shape.encode(), *encoding.encode()])
    for microphones in rng.choice(np.arange(4, 25), 4, replace=False):
        positions = {
            "circle": lambda count: circle(count, 0.12, 0.3),
            "corner": lambda count: corner(count, 0.5 / count),
            "scattered": lambda count: scattered(count, rng),
        }[shape](int(microphones))
        bearing = rng.uniform(0.0, 2.0 * np.pi)
        rms = 0.05 if encoding != "int16" else 900.0
        wave = sweeps(rng, rate_hz, round(0.26 * rate_hz), rms)
        samples = heard(wave, bearing, positions, rate_hz)
        samples += rng.uniform(-10.0, 10.0, len(positions)) * rms  # the recorder's offsets
        samples = as_int16(samples) if encoding == "int16" else samples.astype(encoding)
        full_scale = 32768.0 if encoding == "int16" else 1.0
        scans = scans_of(samples, positions, rate_hz, full_scale=full_scale)
        assert len(scans) == 2
        for scan in scans:
            found, power = (values[0] for values in scan.peaks())
            assert np.degrees(angle_between(found, bearing)) < 0.3
            assert abs(decibels_between(power, (rms / full_scale) ** 2)) < 0.1


def test_power_on_a_bearing_of_the_scan_is_the_mean_square_of_its_plane_wave():
    rng = np.random.default_rng(2)
    positions = circle(16)
    for n in (0, 37, 60, 119):
        wave = sweeps(rng, RATE, 5760, 0.1)
        bearing = 2.0 * np.pi * n / 120
        (scan,) = scans_of(heard(wave, bearing, positions, RATE), positions)
        assert scan.bearing_rad[n] == pytest.approx(bearing)
        assert np.argmax(scan.power) == n
        assert abs(decibels_between(scan.power[n], 0.01)) < 0.02


def test_calibrated_power_refers_to_20_micropascal():
    rng = np.random.default_rng(3)
    positions = circle(8)
    pascal_per_count = 1e-4
    wave = sweeps(rng, RATE, 5760, 0.2 / pascal_per_count)  # 0.2 Pa is 80 dB
    samples = as_int16(heard(wave, 0.0, positions, RATE))
    (scan,) = scans_of(samples, positions, full_scale=32768.0, pascal=pascal_per_count)
    assert 10.0 * np.log10(scan.power[0]) == pytest.approx(80.0, abs=0.02)


def test_sound_outside_the_band_is_not_heard():
    positions = circle(16)
    seconds = np.arange(9600) / RATE
    hum = np.sin(2.0 * np.pi * 300.0 * seconds) + np.sin(2.0 * np.pi * 9000.0 * seconds)
    samples = heard(hum, 1.0, positions, RATE)
    assert max(scan.power.max() for scan in scans_of(samples, positions)) < 1e-8


def test_white_noise_has_the_power_of_the_band_at_any_rate():
    # One microphone: the beam is the signal. The band is 5 of rate / 2 kHz.
    for rate_hz in (16000.0, 44100.0, 48000.0):
        wave = noise(np.random.default_rng(4), rate_hz, round(4 * rate_hz), 1.0, 0.0, rate_hz)
        scans = scans_of(wave[:, None], [[0.0, 0.0]], rate_hz)
        expected = 5000.0 / (rate_hz / 2.0)
        assert abs(decibels_between(mean_power(scans)[0], expected)) < 0.1


def test_many_sources_agree_with_delaying_and_summing_in_the_time_domain():
    """Eqs. (1)-(2) by hand: advance each signal, average, keep the band, mean square."""
    rng = np.random.default_rng(5)
    positions = scattered(7, rng)
    length = round(4.0 * RATE)
    samples = sum(
        heard(noise(rng, RATE, length, rms, 200.0, 20000.0), bearing, positions, RATE)
        for rms, bearing in ((1.0, 0.7), (0.7, 2.9), (0.3, 5.0))
    )
    samples += 0.2 * rng.standard_normal(samples.shape)
    scans = scans_of(samples, positions)
    frequency = np.fft.rfftfreq(length, 1.0 / RATE)
    spectrum = np.fft.rfft(samples, axis=0) * ((frequency >= 1000) & (frequency <= 6000))[:, None]
    for n in range(0, 120, 10):
        toward = np.array([np.cos(2 * np.pi * n / 120), np.sin(2 * np.pi * n / 120)])
        lead_s = positions @ toward / SPEED_OF_SOUND
        aligned = spectrum * np.exp(-2j * np.pi * np.outer(frequency, lead_s))
        beam = np.fft.irfft(aligned.mean(axis=1), length)
        assert abs(decibels_between(mean_power(scans)[n], np.mean(beam**2))) < 0.1


@pytest.mark.parametrize(
    ("rate_hz", "config"),
    [
        (48000.0, ScanConfig()),
        (44100.0, ScanConfig(bearings=45)),
        (16000.0, ScanConfig(high_hz=8000.0, frames=3)),
        (11025.0, ScanConfig(low_hz=20.0, high_hz=5512.5, bearings=37)),
        (11000.0, ScanConfig(low_hz=990.0, high_hz=1010.0, window_s=0.0251)),
    ],
)
def test_the_fast_form_agrees_with_the_direct_sum(rate_hz, config):
    rng = np.random.default_rng([6, int(rate_hz)])
    for positions in (circle(16), np.round(circle(10), 6), corner(5), scattered(9, rng)):
        framing = Framing.from_times(
            rate_hz, window_s=config.window_s, hop_s=config.hop_s, frames=config.frames
        )
        wave = noise(rng, rate_hz, framing.span, 0.3, 0.0, rate_hz)
        samples = heard(wave, rng.uniform(0.0, 6.0), positions, rate_hz)
        samples += 0.1 * rng.standard_normal(samples.shape) + 0.5
        samples = samples.astype(np.float32)
        (scan,) = scans_of(samples, positions, rate_hz, config=config)
        direct = steered_response_power_direct(
            samples.T,
            mic_array(positions).positions_m,
            scan.bearing_rad,
            rate_hz=rate_hz,
            framing=framing,
            low_hz=config.low_hz,
            high_hz=config.high_hz,
            speed_of_sound_m_s=config.speed_of_sound_m_s,
        )
        assert np.abs(scan.power - direct).max() < 2e-5 * direct.max()


def sharp_scans(samples, positions):
    return list(audio_scans(blocks_of(samples, RATE), mic_array(positions), PAPER, sharp=True))


@pytest.mark.parametrize("slope_db_per_octave", [-12.0, 0.0, 12.0])
def test_the_sharp_scan_of_a_wave_is_the_same_whatever_its_spectrum(slope_db_per_octave):
    rng = np.random.default_rng(11)
    positions = circle(16)
    wave = noise(rng, RATE, round(0.46 * RATE), 1.0, 200.0, 20000.0)
    frequency = np.fft.rfftfreq(len(wave), 1.0 / RATE)
    colour = np.maximum(frequency / 1000.0, 0.1) ** (slope_db_per_octave / 6.02)
    coloured = np.fft.irfft(np.fft.rfft(wave) * colour, len(wave))
    for scan in sharp_scans(heard(coloured, 2.1, positions, RATE), positions):
        at = np.argmax(scan.sharp)
        assert scan.bearing_rad[at] == pytest.approx(2.1, abs=np.radians(1.6))
        assert scan.sharp[at] == pytest.approx(1.0, abs=0.02)
        # the lobe is that of equal bins weighted by frequency squared: -3 dB within 6 degrees
        assert scan.sharp[(at + 2) % 120] < 0.5


def test_the_sharp_scan_of_noise_that_no_two_microphones_share_is_one_over_their_number():
    rng = np.random.default_rng(12)
    scans = sharp_scans(rng.standard_normal((round(2.0 * RATE), 8)), circle(8))
    assert np.mean([scan.sharp for scan in scans]) == pytest.approx(1.0 / 8.0, rel=0.01)


def test_the_sharp_scan_of_silence_is_nought_and_none_is_made_unasked():
    assert all(not scan.sharp.any() for scan in sharp_scans(np.zeros((9600, 4)), circle(4)))
    assert scans_of(np.zeros((9600, 4)), circle(4))[0].sharp is None


def test_the_sharp_scan_changes_nothing_about_the_power():
    samples = np.random.default_rng(13).standard_normal((round(1.0 * RATE), 6))
    plain, sharp = scans_of(samples, circle(6)), sharp_scans(samples, circle(6))
    assert all(np.array_equal(a.power, b.power) for a, b in zip(plain, sharp, strict=True))


def test_turning_the_array_turns_the_scan():
    rng = np.random.default_rng(7)
    positions = scattered(6, rng)
    wave = noise(rng, RATE, 5760, 0.1)
    turn = 2.0 * np.pi * 17 / 120
    cos, sin = np.cos(turn), np.sin(turn)
    turned = positions @ np.array([[cos, sin], [-sin, cos]])
    (before,) = scans_of(heard(wave, 1.0, positions, RATE), positions)
    (after,) = scans_of(heard(wave, 1.0 + turn, turned, RATE), turned)
    assert np.allclose(after.power, np.roll(before.power, 17), rtol=1e-4, atol=0)


def test_raising_the_array_changes_nothing():
    rng = np.random.default_rng(8)
    positions = scattered(6, rng)
    samples = heard(noise(rng, RATE, 5760, 0.1), 1.0, positions, RATE)
    (flat,) = scans_of(samples, positions)
    (raised,) = scans_of(samples, np.column_stack([positions, np.full(6, 0.4)]))
    assert np.array_equal(flat.power, raised.power)


def test_twice_the_amplitude_is_6_decibels_more():
    rng = np.random.default_rng(9)
    positions = circle(8)
    samples = heard(noise(rng, RATE, 5760, 0.1), 1.0, positions, RATE)
    (once,), (twice,) = scans_of(samples, positions), scans_of(2.0 * samples, positions)
    assert np.allclose(twice.power, 4.0 * once.power, rtol=1e-5, atol=0)


def test_silence_is_zero_and_a_constant_is_silence():
    positions = circle(8)
    (silence,) = scans_of(np.zeros((9600, 8), dtype=np.int16), positions)
    assert silence.power.tolist() == [0.0] * 120
    (constant,) = scans_of(np.full((9600, 8), 12345, dtype=np.int16), positions)
    assert constant.power.max() < 1e-12  # count^2, where one step of the recorder has 0.1


def test_the_blocks_lengths_do_not_matter():
    rng = np.random.default_rng(10)
    positions = circle(4)
    samples = rng.integers(-3000, 3000, (62000, 4)).astype(np.int16)
    array = mic_array(positions)
    whole = list(audio_scans(blocks_of(samples, RATE, full_scale=32768.0), array, PAPER))
    assert len(whole) == 12
    for longest in (97, 480, 6000, 30000):
        lengths = [int(n) for n in rng.integers(0, longest, 4 * 62000 // longest)]
        parts = list(audio_scans(blocks_of(samples, RATE, [1, *lengths]), array, PAPER))
        for scan, part in zip(whole, parts, strict=True):
            assert abs(scan.time_ns - part.time_ns) <= 1  # block times are whole nanoseconds
            assert np.allclose(scan.power * 32768.0**2, part.power, rtol=1e-12, atol=0)


def test_scans_leave_in_batches_with_the_block_that_completes_one():
    samples = np.random.default_rng(11).standard_normal((336000, 3))
    read = []

    def counted():
        for block in blocks_of(samples, RATE, [480] * 699):
            read.append(len(block.samples))
            yield block

    complete = [sum(read) for _ in audio_scans(counted(), mic_array(circle(3)), PAPER)]
    # 31 scans of 4800 samples and one of 5520, in blocks of 480; and 5 scans with the last block.
    assert complete == [154560] * 32 + [308160] * 32 + [336000] * 5


def test_threads_change_nothing():
    rng = np.random.default_rng(16)
    array = mic_array(circle(5))
    first, second = rng.standard_normal((2, 400000, 5))
    second[[1000, 200000]] = np.nan

    def blocks():
        yield from blocks_of(first, RATE, [9600] * 41)
        yield from blocks_of(second, RATE, [9600] * 41, start_ns=START_NS + 10**10)

    ledgers = [LossLedger() for _ in range(3)]
    one, two, three = (
        list(audio_scans(blocks(), array, PAPER, threads=threads, losses=losses))
        for threads, losses in zip((1, 2, 3), ledgers, strict=True)
    )
    assert len(one) == 2 * 83 - 2
    for many in (two, three):
        assert [scan.time_ns for scan in many] == [scan.time_ns for scan in one]
        assert all(np.array_equal(a.power, b.power) for a, b in zip(many, one, strict=True))
    assert [loss.count for ledger in ledgers for loss in ledger] == [2, 2, 2]


def test_threads_never_run_far_behind_the_reading():
    samples = np.zeros((2_000_000, 3), dtype=np.int16)
    read = 0

    def counted():
        nonlocal read
        for block in blocks_of(samples, RATE, [9600] * 208):
            read += len(block.samples)
            yield block

    scans = audio_scans(counted(), mic_array(circle(3)), PAPER, threads=2)
    for number, _ in enumerate(scans):
        assert read - number * 4800 <= 5 * 32 * 4800
    assert number == 415


def test_an_error_of_the_reader_comes_through_the_threads():
    def blocks():
        yield from blocks_of(np.zeros((200000, 3)), RATE, [9600] * 20)
        raise OSError("the disk is gone")

    with pytest.raises(OSError, match="the disk is gone"):
        list(audio_scans(blocks(), mic_array(circle(3)), PAPER, threads=2))


def test_a_long_block_is_let_go_before_the_next_is_read():
    rng = np.random.default_rng(12)
    alive = []

    def blocks():
        for number in range(4):
            assert all(reference() is None for reference in alive)
            samples = rng.standard_normal((50000, 3)).astype(np.float32)
            alive.append(weakref.ref(samples))
            time_ns = START_NS + round(number * 50000 * 1e9 / RATE)
            block = AudioBlock(time_ns, RATE, samples, 1.0, continues=number > 0)
            del samples
            yield block
            del block

    assert len(list(audio_scans(blocks(), mic_array(circle(3)), PAPER))) == 41


@pytest.mark.parametrize("rate_hz", [11025.0, 16000.0, 44100.0, 48000.0])
def test_scans_are_taken_every_100_ms_at_the_middle_of_their_samples(rate_hz):
    config = ScanConfig(high_hz=5000.0)
    window, hop = round(0.025 * rate_hz), round(0.010 * rate_hz)
    samples = np.zeros((round(60 * rate_hz), 1), dtype=np.int16)
    scans = scans_of(samples, [[0.0, 0.0]], rate_hz, config=config)
    middle = (9 * hop + window - 1) / 2.0 + 10 * hop * np.arange(len(scans))
    expected = middle * 1e9 / rate_hz
    times = np.array([scan.time_ns - START_NS for scan in scans])
    assert np.abs(times - expected).max() <= 1.0
    assert times[0] == pytest.approx(57.5e6, abs=0.3e6)
    assert np.diff(times).mean() == pytest.approx(100e6, rel=3e-3)
    assert len(samples) - (len(scans) * 10 * hop + 9 * hop + window) < 0  # not one scan more


def test_a_click_in_the_middle_of_a_scan_is_in_the_middle_of_its_time():
    samples = np.zeros((5520, 1))
    samples[2760] = 1.0
    (scan,) = scans_of(samples, [[0.0, 0.0]])
    assert scan.power[0] > 0.0
    assert abs(scan.time_ns - (START_NS + 2760 * 1e9 / RATE)) < 0.5e9 / RATE + 1


def test_each_scan_takes_its_time_from_the_block_that_holds_its_middle():
    late_ns = [0, 40_000, -70_000, 20_000, 5_000]
    samples = np.zeros((24000, 1), dtype=np.int16)

    def blocks():
        for block, late in zip(blocks_of(samples, RATE, [4800] * 4), late_ns, strict=True):
            time_ns = block.time_ns + late
            yield AudioBlock(time_ns, RATE, block.samples, 1.0, block.continues)

    scans = audio_scans(blocks(), mic_array([[0.0, 0.0]]), PAPER)
    times = np.array([scan.time_ns - START_NS for scan in scans])
    middles = 2759.5 + 4800 * np.arange(4)
    assert np.abs(times - (middles * 1e9 / RATE + late_ns[:4])).max() <= 1.5


def two_parts(first, second, *, gap_ns, continues, rate_hz=(RATE, RATE), full_scale=(1.0, 1.0)):
    yield AudioBlock(START_NS, rate_hz[0], first, full_scale[0], continues=False)
    time_ns = START_NS + round(len(first) * 1e9 / rate_hz[0]) + gap_ns
    yield AudioBlock(time_ns, rate_hz[1], second, full_scale[1], continues)


def test_no_scan_reaches_across_a_gap():
    rng = np.random.default_rng(13)
    array = mic_array(circle(4))
    first, second = rng.standard_normal((12000, 4)), rng.standard_normal((12000, 4))
    apart = [
        *audio_scans(blocks_of(first, RATE), array, PAPER),
        *audio_scans(blocks_of(second, RATE, start_ns=START_NS + 250_000_000 + 7), array, PAPER),
    ]
    joined = list(audio_scans(two_parts(first, second, gap_ns=7, continues=False), array, PAPER))
    assert len(joined) == len(apart) == 4  # five if the gap were joined over
    assert [scan.time_ns for scan in joined] == [scan.time_ns for scan in apart]
    assert all(np.array_equal(a.power, b.power) for a, b in zip(joined, apart, strict=True))


def test_audio_that_never_lasts_as_long_as_a_scan_gives_none():
    samples = np.ones((5519, 2))
    parts = two_parts(samples, samples, gap_ns=10**9, continues=False)
    assert list(audio_scans(parts, mic_array([[0, 0], [0.1, 0]]), PAPER)) == []
    assert list(audio_scans([], mic_array([[0, 0], [0.1, 0]]), PAPER)) == []


def test_a_change_of_rate_or_full_scale_starts_anew():
    rng = np.random.default_rng(14)
    positions = circle(4)
    array = mic_array(positions)
    first = heard(sweeps(rng, RATE, 9600, 0.1), 2.0, positions, RATE)
    second = heard(sweeps(rng, 16000.0, 3200, 0.1), 2.0, positions, 16000.0)
    parts = two_parts(first, second, gap_ns=0, continues=True, rate_hz=(RATE, 16000.0))
    scans = list(audio_scans(parts, array, PAPER))
    assert [scan.time_ns - START_NS for scan in scans] == [57_489_583, 257_468_750]
    for scan in scans:
        found, power = (values[0] for values in scan.peaks())
        assert np.degrees(angle_between(found, 2.0)) < 0.3
        assert abs(decibels_between(power, 0.01)) < 0.1
    parts = two_parts(first, 8.0 * first, gap_ns=0, continues=True, full_scale=(1.0, 8.0))
    once, again = audio_scans(parts, array, PAPER)
    assert np.allclose(once.power, again.power, rtol=1e-5, atol=0)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])
def test_scans_with_samples_that_are_not_finite_are_left_out_and_counted(value):
    samples = np.random.default_rng(15).standard_normal((48000, 4))
    array = mic_array(circle(4))
    clean = list(audio_scans(blocks_of(samples, RATE), array, PAPER))
    samples[[5000, 30000], [1, 2]] = value
    losses = LossLedger()
    damaged = list(audio_scans(blocks_of(samples, RATE), array, PAPER, losses=losses))
    # Sample 5000 lies in the first scan and, scans overlapping, in the second; 30000 in one.
    kept = [scan for k, scan in enumerate(clean) if k not in (0, 1, 6)]
    assert [scan.time_ns for scan in damaged] == [scan.time_ns for scan in kept]
    assert all(np.array_equal(a.power, b.power) for a, b in zip(damaged, kept, strict=True))
    assert [(loss.count, loss.data_lost) for loss in losses] == [(3, True)]


def test_a_block_of_other_channels_than_the_array_has_is_refused():
    with pytest.raises(ValueError, match="3 channels, the array has 4 microphones"):
        scans_of(np.zeros((100, 3)), circle(4))


def test_a_band_above_half_the_rate_is_refused():
    with pytest.raises(ValueError, match="set high_hz to 4000 or less"):
        scans_of(np.zeros((100, 4)), circle(4), 8000.0)


RECORDINGS = Path(__file__).parents[3] / "shared" / "data" / "arrays" / "multi_ssl"


@pytest.mark.skipif(
    not RECORDINGS.is_dir(), reason="the Multi_SSL recordings are not beside the repository"
)
def test_a_talker_recorded_with_a_real_array_is_found_within_one_degree():
    soundfile = pytest.importorskip("soundfile")
    positions = 0.02285 * np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    files = sorted(RECORDINGS.glob("*/*.wav"))
    assert len(files) == 6
    for file in files:
        samples, rate_hz = soundfile.read(file, dtype="int16", always_2d=True)
        scans = scans_of(samples, positions, float(rate_hz), full_scale=32768.0)
        mean = AudioScan(0, scans[0].bearing_rad, mean_power(scans))
        assert np.degrees(angle_between(mean.peaks()[0][0], np.pi)) < 1.0, file


def test_the_sub_bands_add_up_to_the_band_and_tell_its_parts_apart():
    time_s = np.arange(round(0.3 * RATE)) / RATE
    tone = np.sin(2.0 * np.pi * 5500.0 * time_s)[:, None] * np.ones(16)
    scan = scans_of(tone.astype(np.float32), circle(16, 0.155))[0]
    np.testing.assert_allclose(scan.sub_bands.sum(axis=0), scan.power, rtol=1e-5)
    assert scan.sub_bands.max(axis=1).argmax() == 3
    assert scan.sub_bands[:3].max() < 1e-4 * scan.sub_bands[3].max()


def test_the_type_of_samples_may_change_within_a_stream():
    samples = np.random.default_rng(17).standard_normal((200000, 3)).astype(np.float32)
    array = mic_array(circle(3))
    whole = list(audio_scans(blocks_of(samples, RATE), array, PAPER))
    mixed = [
        AudioBlock(block.time_ns, RATE, block.samples.astype(kind), 1.0, block.continues)
        for block, kind in zip(
            blocks_of(samples, RATE, [90000]), ("float32", "float64"), strict=True
        )
    ]
    scans = list(audio_scans(mixed, array, PAPER))
    assert len(scans) == 41
    assert all(np.array_equal(a.power, b.power) for a, b in zip(scans, whole, strict=True))
