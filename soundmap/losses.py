"""What a run had to leave out. Damaged data inside a good log is counted here, never hidden."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass


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
    """

    what: str
    where: str
    count: int
    effect: str
    data_lost: bool


class LossLedger:
    """Counts losses of the same kind in the same place together, in order of first appearance."""

    def __init__(self) -> None:
        self._losses: dict[tuple[str, str], Loss] = {}

    def add(self, what: str, where: str, *, effect: str, count: int = 1) -> None:
        """Count data that was dropped, repaired or replaced."""
        self._count(what, where, count, effect, data_lost=True)

    def remark(self, what: str, where: str, *, effect: str, count: int = 1) -> None:
        """Count something that the user should know although nothing was dropped."""
        self._count(what, where, count, effect, data_lost=False)

    def _count(self, what: str, where: str, count: int, effect: str, *, data_lost: bool) -> None:
        if count <= 0:
            return
        earlier = self._losses.get((what, where))
        total = count + (earlier.count if earlier else 0)
        self._losses[(what, where)] = Loss(what, where, total, effect, data_lost)

    def __iter__(self) -> Iterator[Loss]:
        return iter(self._losses.values())

    def __len__(self) -> int:
        return len(self._losses)

    @property
    def data_lost(self) -> bool:
        """Whether anything counted is more than a remark."""
        return any(loss.data_lost for loss in self)
