"""Logs damaged at random: `tests/benchmarks/bench_faults.py` reads thousands of them."""

import fuzzing
import pytest


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    return fuzzing.Fuzzing(tmp_path_factory.mktemp("damaged"))


def test_whatever_is_done_to_a_log_it_is_read_and_nothing_goes_missing_in_silence(logs):
    assert [wrong for seed in range(54) for wrong in logs.complaints(seed)] == []
