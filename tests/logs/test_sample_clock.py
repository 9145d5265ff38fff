"""Sample times against a simulated recorder whose true times are known."""

import numpy as np
import pytest

from soundmap.logs.sample_clock import sample_clock

START_NS = 1_700_000_000_000_000_000


def recorder(
    *,
    blocks,
    frames,
    rate=48000.0,
    drift_ppm=80.0,
    jitter_s=2e-4,
    late_share=0.02,
    late_s=5e-3,
    gaps=(),
    seed=0,
    end=True,
):
    """True start times [s] and stamps [ns]; ``gaps`` are (block, seconds missing before it)."""
    rng = np.random.default_rng(seed)
    true_rate = rate * (1.0 + drift_ppm * 1e-6)
    start = np.arange(blocks) * frames / true_rate
    for block, missing in gaps:
        start[block:] += missing
    stamp = start + (frames / true_rate if end else 0.0)
    stamp = stamp + rng.normal(0.0, jitter_s, blocks)
    stamp += np.where(rng.random(blocks) < late_share, rng.exponential(late_s, blocks), 0.0)
    return start, START_NS + np.rint(stamp * 1e9).astype(np.int64)


def error_s(clock, start):
    return (clock.start_ns - START_NS) * 1e-9 - start


GAPS = ((700, 0.04), (2500, 0.5), (2507, 0.013))


@pytest.mark.parametrize("end", [True, False])
def test_drift_jitter_late_stamps_and_three_gaps_leave_times_within_a_fraction_of_a_millisecond(
    end,
):
    start, stamps = recorder(blocks=6000, frames=480, gaps=GAPS, end=end)
    clock = sample_clock(stamps, np.full(6000, 480), 48000.0, stamp_is_start=not end)
    error = error_s(clock, start)
    assert np.flatnonzero(~clock.continues).tolist() == [0, 700, 2500, 2507]
    assert np.max(np.abs(error)) < 1e-3
    assert np.sqrt(np.mean(error**2)) < 2e-4
    assert clock.gaps == 3
    assert clock.lost_s == pytest.approx(0.553, abs=2e-3)
    assert clock.kept.all()


@pytest.mark.parametrize(("frames", "blocks"), [(48000, 300), (240, 20000), (480, 360000)])
def test_long_and_short_blocks_and_an_hour_are_timed_alike(frames, blocks):
    gap = (blocks // 2, 0.2)
    start, stamps = recorder(blocks=blocks, frames=frames, gaps=[gap])
    clock = sample_clock(stamps, np.full(blocks, frames), 48000.0, stamp_is_start=False)
    error = error_s(clock, start)
    assert np.flatnonzero(~clock.continues).tolist() == [0, gap[0]]
    assert np.max(np.abs(error)) < 1e-3
    assert np.sqrt(np.mean(error**2)) < 2e-4
    assert clock.drift_ppm == pytest.approx(80.0, abs=5.0)
    assert clock.jitter_s == pytest.approx(2e-4, rel=0.2)


def test_a_drift_that_changes_with_temperature_is_followed():
    # From 0 to 60 ppm within ten minutes: 18 ms from the straight line at the end.
    true = np.arange(60000) * 0.01
    true += 60e-6 * true**2 / (2 * 600.0)
    rng = np.random.default_rng(1)
    stamps = START_NS + np.rint((true + rng.normal(0, 2e-4, 60000)) * 1e9).astype(np.int64)
    clock = sample_clock(stamps, np.full(60000, 480), 48000.0, stamp_is_start=True)
    assert np.max(np.abs(error_s(clock, true))) < 2e-4
    assert clock.gaps == 0


def test_a_recorder_that_stalls_and_catches_up_has_no_gap():
    start, stamps = recorder(blocks=3000, frames=480, jitter_s=1e-4, late_share=0.0, end=False)
    stall = np.arange(1000, 1040)
    stamps[stall] = stamps[1040] + np.arange(-40, 0) * 100_000
    clock = sample_clock(stamps, np.full(3000, 480), 48000.0, stamp_is_start=True)
    assert clock.gaps == 0
    assert clock.kept.all()
    assert np.max(np.abs(error_s(clock, start))) < 1e-3


def test_a_clock_that_is_set_forward_or_back_splits_the_stream_and_time_never_runs_back():
    _, stamps = recorder(blocks=3000, frames=480, late_share=0.0, end=False)
    stamps[1000:] += 700_000_000
    stamps[2000:] -= 300_000_000
    clock = sample_clock(stamps, np.full(3000, 480), 48000.0, stamp_is_start=True)
    begins = np.flatnonzero(clock.kept & ~clock.continues)
    assert begins[:2].tolist() == [0, 1000]
    # 0.3 s after the clock was set back is new time again; what lies before overlaps.
    assert np.count_nonzero(~clock.kept) == pytest.approx(30, abs=1)
    assert np.flatnonzero(~clock.kept)[0] == 2000
    assert np.all(np.diff(clock.start_ns[clock.kept]) > 0)


def test_repeated_blocks_are_dropped_and_do_not_shift_the_others():
    start, stamps = recorder(blocks=2000, frames=480, late_share=0.0)
    order = np.sort(np.concatenate([np.arange(2000), [500, 501, 1500]]))
    clock = sample_clock(stamps[order], np.full(2003, 480), 48000.0, stamp_is_start=False)
    assert np.count_nonzero(~clock.kept) == 3
    assert np.max(np.abs(error_s(clock, start[order])[clock.kept])) < 1e-3
    assert clock.gaps == 0


def test_the_recorders_own_count_shows_a_gap_smaller_than_the_jitter():
    _, stamps = recorder(blocks=1000, frames=480, jitter_s=3e-3, late_share=0.0, end=False)
    count = np.arange(1000) * 480
    count[600:] += 96  # 2 ms
    stamps[600:] += 2_000_000
    clock = sample_clock(
        stamps, np.full(1000, 480), 48000.0, stamp_is_start=True, first_frame=count
    )
    assert np.flatnonzero(~clock.continues).tolist() == [0, 600]
    assert clock.lost_s == pytest.approx(0.002, abs=1e-3)


def test_a_wrong_nominal_rate_is_overruled_by_the_stamps():
    start, stamps = recorder(blocks=2000, frames=480, rate=44100.0, drift_ppm=0.0)
    clock = sample_clock(stamps, np.full(2000, 480), 48000.0, stamp_is_start=False)
    assert clock.rate_hz == pytest.approx(44100.0, rel=1e-5)
    assert clock.gaps == 0
    assert np.max(np.abs(error_s(clock, start))) < 1e-3


@pytest.mark.parametrize("blocks", [1, 2, 3, 7])
def test_a_handful_of_blocks_is_timed_as_well(blocks):
    start, stamps = recorder(blocks=blocks, frames=480, late_share=0.0)
    clock = sample_clock(stamps, np.full(blocks, 480), 48000.0, stamp_is_start=False)
    assert np.max(np.abs(error_s(clock, start))) < 1e-3
    assert clock.gaps == 0


def test_no_blocks_or_uneven_lists_are_refused():
    with pytest.raises(ValueError, match="at least one block"):
        sample_clock([], [], 48000.0, stamp_is_start=True)
