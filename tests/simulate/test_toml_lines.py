from soundmap.simulate.toml_lines import line_of, toml_lines

TEXT = """\
name = "a = b"  # [not a table]
[room]
height_m = 2.5
[[walls]]
corners_m = [
  [0, 0],  # lists may take several lines
  [1, 0],
]
reflection = 0.5
[[lasers]]
topic = "/a"
[lasers.clock]
jitter_s = 1.0
[[lasers]]
topic = "/b"
clock = { jitter_s = 2.0 }
"""


def test_tables_keys_and_entries_of_arrays_have_the_lines_a_person_counts() -> None:
    lines = toml_lines(TEXT)
    assert lines[("room", "height_m")] == 3
    assert lines[("walls", 0)] == 4
    assert lines[("walls", 0, "corners_m")] == 5
    assert lines[("walls", 0, "reflection")] == 9
    assert lines[("lasers", 0, "clock", "jitter_s")] == 13
    assert lines[("lasers", 1, "topic")] == 15


def test_what_has_no_line_of_its_own_has_that_of_its_holder() -> None:
    lines = toml_lines(TEXT)
    assert line_of(lines, ("lasers", 1, "clock", "jitter_s")) == 16
    assert line_of(lines, ("lasers", 1, "frame")) == 14
    assert line_of(lines, ("robot", "speed")) is None
