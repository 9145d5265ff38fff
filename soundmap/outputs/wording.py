"""How numbers and findings are put into words, the same in the terminal, the page and the view."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Mapping
from typing import Any

import numpy as np

from soundmap.geometry import CHI_SQUARED_95, FloatArray
from soundmap.sensors import OffsetVerdict

NOTHING = "-"
UNKNOWN = str(OffsetVerdict.UNKNOWN)
LEAST_CHANCE = 1e-6
"""Probabilities below this say more about the model than about the world."""

Row = Mapping[str, Any]


def printable(text: str) -> str:
    r"""Text in which what no terminal or picture should be given stands as an escape.

    Names come from logs and file systems: they may hold codes that move the cursor, and bytes that
    are no letters.

    Examples
    --------
    >>> printable("/mics\x1b[2J, ünder Größe")
    '/mics\\x1b[2J, ünder Größe'
    """
    return "".join(
        char.encode("unicode_escape").decode()
        if unicodedata.category(char) in ("Cc", "Cf", "Cs") and char != "\n"
        else char
        for char in text
    )


def level_text(row: Row) -> str:
    """Level of a source with its standard error, if one is known [dB].

    Examples
    --------
    >>> level_text({"power_db": -82.67, "level_sigma_db": 0.31})
    '-82.7 ± 0.3'
    """
    return _with_error(row.get("power_db"), row.get("level_sigma_db"), "{:z.1f}")


def ratio_text(row: Row) -> str:
    """How much louder a place is, with its standard error [dB]; a bound if one run was silent.

    Examples
    --------
    >>> ratio_text({"ratio_db": 3.85, "ratio_sigma_db": 0.2, "kind": "louder"})
    '+3.9 ± 0.2'
    >>> ratio_text({"ratio_db": 36.2, "kind": "appeared", "false_alarm_probability": 1e-9})
    '≥ +36.2'
    """
    ratio, error = row.get("ratio_db"), row.get("ratio_sigma_db")
    one_is_silent = error is None and row.get("false_alarm_probability") is not None
    bound = {"appeared": "≥ ", "gone": "≤ "}.get(row.get("kind", ""), "") if one_is_silent else ""
    return bound + _with_error(ratio, error, "{:+z.1f}")


def chance_text(probability: float | None) -> str:
    """A probability of a false alarm.

    Examples
    --------
    >>> chance_text(0.0749), chance_text(2e-11), chance_text(None)
    ('0.075', '< 1e-06', '-')
    """
    if probability is None:
        return NOTHING
    if probability < LEAST_CHANCE:
        return f"< {LEAST_CHANCE:.0e}"
    return f"{probability:.2g}"


def flags_text(row: Row) -> str:
    """What a source is suspected of, in words."""
    return ", ".join(flag.replace("_", " ") for flag in (row.get("flags") or "").split())


def place_error_text(row: Row) -> str:
    """Half the axes of the ellipse that holds a source with 95 % [cm].

    Examples
    --------
    >>> place_error_text({"var_x_m2": 4e-4, "cov_xy_m2": 0.0, "var_y_m2": 1e-4})
    '5 x 2'
    """
    covariance = row_covariance(row)
    if covariance is None:
        return NOTHING
    small, large = np.sqrt(CHI_SQUARED_95 * np.maximum(np.linalg.eigvalsh(covariance), 0.0))
    return f"{100 * large:.0f} x {100 * small:.0f}"


def row_covariance(row: Row) -> FloatArray | None:
    """Covariance of x and y [m^2] of a row of sources.csv, if it has one."""
    if row.get("var_x_m2") is None:
        return None
    return np.array(
        [[row["var_x_m2"], row["cov_xy_m2"]], [row["cov_xy_m2"], row["var_y_m2"]]], dtype=np.float64
    )


def ellipse_95(covariance_m2: FloatArray, *, points: int = 41) -> FloatArray:
    """Closed line round what holds 95 % of a normal distribution about 0, shape (points, 2) [m]."""
    values, axes = np.linalg.eigh(covariance_m2)
    angle = np.linspace(0.0, 2.0 * math.pi, points)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    reach = np.sqrt(CHI_SQUARED_95 * np.maximum(values, 0.0))
    return np.asarray((circle * reach) @ axes.T, dtype=np.float64)


def printed_reference(reference: str) -> str:
    """A reference of levels as it is printed: with superscript and mu."""
    return reference.replace("^2", "²").replace("uPa", "µPa")


def number_text(value: float | None, decimals: int) -> str:
    """A number with so many decimals, or a dash."""
    return NOTHING if value is None else f"{value:.{decimals}f}"


def _with_error(value: float | None, error: float | None, form: str) -> str:
    if value is None:
        return NOTHING
    return form.format(value) + ("" if error is None else f" ± {error:.1f}")


def array_text(array: Mapping[str, Any] | None) -> str:
    """How far the array's clock and yaw were off, in a line; empty if nobody asked.

    Examples
    --------
    >>> array_text({"clock_offset_s": 0.0502, "clock_sigma_s": 0.0041, "clock_verdict": "corrected",
    ...             "yaw_offset_deg": 0.31, "yaw_sigma_deg": 0.4, "yaw_verdict": "taken as right",
    ...             "why": ""})
    'clock +50 ± 4 ms, corrected; yaw +0.3 ± 0.4 degrees, taken as right'
    """
    if array is None:
        return ""
    clock, yaw = array["clock_verdict"], array["yaw_verdict"]
    why = f": {array['why']}" if array["why"] else ""
    if clock == yaw == UNKNOWN:
        return f"clock and yaw {UNKNOWN}{why}"
    if clock != UNKNOWN:
        milliseconds = 1e3 * array["clock_offset_s"], 1e3 * array["clock_sigma_s"]
        clock = f"{milliseconds[0]:+z.0f} ± {milliseconds[1]:.0f} ms, {clock}"
    if yaw != UNKNOWN:
        yaw = f"{array['yaw_offset_deg']:+z.1f} ± {array['yaw_sigma_deg']:.1f} degrees, {yaw}"
    return f"clock {clock}; yaw {yaw}{why}"
