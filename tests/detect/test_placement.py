import numpy as np
import pytest

from soundmap.detect.placement import placement
from soundmap.detect.walls import HIT_CELL_M, surface_pieces

WALL = surface_pieces(np.column_stack([np.full(100, 2.0), HIT_CELL_M * np.arange(100)]))
ALONG_X = np.diag([0.095**2, 0.013**2])


def placed(x, odds):
    return placement(np.array([x, 1.0]), ALONG_X, WALL, np.full(len(WALL), odds))


def test_a_source_a_little_off_a_machine_is_on_it():
    found = placed(1.9, odds=30.0)
    np.testing.assert_allclose(found.place_m, (2.0, 1.0), atol=0.02)
    assert found.on_surface
    assert found.covariance_m2[0, 0] < ALONG_X[0, 0]


def test_a_source_far_before_a_wall_stays_there():
    found = placed(1.6, odds=0.5)
    np.testing.assert_allclose(found.place_m, (1.6, 1.0), atol=0.01)
    assert not found.on_surface


def test_a_source_between_is_told_to_be_uncertain():
    found = placed(1.84, odds=2.0)
    assert 1.84 < found.place_m[0] < 2.0
    assert np.sqrt(found.covariance_m2[0, 0]) > 0.06
    assert 0.2 < found.surface_odds < 5.0


@pytest.mark.parametrize("along_m", np.linspace(1.0, 1.0 + HIT_CELL_M, 6))
def test_along_a_surface_a_source_stays_where_its_bearings_meet(along_m):
    sure = np.diag([0.03**2, 0.004**2])
    found = placement(np.array([1.97, along_m]), sure, WALL, np.full(len(WALL), 30.0))
    np.testing.assert_allclose(found.place_m, (2.0, along_m), atol=0.002)


def test_without_any_surface_bearings_decide():
    found = placement(np.ones(2), ALONG_X, np.zeros((0, 2)), np.zeros(0))
    assert found.place_m == pytest.approx([1.0, 1.0])
    assert not found.on_surface
