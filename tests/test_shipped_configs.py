import math
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from soundmap.config import Config, Table, config_toml, loaded_config

CONFIGS = Path(__file__).parents[1] / "configs"


def tables() -> list[tuple[str, type[Table]]]:
    fields = Config.model_fields.items()
    return [(name, field.annotation) for name, field in fields if name != "mounts"]


def section(text: str, name: str) -> str:
    """The lines of one table of a TOML file, comments included."""
    return re.split(r"^\[", text.split(f"\n[{name}]\n")[1], flags=re.MULTILINE)[0]


def test_the_shipped_defaults_are_those_of_the_program():
    assert loaded_config([CONFIGS / "default.toml"]) == Config()


@pytest.mark.parametrize(("name", "table"), tables(), ids=[name for name, _ in tables()])
def test_every_key_stands_in_the_shipped_defaults_with_a_comment(name, table):
    text = (CONFIGS / "default.toml").read_text()
    given = tomllib.loads(text)[name]
    with_value = {key for key, field in table.model_fields.items() if field.default is not None}
    assert set(given) == with_value
    for key in set(table.model_fields) - with_value:
        assert re.search(rf"^# {key} = ", section(text, name), flags=re.MULTILINE), key
    if name in ("localize", "scan", "fuse", "detect", "diff"):
        for key in given:
            assert re.search(rf"^{key} = .* # .+$", text, flags=re.MULTILINE), key


def test_the_commented_keys_of_the_shipped_defaults_are_valid():
    text = (CONFIGS / "default.toml").read_text()
    circle = section(text, "array").replace("# positions_m", "## positions_m")
    given = re.findall(r"^# (\w+ = .*)$", circle, flags=re.MULTILINE)
    array = Config.model_validate({"array": tomllib.loads("\n".join(given))}).array
    np.testing.assert_allclose(array.microphone_positions(), Config().array.microphone_positions())


def test_the_paper_is_followed_to_the_letter():
    config = loaded_config([CONFIGS / "paper.toml"])
    # Table 1
    assert 360.0 / config.scan.bearings == 3.0
    assert (config.fuse.alpha, config.fuse.d_min_m, config.fuse.d_max_m) == (0.5, 0.3, 3.0)
    # Sect. 2.3
    scan = config.scan
    assert (scan.window_s, scan.hop_s, scan.frames) == (0.025, 0.010, 10)
    assert (scan.low_hz, scan.high_hz) == (1000.0, 6000.0)
    # Sects. 2.4, 3 and 4
    assert config.fuse.candidates == "bearings"
    assert config.fuse.cell_m == 0.05
    assert config.detect.min_visit_share == 0.10
    positions = config.array.microphone_positions()
    assert positions.shape == (16, 3)
    np.testing.assert_allclose(2 * np.hypot(*positions[:, :2].T), 0.31)
    steps = np.diff(np.unwrap(np.arctan2(positions[:, 1], positions[:, 0])))
    np.testing.assert_allclose(steps, 2 * math.pi / 16)


def test_the_paper_names_its_own_values_and_leans_on_no_default():
    given = tomllib.loads((CONFIGS / "paper.toml").read_text())
    assert set(given["scan"]) == set(type(Config().scan).model_fields) - {"speed_of_sound_m_s"}
    assert set(given["fuse"]) == set(type(Config().fuse).model_fields)


def test_a_robot_given_after_the_paper_brings_its_own_array(tmp_path):
    robot = tmp_path / "robot.toml"
    robot.write_text("[array]\npositions_m = [[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0]]\n")
    config = loaded_config([CONFIGS / "paper.toml", robot])
    assert config.array.microphone_positions().shape == (3, 3)
    assert config.fuse.candidates == "bearings"


@pytest.mark.parametrize("name", ["default.toml", "paper.toml"])
def test_a_shipped_configuration_survives_being_written_and_read(tmp_path, name):
    config = loaded_config([CONFIGS / name])
    copy = tmp_path / name
    copy.write_text(config_toml(config))
    assert loaded_config([copy]) == config
