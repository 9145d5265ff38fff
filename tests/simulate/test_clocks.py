import numpy as np
import pytest

from soundmap.simulate.clocks import arrivals_ns, kept, measurement_times, stamps_ns
from soundmap.simulate.scene import Clock

START = 1_700_000_000_000_000_000


def test_a_fast_clock_measures_more_often() -> None:
    times = measurement_times(1000.0, 0.01, drift_ppm=100.0)
    assert len(times) == 100_010
    assert times[-1] <= 1000.0


def test_stamps_show_offset_and_jitter_and_never_run_backward() -> None:
    times = 0.01 * np.arange(20_000)
    clock = Clock(offset_s=0.035, jitter_s=0.001)
    stamps = stamps_ns(times, clock, START, np.random.default_rng(1))
    error = (stamps - START) * 1e-9 - times
    assert error.mean() == pytest.approx(0.035, abs=5e-5)
    assert error.std() == pytest.approx(0.001, rel=0.03)
    hasty = stamps_ns(times, Clock(jitter_s=0.1), START, np.random.default_rng(1))
    assert np.diff(hasty).min() >= 0


def test_messages_arrive_after_their_latency_in_order() -> None:
    times = 0.01 * np.arange(20_000)
    clock = Clock(latency_s=0.003, latency_jitter_s=0.001)
    arrivals = arrivals_ns(times, clock, START, np.random.default_rng(2))
    delay = (arrivals - START) * 1e-9 - times
    assert delay.min() == pytest.approx(0.003, abs=1e-5)
    assert delay.mean() == pytest.approx(0.004, rel=0.03)
    assert np.diff(arrivals).min() >= 0


def test_what_falls_into_a_gap_is_lost() -> None:
    clock = Clock.model_validate({"gaps": [{"start_s": 0.2, "duration_s": 0.3}]})
    assert kept(np.array([0.1, 0.2, 0.49, 0.5]), clock).tolist() == [True, False, False, True]
