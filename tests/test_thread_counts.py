"""Results do not depend on how many threads share the work, not in one bit."""

from pathlib import Path

import numba
import pytest
from test_measured import same

from soundmap import replay
from soundmap.config import loaded_config
from soundmap.outputs.progress import chosen_progress
from soundmap.side_by_side import side_by_side

SAMPLES = Path(__file__).parents[1] / "sample_logs"


def run_with(threads, monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: threads)
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    config = loaded_config([SAMPLES / "robot.toml"])
    progress = chosen_progress(quiet=True)
    return replay.process(
        SAMPLES / "run1.mcap", SAMPLES / "map.yaml", config, cache=None, progress=progress
    )


@pytest.fixture
def all_threads_afterwards():
    yield
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)


@pytest.mark.usefixtures("all_threads_afterwards")
def test_a_run_is_the_same_by_one_thread_and_by_three(monkeypatch):
    alone, together = (run_with(threads, monkeypatch) for threads in (1, 3))
    assert len(alone.sources) == len(together.sources) > 0
    assert all(same(a, b) for a, b in zip(alone.sources, together.sources, strict=True))
    for part in ("room", "trajectory", "scans", "power_map", "offsets", "losses", "counts"):
        assert same(getattr(alone, part), getattr(together, part)), part


def test_results_come_in_the_order_of_the_items():
    assert side_by_side(lambda item: item**2, range(50)) == [item**2 for item in range(50)]


def test_a_failure_in_one_item_is_raised():
    with pytest.raises(ZeroDivisionError):
        side_by_side(lambda item: 1 // item, [2, 1, 0])


def test_work_may_share_out_work_of_its_own():
    """Even if all threads do at the same time."""

    def sums(count):
        return sum(side_by_side(lambda item: item + count, range(count)))

    assert side_by_side(sums, [10] * 20) == [145] * 20
