import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from soundmap.memory import give_back, hold_little, sparse_zeros

STATUS = Path("/proc/self/statm")


def resident_bytes():
    return int(STATUS.read_text().split()[1]) * 4096


@pytest.mark.skipif(sys.platform != "linux", reason="reads what Linux tells of memory")
def test_what_is_freed_goes_back_although_something_stands_behind_it():
    hold_little()
    blocks = [bytes([1]) * 100_000 for _ in range(1000)]
    behind = bytes(50_000)
    full = resident_bytes()
    del blocks
    give_back()
    assert resident_bytes() < full - 80e6
    assert len(behind) == 50_000


@pytest.mark.skipif(sys.platform != "linux", reason="reads what Linux tells of memory")
def test_sparse_zeros_take_memory_only_where_something_is_written():
    before = resident_bytes()
    zeros = sparse_zeros(100_000, 250)
    zeros[::1000] = 1.0
    assert resident_bytes() < before + 5e6
    assert np.array_equal(np.flatnonzero(zeros[:, 249]), np.arange(0, 100_000, 1000))
    assert sparse_zeros(0, 250).shape == (0, 250)


LARGE = """
from soundmap.memory import hold_little
from tests.test_memory import resident_bytes

hold_little()
large = [bytes([1]) * 10**7 for _ in range(5)]
full = resident_bytes()
del large
print(full - resident_bytes())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads what Linux tells of memory")
def test_what_is_large_goes_back_by_itself():
    """In a process of its own: what others have freed would be filled first."""
    ran = subprocess.run([sys.executable, "-c", LARGE], capture_output=True, text=True, check=True)
    assert int(ran.stdout) > 40e6
