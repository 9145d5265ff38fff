from pathlib import Path

import pytest

from soundmap.errors import ConfigError
from soundmap.simulate.scene_file import floor_plan, loaded_scene

GOOD = """\
name = "hall"
[[walls]]
name = "outer"
corners_m = [[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0]]
[[walls]]
name = "pillar"
corners_m = [[2.0, 2.0], [3.0, 2.0], [3.0, 3.0], [2.0, 3.0]]
[[sources]]
id = "S1"
position_m = [5.0, 1.0, 0.4]
level_dba_5cm = 78.5
[[sources]]
id = "S2"
position_m = [1.0, 3.0, 0.4]
level_dba_5cm = 70
[robot]
way_points_m = [[1.0, 1.0], [4.5, 1.0], [4.5, 3.0]]
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "scene.toml"
    path.write_text(text)
    return path


def refusal(folder: Path, text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        loaded_scene(written(folder, text))
    return str(caught.value)


def test_a_good_scene_is_read_with_its_walls_and_sources(tmp_path: Path) -> None:
    scene = loaded_scene(written(tmp_path, GOOD))
    assert [source.id for source in scene.sources] == ["S1", "S2"]
    assert floor_plan(scene).area_m2 == pytest.approx(6 * 4 - 1)


@pytest.mark.parametrize(
    ("old", "new", "line", "what"),
    [
        ("[5.0, 1.0, 0.4]", "[2.5, 2.5, 0.4]", 10, "lies inside wall 'pillar'"),
        ("[5.0, 1.0, 0.4]", "[7.0, 1.0, 0.4]", 10, "lies outside the room"),
        ("[5.0, 1.0, 0.4]", "[5.0, 1.0, 9.0]", 10, "is 9 m high"),
        ("[4.5, 1.0], [4.5, 3.0]", "[4.5, 1.0], [9.0, 3.0]", 17, "way point 3 at (9, 3)"),
        ("[4.5, 1.0], [4.5, 3.0]", "[4.5, 3.5], [1.0, 1.0]", 17, "crosses a wall"),
        ("[4.5, 1.0], [4.5, 3.0]", "[4.5, 0.1]", 17, "within 0.10 m of wall 'outer'"),
        ('id = "S2"', 'id = "S1"', 13, "'S1' is used 2 times"),
        ("level_dba_5cm = 70", "levl_dba_5cm = 70", 15, "did you mean 'level_dba_5cm'?"),
        ("level_dba_5cm = 70", 'level_dba_5cm = "loud"', 15, "valid number"),
        ("[2.0, 2.0], [3.0", "[-1.0, 2.0], [3.0", 7, "crosses wall 'outer'"),
        ("level_dba_5cm = 70", 'level_dba_5cm = 70\nwav = "no.wav"', 16, "there is no file"),
    ],
)
def test_an_impossible_scene_is_refused_with_the_line_to_mend(
    tmp_path: Path, old: str, new: str, line: int, what: str
) -> None:
    message = refusal(tmp_path, GOOD.replace(old, new, 1))
    assert what in message
    assert f"line {line}: " in message


def test_a_run_that_names_an_unknown_source_is_refused(tmp_path: Path) -> None:
    message = refusal(tmp_path, GOOD + '[[runs]]\nname = "run1"\nsources = ["S1", "S9"]\n')
    assert "line 20: runs.1.sources: run 'run1' names 'S9', but sources are S1, S2" in message


def test_a_way_that_bumps_into_something_is_refused_where_it_does(tmp_path: Path) -> None:
    crate = '[[furniture]]\nname = "crate"\ncentre_m = [3.0, 1.2]\nsize_m = [0.4, 0.4]\n'
    message = refusal(tmp_path, GOOD + crate)
    assert "line 17: robot.way_points_m: at (2.8" in message
    assert "within 0.00 m of furniture 'crate'" in message
    raised = loaded_scene(written(tmp_path, GOOD + crate + "bottom_m = 1.9\ntop_m = 2.1\n"))
    assert raised.furniture[0].name == "crate"


def test_every_fault_is_named_at_once(tmp_path: Path) -> None:
    text = GOOD.replace("[5.0, 1.0, 0.4]", "[2.5, 2.5, 0.4]").replace("[1.0, 1.0], ", "[9, 9], ")
    message = refusal(tmp_path, text)
    assert "2 fault(s)" in message


def test_a_file_that_is_not_toml_is_refused(tmp_path: Path) -> None:
    assert "not valid TOML" in refusal(tmp_path, "name = ")


@pytest.mark.parametrize("name", ["corridor", "room", "workshop"])
def test_the_shipped_scenes_are_possible(name: str) -> None:
    path = Path(__file__).parents[2] / "configs" / "scenes" / f"{name}.toml"
    scene = loaded_scene(path)
    assert scene.name == name
    assert len(scene.runs) > 1
