"""What was found, as the Markdown that stands beside a recording."""

from __future__ import annotations

from soundmap.outputs.report import change_rows, source_rows
from soundmap.outputs.stored_run import StoredDifference
from soundmap.outputs.wording import (
    chance_text,
    flags_text,
    level_text,
    printable,
    printed_reference,
    ratio_text,
)
from soundmap.run import Run


def run_markdown(run: Run) -> str:
    """What was found, in a few lines and a table."""
    unit = printed_reference(str(run.sources.reference))
    usable = f"{100 * run.trajectory.usable.mean():.1f} %" if len(run.trajectory) else "none"
    lines = [
        f"# {printable(run.log.name)}",
        "",
        f"{run.duration_s:.1f} s; {usable} of the poses trusted.",
        "",
    ]
    rows = source_rows(run.sources)
    remarks = " remarks |" if any(map(flags_text, rows)) else ""
    if rows:
        lines.append(f"| | x [m] | y [m] | level [{unit}] | visits |{remarks}")
        lines.append("|---|--:|--:|--:|--:|" + ("---|" if remarks else ""))
    else:
        lines.append("No source was found.")
    lines += [
        f"| {row['id']} | {row['x_m']:.2f} | {row['y_m']:.2f} | {level_text(row)} "
        f"| {row['visits']} |" + (f" {flags_text(row)} |" if remarks else "")
        for row in rows
    ]
    lines += ["", "**Lost or noted**", ""]
    lines += [f"- {loss.count} x {loss.what} ({loss.where}): {loss.effect}" for loss in run.losses]
    return "\n".join(lines if run.losses else [*lines, "Nothing."])


def difference_markdown(difference: StoredDifference) -> str:
    """What changed, in a table."""
    lines = [f"# {difference.title}", ""]
    rows = change_rows(difference.ratio.changes)
    if rows:
        head = "| | change | x [m] | y [m] | louder by [dB] | by chance |"
        lines += [head, "|---|---|--:|--:|--:|--:|"]
    else:
        lines.append("Nothing differs.")
    lines += [
        f"| {row['id']} | {row['kind']} | {row['x_m']:.2f} | {row['y_m']:.2f} "
        f"| {ratio_text(row)} | {chance_text(row['false_alarm_probability'])} |"
        for row in rows
    ]
    return "\n".join(lines)
