import numpy as np
import pytest

from soundmap.grid import GridFrame, OccupancyGrid


def test_centres_of_cells_lie_in_their_cells():
    frame = GridFrame(0.05, (-1.23, 4.56), (7, 11))
    cells = np.argwhere(np.ones(frame.shape))
    assert np.array_equal(frame.cells(frame.centres(cells)), cells)
    assert frame.contains(cells).all()


def test_rows_run_along_y_and_columns_along_x():
    frame = GridFrame(0.5, (10.0, 20.0), (4, 6))
    assert frame.cells([10.1, 21.6]).tolist() == [3, 0]
    assert frame.extent_m == (10.0, 13.0, 20.0, 22.0)


def test_points_outside_have_cells_that_are_not_contained():
    frame = GridFrame(0.5, (0.0, 0.0), (2, 2))
    cells = frame.cells([[-0.01, 0.1], [0.1, 1.01], [0.99, 0.99]])
    assert frame.contains(cells).tolist() == [False, False, True]


def test_an_occupancy_grid_needs_one_value_a_cell():
    frame = GridFrame(1.0, (0.0, 0.0), (2, 3))
    with pytest.raises(ValueError, match="one value a cell"):
        OccupancyGrid(frame, np.zeros((3, 2), dtype=bool), np.zeros((2, 3), dtype=bool))
