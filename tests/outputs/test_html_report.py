import re
from html.parser import HTMLParser

import pytest
from handmade import calibrated_run, fitted_run, made_ratio, made_run, unlucky_run

from soundmap.config import DiffConfig
from soundmap.outputs.html_report import report_html
from soundmap.outputs.level_plot import Dot, level_plot
from soundmap.outputs.report import diff_report, run_report

PICTURES = {"power_map": b"\x89PNG first", "trajectory": b"<?xml second"}
VOID = {"meta", "link", "img", "circle", "line"}


class Page(HTMLParser):
    """Checks that tags close in order, and keeps what a reader sees and what a browser loads."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []
        self.loads: list[str] = []
        self.tags: set[str] = set()
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.loads += [value for name, value in attrs if name in ("src", "href", "action", "data")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.add(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.text.append(data)

    def says(self, *words: str) -> bool:
        said = " ".join(" ".join(self.text).split())
        return all(word in said for word in words)


def page_of(run) -> Page:
    return Page(report_html(run_report(run, run.timings_s), PICTURES))


def test_the_page_says_what_was_found_what_was_lost_and_how_it_was_made():
    page = page_of(made_run())
    assert page.says("2 sources were found; the loudest, S1, at x 3.12 m, y 0.28 m.")
    assert page.says("S2", "5.725", "-64.0", "dB re (full scale)²")
    assert page.says("90.0 %", "of the poses can be trusted")
    assert page.says("1294", "odometry pose is not finite", "motion taken from the twist")
    assert page.says("numpy", "localize 1.25 s", "min_visit_share = 0.1", "0123abcd")


def test_the_page_tells_how_far_the_array_was_off():
    assert page_of(calibrated_run()).says("microphone array", "clock +50 ± 4 ms, corrected")


def test_the_page_tells_what_a_fit_knows():
    page = page_of(fitted_run())
    assert page.says("95 % within [cm]", "29 x 12", "not seen by laser, unsteady", "0.004")
    assert page.says("Mirror images", "R1", "-80.0")


def test_the_page_tells_what_was_put_right_about_the_array():
    page = page_of(calibrated_run())
    assert page.says("+50 ms", "clock of the audio, corrected", "yaw -0.3 ± 0.4 degrees")
    assert not page.says("yaw of the array's mount, corrected")
    assert not page_of(made_run()).says("clock of the audio")


def test_the_page_loads_nothing_but_itself():
    page = page_of(made_run())
    assert page.loads
    assert all(link.startswith("data:") for link in page.loads)
    assert not page.tags & {"script", "iframe", "object", "form", "audio", "video"}
    text = report_html(run_report(made_run(), {}), PICTURES)
    assert "default-src 'none'" in text
    assert not re.search(r"@import|url\(", text)


def test_pictures_are_shown_in_their_format():
    text = report_html(run_report(made_run(), {}), PICTURES)
    kinds = re.findall(r'<img src="data:(image/[a-z+]+);base64,', text)
    assert kinds == ["image/png", "image/svg+xml"]


def test_a_run_without_sources_pictures_or_losses_has_a_whole_page_too():
    run = unlucky_run()
    page = Page(report_html(run_report(run, {}), {}))
    assert page.says("No source was found.", "Nothing was lost.")
    assert "svg" not in page.tags
    assert "img" not in page.tags


def test_names_from_a_log_are_shown_not_obeyed():
    run = made_run(made_run().log.with_name("<script>alert(1)<br>&amp;.mcap"))
    page = page_of(run)
    assert "script" not in page.tags
    assert page.says("&amp;.mcap")


def test_a_difference_has_a_page(tmp_path):
    report = diff_report(
        made_ratio(),
        run=tmp_path / "run1",
        background=tmp_path / "run3",
        config=DiffConfig(),
        timings_s={"compare": 0.1},
    )
    page = Page(report_html(report, {"power_ratio": b"\x89PNG"}))
    assert page.says(
        "run1 against run3", "What changed: 1 appeared, 1 louder, 1 gone, 1 unchanged."
    )
    assert page.says("against the background's median", "≥ +26.0", "+19.9 ± 0.4", "< 1e-06")


def circles(svg: str) -> list[float]:
    return [float(x) for x in re.findall(r'<circle cx="([0-9.]+)"', svg)]


def test_the_dots_stand_where_the_scale_says():
    svg = level_plot([Dot("S1", 52.0, None, "52.0"), Dot("S2", 46.0, None, "46.0")], "dB")
    ticks = {
        float(value): float(x)
        for x, value in re.findall(r'<text x="([0-9.]+)"[^>]*middle">(-?[0-9.]+)</text>', svg)
    }
    assert circles(svg) == pytest.approx([ticks[52.0], ticks[46.0]], abs=0.1)
    assert 0.0 not in ticks


def test_the_scale_of_differences_reaches_no_difference():
    svg = level_plot([Dot("S1", 34.0, 0.5, "34")], "dB", with_zero=True)
    assert ">0</text>" in svg


def test_a_known_error_is_drawn_to_both_sides_of_its_level():
    svg = level_plot([Dot("S1", 50.0, 2.0, "50.0 ± 2.0")], "dB")
    start, end = map(float, re.search(r'<line x1="([0-9.]+)" x2="([0-9.]+)" y1="14"', svg).groups())
    assert (start + end) / 2 == pytest.approx(circles(svg)[0], abs=0.1)
    assert end - start > 10
    assert "50.0 ± 2.0 dB" in svg


def test_a_level_that_is_not_known_has_no_dot():
    assert level_plot([Dot("S1", None, None, "-")], "dB") == ""
    assert level_plot([], "dB") == ""


def test_many_sources_are_cut_short_and_said_so():
    svg = level_plot([Dot(f"S{n}", -float(n), None, "") for n in range(30)], "dB")
    assert len(circles(svg)) == 20
    assert "and 10 more" in svg
