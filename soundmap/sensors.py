"""What the robot's sensors deliver, as the stages see it: no topic, no encoding, no message."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soundmap.geometry import FloatArray, Mount

TILT_WARNING_RAD = np.radians(2.0)
"""A scanner tilted by more than this no longer measures horizontal distances."""


@dataclass(frozen=True)
class AudioBlock:
    """Consecutive samples of every microphone.

    Attributes
    ----------
    time_ns : int
        Time of the first sample [ns since epoch], from the robust fit of stamps to sample counts.
    rate_hz : float
        Nominal sample rate [Hz].
    samples : ndarray, shape (frames, channels)
        As recorded, in the recorder's integer or float type (native byte order).
    full_scale : float
        Value of ``samples`` at full scale: 32768 for 16 bit, 1 for floating point.
    continues : bool
        True if the first sample follows the last one of the block before without a gap.
    """

    time_ns: int
    rate_hz: float
    samples: NDArray[Any]
    full_scale: float
    continues: bool

    def __post_init__(self) -> None:
        if self.samples.ndim != 2:
            raise ValueError("an audio block is (frames, channels)")


@dataclass(frozen=True)
class LaserScan:
    """One sweep of one laser scanner.

    Attributes
    ----------
    time_ns : int
        Time of the first ray [ns since epoch].
    ray_interval_ns : float
        Time from one ray to the next [ns]; 0 if all are taken at once.
    bearing_rad : ndarray, shape (R,)
        Direction of each ray in the scanner's own frame [rad].
    range_m : ndarray, shape (R,)
        Distance to the surface [m]; NaN where there is no return.
    range_max_m : float
        Greatest distance that the scanner reports [m].
    mount : Mount
        Where the scanner sits on the robot.
    scanner : int
        Index of the scanner, 0-based, in the order of the topics used.
    """

    time_ns: int
    ray_interval_ns: float
    bearing_rad: FloatArray
    range_m: FloatArray
    range_max_m: float
    mount: Mount
    scanner: int

    def __post_init__(self) -> None:
        if self.bearing_rad.shape != self.range_m.shape or self.range_m.ndim != 1:
            raise ValueError("a laser scan needs one bearing a range")

    @property
    def ray_time_ns(self) -> NDArray[np.int64]:
        """Time of each ray [ns since epoch], shape (R,)."""
        offset = np.arange(len(self.range_m)) * self.ray_interval_ns
        return self.time_ns + np.rint(offset).astype(np.int64)

    @cached_property
    def middle_ns(self) -> int:
        """Time of the middle of the sweep [ns since epoch]."""
        return self.time_ns + round(0.5 * self.ray_interval_ns * max(len(self.range_m) - 1, 0))


@dataclass(frozen=True)
class MicArray:
    """A planar microphone array.

    Attributes
    ----------
    positions_m : ndarray, shape (Q, 3)
        Microphones in the array's own frame, in channel order [m].
    mount : Mount
        Where the array sits on the robot.
    pascal_per_count : float or None
        Sound pressure of one unit of the recorded samples [Pa]; None if uncalibrated.
    """

    positions_m: FloatArray
    mount: Mount
    pascal_per_count: float | None

    def __post_init__(self) -> None:
        if self.positions_m.ndim != 2 or self.positions_m.shape[1] != 3:
            raise ValueError("microphone positions are (Q, 3)")

    @property
    def microphones(self) -> int:
        """:math:`Q`, how many microphones there are."""
        return len(self.positions_m)


class OffsetVerdict(StrEnum):
    """What became of an offset that was estimated."""

    CORRECTED = "corrected"
    CLEAR = "off, not corrected"
    NOUGHT = "taken as right"
    UNKNOWN = "cannot be told"


@dataclass(frozen=True)
class Offset:
    """An offset of the array, as estimated from a run.

    Attributes
    ----------
    value : float
        To be added to what was believed; NaN if nothing is known.
    sigma : float
        Its standard deviation, in the same unit.
    verdict : OffsetVerdict
    """

    value: float
    sigma: float
    verdict: OffsetVerdict

    @property
    def correction(self) -> float:
        """What was added: the value, or nought if it was left as it is."""
        return self.value if self.verdict is OffsetVerdict.CORRECTED else 0.0


@dataclass(frozen=True)
class ArrayOffsets:
    """How far the array's clock and mount are off.

    Attributes
    ----------
    clock : Offset
        Of the audio's clock against that of lasers and odometry [s].
    yaw : Offset
        Of the array's direction, counter-clockwise seen from above [rad].
    explained : float
        Share of what was heard, by the information it holds, that comes from fixed places; on
        those stretches of the way where it is enough, if there are any.
    places : int
        Fixed places heard there, sources and mirror images, each counted once a stretch.
    why : str
        Why something cannot be told, in a sentence's part; empty if both can.
    guess : tuple of float, or None
        Clock [s] and yaw [rad] that fit best where too little was explained to tell them.
    """

    clock: Offset
    yaw: Offset
    explained: float
    places: int
    why: str = ""
    guess: tuple[float, float] | None = None
