"""The same work on many items, by several threads at a time."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

import numba

Item = TypeVar("Item")
Result = TypeVar("Result")
_here = threading.local()


def side_by_side(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """The results of all items, in their order, whatever the number of threads.

    As many threads as compiled kernels may use (``NUMBA_NUM_THREADS``). It pays where the work is
    done by numpy on large arrays or by kernels that let go of the interpreter. Work that calls this
    in its turn does its own items one after the other.

    Examples
    --------
    >>> side_by_side(abs, [-1, 2, -3])
    [1, 2, 3]
    """
    waiting = list(items)
    threads = min(numba.get_num_threads(), len(waiting))
    if threads < 2 or getattr(_here, "is_helper", False):
        return [work(item) for item in waiting]
    return list(_helpers(numba.get_num_threads()).map(work, waiting))


@cache
def _helpers(threads: int) -> ThreadPoolExecutor:
    """Threads that wait for work: starting them takes longer than much of it."""
    return ThreadPoolExecutor(threads, "side by side", _become_helper)


def _become_helper() -> None:
    _here.is_helper = True
