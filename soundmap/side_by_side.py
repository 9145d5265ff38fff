"""The same work on many items, by several threads at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numba

Item = TypeVar("Item")
Result = TypeVar("Result")


def side_by_side(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """The results of all items, in their order, whatever the number of threads.

    As many threads as compiled kernels may use (``NUMBA_NUM_THREADS``). It pays where the work is
    done by numpy on large arrays or by kernels that let go of the interpreter.

    Examples
    --------
    >>> side_by_side(abs, [-1, 2, -3])
    [1, 2, 3]
    """
    waiting = list(items)
    threads = min(numba.get_num_threads(), len(waiting))
    if threads < 2:
        return [work(item) for item in waiting]
    with ThreadPoolExecutor(threads, "side by side") as pool:
        return list(pool.map(work, waiting))
