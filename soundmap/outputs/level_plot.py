"""The levels of the sources as dots on a scale, with error bars where an error is known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

SHOWN_ROWS = 20
WIDTH, ROW, LEFT, RIGHT = 600, 24, 46, 144
STEPS_DB = (0.5, 1, 2, 5, 10, 20, 50)


@dataclass(frozen=True)
class Dot:
    """One row of the plot.

    Attributes
    ----------
    name : str
    level_db : float or None
        Rows without a level are left out.
    error_db : float or None
        Its standard error, if known.
    written : str
        The level in words.
    """

    name: str
    level_db: float | None
    error_db: float | None
    written: str


def level_plot(dots: Sequence[Dot], unit: str, *, with_zero: bool = False) -> str:
    """An SVG drawing for a page, or nothing if no row has a level.

    Parameters
    ----------
    dots : sequence of Dot
        From top to bottom.
    unit : str
        What stands at the scale.
    with_zero : bool
        Whether the scale has to reach 0.
    """
    shown = [
        (dot, dot.level_db, dot.error_db or 0.0)
        for dot in dots[:SHOWN_ROWS]
        if dot.level_db is not None
    ]
    if not shown:
        return ""
    zero = [0.0] if with_zero else []
    low = min(zero + [level - off for _, level, off in shown])
    high = max(zero + [level + off for _, level, off in shown])
    step = next((step for step in STEPS_DB if high - low <= 6 * step), 100)
    first, last = math.floor(low / step), math.floor(high / step) + 1
    span = (last - first) * step

    def at(value: float) -> float:
        return LEFT + (value - first * step) / span * (WIDTH - LEFT - RIGHT)

    bottom = ROW * len(shown) + 6
    parts = [_tick(at(n * step), bottom, f"{n * step:g}") for n in range(first, last + 1)]
    for number, (dot, level, off) in enumerate(shown):
        y = ROW * number + ROW // 2 + 2
        parts.append(_text(LEFT - 8, y, dot.name, "end", bold=True))
        if off > 0:
            ends = f'x1="{at(level - off):.1f}" x2="{at(level + off):.1f}"'
            parts.append(f'<line {ends} y1="{y}" y2="{y}" stroke="#0072B2" stroke-width="2"/>')
        parts.append(f'<circle cx="{at(level):.1f}" cy="{y}" r="5" fill="#0072B2"/>')
        parts.append(_text(WIDTH - RIGHT + 12, y, f"{dot.written} dB", "start"))
    parts.append(_text((LEFT + WIDTH - RIGHT) / 2, bottom + 34, unit, "middle"))
    height = bottom + 46
    more = len(dots) - SHOWN_ROWS
    note = f"<p>and {more} more, in the table</p>" if more > 0 else ""
    title = f"<title>{escape(unit)}</title>"
    return (
        f'<svg viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}" role="img" '
        f'font-size="13" font-family="system-ui, sans-serif">{title}{"".join(parts)}</svg>{note}'
    )


def _tick(x: float, bottom: int, label: str) -> str:
    line = f'<line x1="{x:.1f}" x2="{x:.1f}" y1="2" y2="{bottom}" stroke="#ddd"/>'
    return line + _text(x, bottom + 12, label, "middle")


def _text(x: float, y: float, text: str, anchor: str, *, bold: bool = False) -> str:
    weight = ' font-weight="bold"' if bold else ""
    place = f'x="{x:.1f}" y="{y}" dy=".35em" text-anchor="{anchor}"'
    return f"<text {place}{weight}>{escape(text)}</text>"
