"""``report.html``: one page that tells a run, or a difference of two, to whoever opens it.

The page holds everything itself: pictures, style, no script. It needs no network and asks for none.
"""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

import tomli_w

from soundmap.losses import when
from soundmap.outputs.html_findings import (
    changes_table,
    html_table,
    reflections_table,
    sources_table,
)
from soundmap.outputs.wording import NOTHING, array_text, number_text, printed_reference
from soundmap.sensors import OffsetVerdict

KINDS = ("appeared", "louder", "quieter", "gone", "unchanged", "untold")
CAPTIONS = {
    "power_map": "Where it is loud, over the geometric map. Cells without colour were not "
    "measured, or too rarely to count; they need not be quiet. Pale cells show the most that can "
    "be there, where no source was found. Ellipses hold their source with 95 %; they are drawn "
    "where that is more than the mark covers.",
    "trajectory": "Where the robot was: its way in the geometric map, with the sources found.",
    "audio_scans": "What the array heard: level on every bearing over time, and below it the "
    "level of the loudest bearing and the mean of all.",
    "power_ratio": "What changed: red is louder than the background, blue is quieter, no colour "
    "was not measured. Pale cells differ no more than chance may make them.",
}
STYLE = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { font: 16px/1.45 system-ui, sans-serif; color: #1a1a1a; background: #fff;
  max-width: 62rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: 0 0 .3rem; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 2rem 0 .6rem; border-bottom: 1px solid #ccc; }
.lead { font-size: 1.15rem; margin: .2rem 0 1rem; }
.facts { display: flex; flex-wrap: wrap; gap: .6rem; margin: 1rem 0; padding: 0; list-style: none; }
.facts li { flex: 1 1 9rem; border: 1px solid #ccc; border-radius: .4rem; padding: .5rem .7rem; }
.facts b { display: block; font-size: 1.25rem; overflow-wrap: anywhere; }
.facts .warn { border-color: #d55e00; background: #fdf1e8; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; min-width: 18rem; }
th, td { padding: .3rem .7rem .3rem 0; text-align: left; vertical-align: top;
  border-bottom: 1px solid #e4e4e4; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
figure { margin: 1rem 0; }
img, svg { display: block; max-width: 100%; height: auto; }
figcaption { color: #444; font-size: .95rem; margin-top: .3rem; max-width: 45rem; }
pre { font-size: .8rem; white-space: pre-wrap; overflow-wrap: anywhere; columns: 20rem;
  background: #f6f6f6; padding: .8rem; margin: .5rem 0; }
summary { cursor: pointer; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .2rem 1rem; margin: 0; }
dt { color: #555; } dd { margin: 0; overflow-wrap: anywhere; }
@media print {
  body { font-size: 10.5pt; max-width: none; padding: 0; }
  figure, tr, li { break-inside: avoid; } h2 { break-after: avoid; }
  figure img { max-height: 16cm; width: auto; }
  .wide { overflow: visible; }
  details::details-content { content-visibility: visible; display: block; block-size: auto; }
}
"""


def report_html(report: Mapping[str, Any], pictures: Mapping[str, bytes]) -> str:
    """The page of a run folder or a diff folder.

    Parameters
    ----------
    report : mapping
        As in ``report.json``.
    pictures : mapping
        PNG or SVG by name, in the order in which they are shown; may be empty.
    """
    compares = "background" in report
    title = f"{report['run']} against {report['background']}" if compares else report["log"]
    parts = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="lead">{escape(_lead(report, compares=compares))}</p>',
        _facts(_run_facts(report) if not compares else _diff_facts(report)),
        *(_figure(name, content) for name, content in list(pictures.items())[:1]),
        *(
            [_section("What changed", changes_table(report))]
            if compares
            else [_section("Sources", sources_table(report)), *_mirror_images(report)]
        ),
        *(_figure(name, content) for name, content in list(pictures.items())[1:]),
        *_what_was_lost(report, compares=compares),
        _section("How it was made", _provenance(report)),
        _section("Configuration", _configuration(report["config"])),
    ]
    return _page(title, "\n".join(parts))


def _page(title: str, body: str) -> str:
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<link rel="icon" href="data:,">\n'
        f"<title>{escape(title)} · soundmap</title>\n<style>{STYLE}</style>\n</head>\n"
        f"<body>\n{body}\n</body>\n</html>\n"
    )


def _lead(report: Mapping[str, Any], *, compares: bool) -> str:
    if compares:
        return _lead_of_changes(report["changes"])
    rows = report["sources"]
    if not rows:
        return "No source was found."
    first, count = rows[0], len(rows)
    place = f"at x {first['x_m']:.2f} m, y {first['y_m']:.2f} m"
    many = "One source was found" if count == 1 else f"{count} sources were found"
    return f"{many}; the loudest, {first['id']}, {place}."


def _run_facts(report: Mapping[str, Any]) -> list[tuple[str, str, bool]]:
    way, rows = report["trajectory"], report["sources"]
    lost = sum(loss["data_lost"] for loss in report["losses"])
    share = way["usable_share"]
    unit = printed_reference(report["level_reference"])
    loudest = (
        (number_text(rows[0]["power_db"], 1), f"{unit}, loudest source", False) if rows else None
    )
    return [
        *([loudest] if loudest else []),
        (str(len(rows) or "none"), "source" if len(rows) == 1 else "sources", False),
        (
            NOTHING if share is None else f"{100 * share:.1f} %",
            "of the poses can be trusted",
            share is None or share < 0.95,
        ),
        (f"{way['length_m']:.1f} m", f"driven in {number_text(report['duration_s'], 1)} s", False),
        *_corrections(report.get("array")),
        (str(lost or "none"), "kind of data lost" if lost == 1 else "kinds of data lost", lost > 0),
    ]


def _corrections(array: Mapping[str, Any] | None) -> list[tuple[str, str, bool]]:
    """What was put right about the array's clock and mount, which its owner had better know."""
    cards = []
    if array and array["clock_verdict"] == OffsetVerdict.CORRECTED:
        late = 1e3 * array["clock_offset_s"]
        cards.append((f"{late:+.0f} ms", "clock of the audio, corrected", True))
    if array and array["yaw_verdict"] == OffsetVerdict.CORRECTED:
        turned = array["yaw_offset_deg"]
        cards.append((f"{turned:+.1f}°", "yaw of the array's mount, corrected", True))
    return cards


def _lead_of_changes(rows: Sequence[Mapping[str, Any]]) -> str:
    if not rows:
        return "Nothing differs."
    counts = Counter(row["kind"] for row in rows)
    parts = [f"{counts[kind]} {kind}" for kind in KINDS if counts[kind]]
    changed = any(counts[kind] for kind in KINDS[:4])
    start = "What changed: " if changed else "Nothing changed for sure: "
    return f"{start}{', '.join(parts)}."


def _diff_facts(report: Mapping[str, Any]) -> list[tuple[str, str, bool]]:
    rows, counts = report["changes"], report["counts"]
    kinds = Counter(row["kind"] for row in rows)
    without = counts.get("cells_without_background", 0)
    return [
        (str(kinds["appeared"] + kinds["louder"]), "places louder", False),
        (str(kinds["gone"] + kinds["quieter"]), "places quieter", False),
        (str(kinds["unchanged"]), "unchanged", False),
        (
            f"{counts.get('cells_compared', 0)}",
            f"cells compared, {without} of them against the background's median",
            without > 0,
        ),
    ]


def _facts(facts: Sequence[tuple[str, str, bool]]) -> str:
    items = (
        f"<li{' class=warn' if warns else ''}><b>{escape(value)}</b>{escape(what)}</li>"
        for value, what, warns in facts
    )
    return f'<ul class="facts">{"".join(items)}</ul>'


def _figure(name: str, content: bytes) -> str:
    kind = "image/png" if content.startswith(b"\x89PNG") else "image/svg+xml"
    caption = escape(CAPTIONS.get(name, name))
    data = base64.b64encode(content).decode("ascii")
    image = f'<img src="data:{kind};base64,{data}" alt="{caption}">'
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def _mirror_images(report: Mapping[str, Any]) -> list[str]:
    return [_section("Mirror images", reflections_table(report))] if report["reflections"] else []


def _what_was_lost(report: Mapping[str, Any], *, compares: bool) -> list[str]:
    losses = report["losses"]
    if compares:
        return [_section("To be kept in mind", _losses(losses))] if losses else []
    return [_section("What was lost", _losses(losses))]


def _losses(losses: Sequence[Mapping[str, Any]]) -> str:
    if not losses:
        return "<p>Nothing was lost.</p>"
    rows = [
        [
            "lost" if loss["data_lost"] else "note",
            str(loss["count"]),
            when(loss.get("first_s"), loss.get("last_s")),
            loss["what"],
            loss["where"],
            loss["effect"],
        ]
        for loss in losses
    ]
    return html_table(["", "Times", "When", "What", "Where", "What was done"], rows)


def _provenance(report: Mapping[str, Any]) -> str:
    facts = {"soundmap": report["soundmap"]}
    for key in ("log", "run", "background", "fingerprint"):
        if report.get(key) is not None:
            facts[_words(key)] = str(report[key])
    if report.get("duration_s") is not None:
        facts["length of the log"] = f"{number_text(report['duration_s'], 1)} s"
    if text := array_text(report.get("array")):
        facts["microphone array"] = text
    if report.get("speed") is not None:
        facts["speed"] = f"{report['speed']:.3g} x real time"
    facts["time"] = _joined(
        f"{_words(k)} {number_text(v, 2)} s" for k, v in report["timings_s"].items()
    )
    facts["counts"] = _joined(f"{v} {_words(k)}" for k, v in report["counts"].items())
    facts["versions"] = _joined(f"{k} {v}" for k, v in report["versions"].items())
    return _definitions(facts)


def _configuration(config: Mapping[str, Any]) -> str:
    text = escape(tomli_w.dumps(config))
    return f"<details><summary>Every setting, as used</summary><pre>{text}</pre></details>"


def _section(title: str, content: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{content}</section>"


def _definitions(facts: Mapping[str, str]) -> str:
    lines = (f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in facts.items() if v)
    return f"<dl>{''.join(lines)}</dl>"


def _joined(parts: Iterable[str]) -> str:
    return ", ".join(parts)


def _words(name: str) -> str:
    return name.replace("_", " ")
