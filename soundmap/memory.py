"""Free memory goes back to the system soon; the C library would keep most of it for later.

Its own limits rise with what is freed, up to 64 MB that a run only seems to need, and while many
things grow side by side for an hour, it keeps the holes that they leave behind.
"""

from __future__ import annotations

import ctypes
import gc
import mmap
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

OWN_PAGES_BYTES = 4 * 2**20
"""What is larger gets pages of its own, which grow without a copy and go when it goes."""
MOST_FREE_BYTES = 16 * 2**20
"""Free memory that is kept at the end of the heap."""

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
_OTHER_LIBRARY = (AttributeError, OSError, TypeError)


def hold_little() -> None:
    """Keep little of what is freed, from now on."""
    with suppress(*_OTHER_LIBRARY):
        library = ctypes.CDLL(None)
        library.mallopt(_M_MMAP_THRESHOLD, OWN_PAGES_BYTES)
        library.mallopt(_M_TRIM_THRESHOLD, MOST_FREE_BYTES)


def give_back(*, with_cycles: bool = False) -> None:
    """Let the system have all that is free; with objects that only hold one another, if wanted."""
    if with_cycles:
        gc.collect()
    with suppress(*_OTHER_LIBRARY):
        ctypes.CDLL(None).malloc_trim(0)


def sparse_zeros(rows: int, columns: int) -> NDArray[np.float32]:
    """Zeros that take memory only where something is written, shape (rows, columns).

    Of an array of its own numpy would have the system make huge pages: one row takes 2 MB there.
    """
    numbers = rows * columns
    pages = mmap.mmap(-1, 4 * max(numbers, 1))
    return np.frombuffer(pages, dtype=np.float32, count=numbers).reshape(rows, columns)
