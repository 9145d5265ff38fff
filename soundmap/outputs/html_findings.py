"""What was found, as tables and plots of the page: sources, mirror images, changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from soundmap.outputs.level_plot import Dot, level_plot
from soundmap.outputs.wording import (
    NOTHING,
    chance_text,
    flags_text,
    level_text,
    number_text,
    place_error_text,
    printed_reference,
    ratio_text,
)

Row = Mapping[str, Any]


def sources_table(report: Mapping[str, Any]) -> str:
    """Levels of the sources as a plot, and all that is known of them as a table."""
    rows = report["sources"]
    if not rows:
        return "<p>None.</p>"
    unit = printed_reference(report["level_reference"])
    columns = {
        "Source": [row["id"] for row in rows],
        "Level [dB]": [level_text(row) for row in rows],
        "x [m]": [number_text(row["x_m"], 3) for row in rows],
        "y [m]": [number_text(row["y_m"], 3) for row in rows],
        "95 % within [cm]": [place_error_text(row) for row in rows],
        "Visits": [str(row["visits"]) for row in rows],
        "Heard over [°]": [number_text(row.get("arc_deg"), 0) for row in rows],
        "By chance": [chance_text(row.get("false_alarm_probability")) for row in rows],
        "Remarks": [flags_text(row) or NOTHING for row in rows],
    }
    fitted = any(row.get("level_1m_db") is not None for row in rows)
    note = f"Levels are in {unit}" + (", at 1 m from the source." if fitted else ".")
    if fitted:
        note += (
            " 95 % within: half the axes of the ellipse that holds the place. By chance: "
            "probability that something else, such as the ghost of a louder source, would show "
            "as much."
        )
    dots = [
        Dot(row["id"], row["power_db"], row.get("level_sigma_db"), level_text(row)) for row in rows
    ]
    return level_plot(dots, unit) + _note(note) + _told(columns)


def reflections_table(report: Mapping[str, Any]) -> str:
    """Mirror images of sources, and whose they are."""
    rows = report["reflections"]
    note = "Sound that walls and machines throw back seems to come from behind them. These are no "
    columns = {
        "Image": [row["id"] for row in rows],
        "x [m]": [number_text(row["x_m"], 3) for row in rows],
        "y [m]": [number_text(row["y_m"], 3) for row in rows],
        "Level [dB]": [number_text(row["level_1m_db"], 1) for row in rows],
        "Of source": [row["source"] or NOTHING for row in rows],
    }
    return _note(f"{note}sources of their own.") + _told(columns)


def changes_table(report: Mapping[str, Any]) -> str:
    """What became of each place, as a plot and as a table."""
    rows = report["changes"]
    if not rows:
        return "<p>None.</p>"
    columns = {
        "Place": [row["id"] for row in rows],
        "Change": [row["kind"] for row in rows],
        "Louder by [dB]": [ratio_text(row) for row in rows],
        "x [m]": [number_text(row["x_m"], 3) for row in rows],
        "y [m]": [number_text(row["y_m"], 3) for row in rows],
        "By chance": [chance_text(row.get("false_alarm_probability")) for row in rows],
        report["run"]: [row.get("id_in_run") or NOTHING for row in rows],
        report["background"]: [row.get("id_in_background") or NOTHING for row in rows],
        "Visits": [str(row["visits"]) for row in rows],
    }
    note = _note(
        "Louder by: the run over the background, with its standard error; ≥ and ≤ where one of "
        "them was silent there. By chance: probability that two runs of an unchanged site would "
        "show as much anywhere."
    )
    dots = [
        Dot(row["id"], row["ratio_db"], row.get("ratio_sigma_db"), ratio_text(row)) for row in rows
    ]
    return level_plot(dots, "louder by [dB]", with_zero=True) + note + _told(columns)


def html_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table; columns of numbers are aligned to the right."""
    numeric = [all(_is_number(row[i]) for row in rows) for i in range(len(head))]
    marks = [' class="n"' if number else "" for number in numeric]
    titles = "".join(f"<th{m}>{escape(t)}</th>" for m, t in zip(marks, head, strict=True))
    lines = "".join(
        "<tr>"
        + "".join(f"<td{m}>{escape(c)}</td>" for m, c in zip(marks, row, strict=True))
        + "</tr>"
        for row in rows
    )
    return f'<div class="wide"><table><tr>{titles}</tr>{lines}</table></div>'


def _told(columns: Mapping[str, Sequence[str]]) -> str:
    """A table of the columns that tell of anything."""
    kept = {title: cells for title, cells in columns.items() if set(cells) != {NOTHING}}
    return html_table(list(kept), list(zip(*kept.values(), strict=True)))


def _note(text: str) -> str:
    return f"<p>{escape(text)}</p>"


def _is_number(text: str) -> bool:
    bare = text.translate(str.maketrans("", "", " ≥≤<±+-x.e"))
    return text == NOTHING or bare.isdigit()
