"""How many cores this process may use."""

from __future__ import annotations

import os

CORE_LIMIT = "NUMBA_NUM_THREADS"
"""Environment variable by which a user, or the process that started this one, limits them."""


def usable_cores() -> int:
    """Cores that the machine gives this process, or fewer if `CORE_LIMIT` says so."""
    given = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    limit = os.environ.get(CORE_LIMIT, "")
    return max(int(limit), 1) if limit.isdigit() else given or 1
