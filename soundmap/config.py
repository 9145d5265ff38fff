"""Configuration: one frozen table a stage, in SI units; load, check, merge, dump.

The defaults below are the shipped ``configs/default.toml`` (a test holds them together).
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from soundmap.errors import ConfigError
from soundmap.geometry import FloatArray

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
OnArray = Annotated[float, Field(ge=-10, le=10)]
OnRobot = Annotated[float, Field(ge=-100, le=100)]
Cell = Annotated[float, Field(ge=0.002, le=10)]
Vector3 = tuple[OnArray, OnArray, OnArray]
PlanarMount = tuple[OnRobot, OnRobot, OnRobot, OnRobot]

ON_ONE_LINE_M = 1e-3
"""Microphones that are nowhere farther than this from a line cannot tell its two sides apart."""


class Table(BaseModel):
    """One table of the configuration: nothing unknown in it, nothing changed once read."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ArrayConfig(Table):
    """The microphone array. Default: the paper's, 16 microphones on a circle of 31 cm (Sect. 3)."""

    frame: str | None = None
    """Frame whose mount is looked up in /tf_static; default: the audio's own frame, then
    "mic_array"."""
    mount: PlanarMount | None = None
    """x, y, z [m] and yaw [rad] in the base frame, instead of the looked-up one."""
    kind: Literal["circle"] | None = None
    """Equally spaced microphones, counter-clockwise. The default if no positions are given."""
    microphones: Annotated[int, Field(ge=1, le=1024)] | None = None
    """Microphones on the circle (16 if left out)."""
    radius_m: Annotated[float, Field(gt=0, le=10)] | None = None
    """Radius of the circle (0.155 if left out) [m]."""
    first_angle_rad: float | None = None
    """Bearing of the first microphone (0 if left out) [rad]."""
    positions_m: tuple[Vector3, ...] | None = None
    """One row a microphone in channel order, in the array's frame [m]."""
    pascal_per_count: Annotated[float, Field(ge=1e-12, le=1e6)] | None = None
    """Sound pressure of one unit of the recorded samples [Pa]; without it levels are relative."""

    @model_validator(mode="after")
    def _one_geometry(self) -> ArrayConfig:
        circle = (self.kind, self.microphones, self.radius_m, self.first_angle_rad)
        if self.positions_m is not None and any(value is not None for value in circle):
            raise ValueError("give positions_m or a circle (kind, microphones, ...), not both")
        if self.positions_m is not None and len(self.positions_m) < 3:
            raise ValueError("positions_m needs at least 3 microphones to tell bearings apart")
        if self.microphones is not None and self.microphones < 3:
            raise ValueError("a circle needs at least 3 microphones to tell bearings apart")
        if _off_line_m(self.microphone_positions()[:, :2]) < ON_ONE_LINE_M:
            raise ValueError(
                "the microphones stand on one line, or in one place, as seen from above: they "
                "cannot tell its two sides apart"
            )
        return self

    def microphone_positions(self) -> FloatArray:
        """Positions in the array's frame, shape (Q, 3) [m]."""
        if self.positions_m is not None:
            return np.array(self.positions_m, dtype=np.float64)
        count = self.microphones or 16
        radius = self.radius_m or 0.155
        angle = (self.first_angle_rad or 0.0) + 2.0 * np.pi * np.arange(count) / count
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)], axis=-1)


def _off_line_m(planar: FloatArray) -> float:
    """How far points, shape (Q, 2), are from the line that fits them best, at most [m]."""
    centred = planar - planar.mean(axis=0)
    normal = np.linalg.svd(centred, full_matrices=False)[2][-1]
    return float(np.abs(centred @ normal).max())


class TopicsConfig(Table):
    """Which topics to use. What is left out is found by the fields of its messages."""

    audio: str | None = None
    lasers: tuple[str, ...] | None = None
    odometry: str | None = None


class AudioConfig(Table):
    """How the audio topic is to be understood."""

    stamp: Literal["start", "end", "auto"] = "auto"
    """Whether a stamp is that of a block's first sample or of its end; "auto": by schema."""


class MappingConfig(Table):
    """Map building, Sect. 2.1."""

    key_distance_m: Annotated[float, Field(ge=0.01)] = 0.20
    """The map is made of key scans: one each time a scanner has moved this far [m] ..."""
    key_angle_rad: Annotated[float, Field(ge=0.01)] = math.radians(10.0)
    """... or turned this far [rad]."""
    returns: Annotated[int, Field(ge=50, le=100_000)] = 300
    """Returns kept of a key scan ..."""
    return_spacing_m: Positive = 0.05
    """... and their least distance from each other [m]."""
    neighbours: Annotated[int, Field(ge=4, le=1000)] = 14
    """Scans that each key scan is laid on."""
    loop_window_m: Positive = 6.0
    """Greatest drift within which a place seen before is searched for [m]."""
    cell_m: Cell = 0.05
    """Edge of a cell of the map [m]."""
    occupied_share: Annotated[float, Field(gt=0, le=1)] = 0.35
    """A cell is occupied if at least this share of the rays that reach it end in it."""
    noise_distance_per_metre: Positive = 0.10
    """Odometry is first taken to be off by this much of each metre [m/m] ..."""
    noise_turn_per_metre: Positive = 0.05
    """... to turn by this much a metre unawares [rad/m] ..."""
    noise_turn_per_turn: Positive = 0.10
    """... and by this much of each turn [rad/rad]; then its errors are estimated from the run."""


class LocalizeConfig(Table):
    """Robot localization, Sect. 2.2. Without smoothing, the particle filter's keys apply."""

    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of the random numbers: the same log gives the same trajectory."""
    particles: Annotated[int, Field(ge=1, le=1_000_000)] = 300
    """:math:`M`, particles."""
    beams: Annotated[int, Field(ge=1, le=100_000)] = 60
    """Rays used of each laser scan, spread evenly over its valid ones."""
    update_distance_m: NotNegative = 0.10
    """A laser scan is used once the robot has moved this far ..."""
    update_angle_rad: NotNegative = math.radians(4.0)
    """... or turned this far [rad] ..."""
    update_interval_s: Positive = 0.5
    """... or this much time has passed, whichever is first [s]."""
    noise_turn_per_turn: NotNegative = 0.10
    """alpha_1 of the odometry motion model: heading noise [rad] per rad turned."""
    noise_turn_per_metre: NotNegative = 0.05
    """alpha_2: heading noise [rad] per metre driven."""
    noise_distance_per_metre: NotNegative = 0.10
    """alpha_3: distance noise [m] per metre driven."""
    noise_distance_per_turn: NotNegative = 0.02
    """alpha_4: distance noise [m] per rad turned."""
    hit_sigma_m: Positive = 0.05
    """Standard deviation of a range that hit what the map shows [m]: scanner and map cell."""
    hit_weight: NotNegative = 0.80
    """Beam model: share of rays that hit what the map shows ..."""
    short_weight: NotNegative = 0.10
    """... that end earlier, at things not on the map ..."""
    random_weight: NotNegative = 0.10
    """... and that are anywhere."""
    short_decay_per_m: Positive = 1.0
    """Decay of the density of early ends with range [1/m]."""
    likelihood_exponent: Annotated[float, Field(gt=0, le=1)] = 0.15
    """Rays of a scan are not independent: their joint likelihood is raised to this power."""
    resample_share: Share = 0.5
    """Resample when the effective number of particles falls below this share."""
    smoothing: bool = True
    """Move all poses to where odometry and laser scans of the whole run fit best; without it the
    trajectory is the particle filter's, as in the paper."""
    refine_mounts: Literal["off", "report", "correct"] = "off"
    """With a map and smoothing: find how far the laser scanners sit from where the log says, by
    scans and odometry, and tell it ("report") or use it as well ("correct")."""
    max_spread_m: Positive = 0.20
    """The sound map is updated only while the particles stand within this spread [m] ..."""
    max_spread_rad: Positive = math.radians(5.0)
    """... and heading spread [rad] ..."""
    min_match: Share = 0.5
    """... and at least this share of rays ends where the map says."""


SUB_BAND_SHARES = (0.0, 0.2, 0.4, 0.7, 1.0)
"""Edges of the sub-bands as shares of the band."""


class ScanConfig(Table):
    """Audio scanning, Sect. 2.3."""

    window_s: Annotated[float, Field(gt=0, le=1)] = 0.025
    """Analysis window of the short-time Fourier transform [s]."""
    hop_s: Annotated[float, Field(ge=1e-4)] = 0.010
    """Shift of the window [s]."""
    frames: Annotated[int, Field(ge=1, le=10_000)] = 10
    """Windows averaged into one audio scan."""
    low_hz: Positive = 1000.0
    """Lower edge of the band [Hz]."""
    high_hz: Positive = 6000.0
    """Upper edge of the band [Hz]."""
    bearings: Annotated[int, Field(ge=8, le=3600)] = 120
    """:math:`N`, equally spaced bearings of a scan; 120 makes Table 1's 3 degrees."""
    speed_of_sound_m_s: Annotated[float, Field(ge=100, le=10_000)] = 343.0
    """Speed of sound [m/s]; 343 at 20 degrees Celsius."""

    @model_validator(mode="after")
    def _consistent(self) -> ScanConfig:
        if not self.low_hz < self.high_hz:
            raise ValueError("low_hz must be below high_hz")
        if not self.hop_s <= self.window_s:
            raise ValueError("hop_s must not exceed window_s, or sound falls between windows")
        return self

    @property
    def sub_band_hz(self) -> tuple[float, ...]:
        """Edges of the parts of the band whose power is told apart, the band's own included [Hz].

        Beams narrow as the frequency rises: each part has beams of about one width.
        """
        return tuple(
            self.low_hz + share * (self.high_hz - self.low_hz) for share in SUB_BAND_SHARES
        )


class CalibrateConfig(Table):
    """Error of the array's clock and yaw, from the run itself."""

    mode: Literal["correct", "report", "off"] = "correct"
    """"correct": estimate both and correct what is clear; "report": only tell; "off"."""


class FuseConfig(Table):
    """Emitted power and its accumulation, Sect. 2.4 and Table 1."""

    candidates: Literal["bearings", "peaks"] = "peaks"
    """Which bearings of a scan may be its strongest candidate. "bearings": all, as in the paper;
    "peaks": only local maxima over the bearings, interpolated between them. Eq. (3) otherwise
    favours the flank of a peak that points past the source at a farther wall."""
    cell_m: Cell = 0.05
    """Edge of a cell of the power map [m]."""
    alpha: NotNegative = 0.5
    """:math:`\\alpha` of Eq. (3): effect of the distance on the power."""
    d_min_m: Positive = 0.3
    """:math:`d_{min}`, least range used [m]."""
    d_max_m: Positive = 3.0
    """:math:`d_{max}`, greatest range used [m]."""

    @model_validator(mode="after")
    def _consistent(self) -> FuseConfig:
        if not self.d_min_m < self.d_max_m:
            raise ValueError("d_min_m must be below d_max_m")
        return self


class DetectConfig(Table):
    """Sources: of the power map, Sects. 2.4 and 4, or of a fit to all scans."""

    method: Literal["maxima", "sparse"] = "sparse"
    """"maxima": local maxima of the power map, as in the paper; "sparse": the few places whose
    sounds together explain all scans, with mirror images told from sources."""
    false_alarm_rate: Annotated[float, Field(gt=0, lt=1)] = 0.03
    """Share of runs in which "sparse" may report anything that is no source."""
    min_visit_share: Share = 0.10
    """A cell counts with more than this share of the greatest number of visits."""
    separation_m: Positive = 0.25
    """A local maximum is the greatest cell within this distance [m]."""


class DiffConfig(Table):
    """Difference of two runs: of their power maps, Sects. 4 and 5, and of their sources."""

    min_ratio_db: float = 3.0
    """A local maximum of the difference of the maps is reported above this [dB]."""
    min_change_db: NotNegative = 1.5
    """A source has changed when its level differs for sure by more than this [dB]: what directivity
    may do to an unchanged one between one way past it and another."""
    false_alarm_rate: Annotated[float, Field(gt=0, lt=1)] = 0.01
    """Share of pairs of unchanged runs in which any source may be said to have changed."""


class Config(Table):
    """The whole configuration, one table a stage."""

    array: ArrayConfig = ArrayConfig()
    topics: TopicsConfig = TopicsConfig()
    mounts: dict[str, PlanarMount] = Field(default_factory=dict)
    """x, y, z [m] and yaw [rad] in the base frame by frame name; wins over /tf_static."""
    audio: AudioConfig = AudioConfig()
    map: MappingConfig = MappingConfig()
    localize: LocalizeConfig = LocalizeConfig()
    scan: ScanConfig = ScanConfig()
    calibrate: CalibrateConfig = CalibrateConfig()
    fuse: FuseConfig = FuseConfig()
    detect: DetectConfig = DetectConfig()
    diff: DiffConfig = DiffConfig()


def loaded_config(paths: Iterable[Path]) -> Config:
    """Configuration from TOML files; a later file overrides an earlier one key by key.

    Raises
    ------
    ConfigError
        A file cannot be read, is not TOML, or holds unknown keys or impossible values. All
        faults are named at once, unknown keys with the nearest known one.
    """
    merged: dict[str, Any] = {}
    names = []
    for path in paths:
        names.append(str(path))
        table = _read_toml(path)
        if unknown := list(_unknown_keys(table, Config, ())):
            raise ConfigError("\n  ".join([f"{path}: {len(unknown)} unknown key(s)", *unknown]))
        merged = _merged(_without_replaced_geometry(merged, table), table)
    try:
        return Config.model_validate(merged)
    except ValidationError as error:
        raise ConfigError(_faults(error, " + ".join(names))) from None


def stored_config(path: Path) -> Config:
    """Configuration of a finished run; keys that this soundmap does not know are left out.

    Raises
    ------
    ConfigError
        The file cannot be read, is not TOML, or holds impossible values.
    """
    try:
        return Config.model_validate(_known(_read_toml(path), Config))
    except ValidationError as error:
        raise ConfigError(_faults(error, str(path))) from None


def config_toml(config: Config) -> str:
    """The configuration as TOML, valid as input; what is None is left out."""
    return tomli_w.dumps(config.model_dump(mode="json", exclude_none=True))


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}). Check --config.") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: not a text file. --config takes TOML files.") from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from None


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    result = dict(base)
    for key, value in over.items():
        earlier = result.get(key)
        if isinstance(earlier, dict) and isinstance(value, dict):
            result[key] = _merged(earlier, value)
        else:
            result[key] = value
    return result


def _without_replaced_geometry(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` less the array's geometry where ``over`` gives the other kind of geometry.

    Positions and a circle exclude each other in one file; in a later file either replaces both.
    """
    earlier, later = base.get("array"), over.get("array")
    if not (isinstance(earlier, dict) and isinstance(later, dict)):
        return dict(base)
    circle = {"kind", "microphones", "radius_m", "first_angle_rad"}
    replaced = (
        circle if "positions_m" in later else {"positions_m"} if circle & set(later) else set()
    )
    kept = {key: value for key, value in earlier.items() if key not in replaced}
    return {**base, "array": kept}


def _unknown_keys(
    table: Mapping[str, Any], model: type[BaseModel], where: tuple[str, ...]
) -> Iterator[str]:
    """One line for each unknown key, with the nearest known name."""
    for key, value in table.items():
        field = model.model_fields.get(key)
        if field is None:
            nearest = difflib.get_close_matches(key, model.model_fields, n=1, cutoff=0.5)
            hint = f"did you mean {nearest[0]!r}?" if nearest else "remove it."
            place = f"[{'.'.join(where)}] " if where else ""
            yield f"{place}{key!r}: {hint} Known here: {', '.join(model.model_fields)}."
            continue
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel) and isinstance(value, dict):
            yield from _unknown_keys(value, inner, (*where, key))


def _known(table: Mapping[str, Any], model: type[BaseModel]) -> dict[str, Any]:
    """The keys that a model knows, and of inner tables those that theirs do."""
    known = {}
    for key, value in table.items():
        field = model.model_fields.get(key)
        inner = None if field is None else field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel) and isinstance(value, dict):
            known[key] = _known(value, inner)
        elif field is not None:
            known[key] = value
    return known


def _faults(error: ValidationError, file: str) -> str:
    lines = [f"{file or 'configuration'}: {error.error_count()} wrong value(s)"]
    for fault in error.errors():
        place = ".".join(str(part) for part in fault["loc"]) or "configuration"
        message = fault["msg"].removeprefix("Value error, ")
        given = fault.get("input")
        shown = "" if isinstance(given, dict | BaseModel) else f" (given: {given!r})"
        lines.append(f"  {place}: {message}{shown}")
    return "\n".join(lines)
