from pathlib import Path

import numpy as np

from soundmap.simulate.map_image import drawn_map
from soundmap.simulate.scene_file import loaded_scene

SCENES = Path(__file__).parents[2] / "configs" / "scenes"


def test_walls_begin_where_the_surface_is_and_machines_are_not_on_the_map() -> None:
    room = drawn_map(loaded_scene(SCENES / "corridor.toml"))
    inside = np.array([[0.02, 4.0], [7.98, 4.0], [1.98, 4.0], [6.02, 4.0], [4.6, 0.2]])
    behind = np.array([[-0.02, 4.0], [8.02, 4.0], [2.02, 4.0], [5.98, 4.0], [4.6, -0.02]])
    for points, wall in ((inside, False), (behind, True)):
        row, column = room.frame.cells(points).T
        assert (room.occupied[row, column] == wall).all()
        assert (room.free[row, column] != wall).all()


def test_furniture_is_on_the_map_only_if_asked() -> None:
    room = drawn_map(loaded_scene(SCENES / "room.toml"))
    row, column = room.frame.cells(np.array([[0.25, 2.6], [2.9, 2.15]])).T  # cupboard, bench
    assert room.occupied[row, column].tolist() == [True, False]
