"""What a run had to leave out. Damaged data inside a good log is counted here, never hidden."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from soundmap.errors import SoundmapError


@dataclass(frozen=True)
class Loss:
    """One kind of damage in one place.

    Attributes
    ----------
    what : str
        The damage, as a person reads it: "odometry pose is NaN".
    where : str
        Topic, file or stage.
    count : int
        How often it happened.
    effect : str
        What was done about it: "motion taken from the twist".
    data_lost : bool
        False for a mere remark (nothing was dropped); ``--strict`` looks at this.
    first_s, last_s : float or None
        When it first and last happened, from the first message of the log [s]; None if that is not
        known.
    """

    what: str
    where: str
    count: int
    effect: str
    data_lost: bool
    first_s: float | None = None
    last_s: float | None = None


class LossLedger:
    """Counts losses of the same kind in the same place together, in order of first appearance."""

    def __init__(self) -> None:
        self._losses: dict[tuple[str, str], Loss] = {}
        self._span_ns: dict[tuple[str, str], tuple[int, int]] = {}
        self.start_ns = 0
        """Time of the first message of the log, once it is known [ns since epoch]."""

    def add(
        self, what: str, where: str, *, effect: str, count: int = 1, time_ns: ArrayLike = ()
    ) -> None:
        """Count data that was dropped, repaired or replaced, at these times if they are known."""
        self._count(what, where, count, effect, time_ns, data_lost=True)

    def remark(
        self, what: str, where: str, *, effect: str, count: int = 1, time_ns: ArrayLike = ()
    ) -> None:
        """Count something that the user should know although nothing was dropped."""
        self._count(what, where, count, effect, time_ns, data_lost=False)

    def _count(
        self,
        what: str,
        where: str,
        count: int,
        effect: str,
        time_ns: ArrayLike,
        *,
        data_lost: bool,
    ) -> None:
        if count <= 0:
            return
        key = (what, where)
        earlier = self._losses.get(key)
        total = count + (earlier.count if earlier else 0)
        self._losses[key] = Loss(what, where, total, effect, data_lost)
        times = np.asarray(time_ns, dtype=np.int64)
        if times.size:
            first, last = self._span_ns.get(key, (int(times.min()), int(times.max())))
            self._span_ns[key] = (min(first, int(times.min())), max(last, int(times.max())))

    def __iter__(self) -> Iterator[Loss]:
        for key, loss in self._losses.items():
            span = self._span_ns.get(key)
            if span is None:
                yield loss
            else:
                first, last = (round((time - self.start_ns) * 1e-9, 3) for time in span)
                yield replace(loss, first_s=first, last_s=last)

    def __len__(self) -> int:
        return len(self._losses)

    @contextmanager
    def told_with_errors(self) -> Iterator[None]:
        """Lets an error that ends the work also tell what was lost before it."""
        try:
            yield
        except SoundmapError as error:
            lost = [loss for loss in self if loss.data_lost]
            if lost:
                named = "; ".join(f"{loss.count} x {loss.what} ({loss.where})" for loss in lost[:3])
                error.args = (f"{error} Lost before that: {named}{'; more' * (len(lost) > 3)}.",)
            raise

    @property
    def data_lost(self) -> bool:
        """Whether anything counted is more than a remark."""
        return any(loss.data_lost for loss in self._losses.values())


def when(first_s: float | None, last_s: float | None) -> str:
    """Span of a loss, as a person reads it.

    Examples
    --------
    >>> when(4.25, 4.25), when(4.25, 19.0), when(None, None)
    ('at 4.2 s', '4.2 to 19.0 s', '')
    """
    if first_s is None or last_s is None:
        return ""
    return f"{first_s:.1f} to {last_s:.1f} s" if last_s - first_s >= 0.1 else f"at {first_s:.1f} s"
