"""What the lasers of a drive can see."""

from pathlib import Path

import numpy as np
import pytest

from soundmap.simulate.drive_log import surfaces
from soundmap.simulate.lasers import ray_ranges
from soundmap.simulate.scene_file import loaded_scene

SCENE = """\
name = "hall"
[[walls]]
name = "outer"
corners_m = [[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0]]
[[furniture]]
name = "lamp"
centre_m = [2.0, 2.0]
size_m = [0.4, 0.4]
bottom_m = 1.5
[[furniture]]
name = "crate"
centre_m = [3.0, 3.5]
size_m = [0.4, 0.4]
yaw_deg = 45.0
top_m = 0.5
[[sources]]
id = "S1"
position_m = [5.0, 1.0, 0.35]
facing_deg = 180.0
level_dba_5cm = 78.0
box_m = [0.3, 0.2, 0.4]
[robot]
way_points_m = [[1.0, 1.0]]
"""


@pytest.fixture
def scene(tmp_path: Path) -> object:
    path = tmp_path / "hall.toml"
    path.write_text(SCENE)
    return loaded_scene(path)


def seen(scene: object, height: float, x: float, y: float, angle: float) -> float:
    walls = surfaces(scene, height)
    return float(ray_ranges([[x, y]], [angle], *walls, np.zeros((1, 0, 3)))[0])


def test_a_source_stands_at_the_front_of_its_cabinet(scene: object) -> None:
    assert seen(scene, 0.3, 1.0, 1.0, 0.0) == pytest.approx(4.0)
    assert seen(scene, 0.3, 5.9, 1.0, np.pi) == pytest.approx(0.7)
    assert seen(scene, 0.6, 1.0, 1.0, 0.0) == pytest.approx(5.0)


def test_things_are_seen_only_at_their_own_heights(scene: object) -> None:
    assert seen(scene, 0.3, 1.0, 2.0, 0.0) == pytest.approx(5.0)
    assert seen(scene, 1.6, 1.0, 2.0, 0.0) == pytest.approx(0.8)
    assert seen(scene, 0.3, 1.0, 3.5, 0.0) == pytest.approx(2.0 - 0.2 * np.sqrt(2.0))
    assert seen(scene, 0.6, 1.0, 3.5, 0.0) == pytest.approx(5.0)
