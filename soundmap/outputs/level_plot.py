"""The levels of the sources as dots on a scale, with error bars where an error is known."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

SHOWN_ROWS = 20
WIDTH, ROW, LEFT, RIGHT = 560, 24, 46, 90
STEPS_DB = (0.5, 1, 2, 5, 10, 20, 50)


def level_plot(rows: Sequence[Mapping[str, Any]], level: str, error: str, unit: str) -> str:
    """An SVG drawing for a page, or nothing if no row has a level.

    Parameters
    ----------
    rows : sequence of mapping
        Of ``sources.csv``, loudest first.
    level : str
        The column of the level [dB].
    error : str
        The column of its standard error [dB], which need not be there.
    unit : str
        What stands at the scale.
    """
    shown = [row for row in rows[:SHOWN_ROWS] if row.get(level) is not None]
    if not shown:
        return ""
    errors = [row.get(error) or 0.0 for row in shown]
    low = min(row[level] - off for row, off in zip(shown, errors, strict=True))
    high = max(row[level] + off for row, off in zip(shown, errors, strict=True))
    step = next((step for step in STEPS_DB if high - low <= 6 * step), 100)
    first, last = math.floor(low / step), math.floor(high / step) + 1
    span = (last - first) * step

    def at(value: float) -> float:
        return LEFT + (value - first * step) / span * (WIDTH - LEFT - RIGHT)

    bottom = ROW * len(shown) + 6
    parts = [_tick(at(n * step), bottom, f"{n * step:g}") for n in range(first, last + 1)]
    for number, (row, off) in enumerate(zip(shown, errors, strict=True)):
        y = ROW * number + ROW // 2 + 2
        parts.append(_text(LEFT - 8, y, str(row["id"]), "end", bold=True))
        if off > 0:
            ends = f'x1="{at(row[level] - off):.1f}" x2="{at(row[level] + off):.1f}"'
            parts.append(f'<line {ends} y1="{y}" y2="{y}" stroke="#0072B2" stroke-width="2"/>')
        parts.append(f'<circle cx="{at(row[level]):.1f}" cy="{y}" r="5" fill="#0072B2"/>')
        written = f"{row[level]:.1f} ± {off:.1f}" if off > 0 else f"{row[level]:.1f}"
        parts.append(_text(WIDTH - RIGHT + 12, y, f"{written} dB", "start"))
    parts.append(_text((LEFT + WIDTH - RIGHT) / 2, bottom + 34, unit, "middle"))
    height = bottom + 46
    more = len(rows) - len(shown)
    note = f"<p>and {more} more, in the table</p>" if more > 0 else ""
    title = f"<title>Level of each source [{escape(unit)}]</title>"
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
