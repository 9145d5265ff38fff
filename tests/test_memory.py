import subprocess
import sys
from pathlib import Path

import pytest

from soundmap.memory import give_back, hold_little

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
