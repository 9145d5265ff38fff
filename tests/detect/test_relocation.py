import numpy as np
import pytest

from soundmap.config import ScanConfig
from soundmap.detect.candidates import candidate_places
from soundmap.detect.evidence import gathered_evidence
from soundmap.detect.relocation import relocate
from soundmap.detect.sound_paths import Kind
from soundmap.detect.sparse_fit import SparseFit
from soundmap.detect.walls import surface_points, wall_lines
from tests.detect.box_room import observed

PLACE_M = (5.9, 3.1)


@pytest.fixture(scope="module")
def heard():
    """One source near the wall x = 6."""
    return gathered_evidence(*observed([(*PLACE_M, 20.0)]), ScanConfig())


def relocated(evidence, *components):
    surface = surface_points(evidence)
    fit = SparseFit(evidence, wall_lines(surface))
    for x, y, kind in components:
        fit.add(np.array([x, y]), 0.3, kind)
    fit.refit()
    relocate(fit, candidate_places(evidence, surface))
    return [(*component.place_m, component.kind) for component in fit.components]


def test_what_is_taken_for_an_image_behind_the_wall_becomes_the_source(heard):
    ((x, y, kind),) = relocated(heard, (7.2, 3.6, Kind.IMAGE))
    assert kind == Kind.SOURCE
    np.testing.assert_allclose((x, y), PLACE_M, atol=0.15)


def test_a_source_far_off_its_place_comes_to_it(heard):
    ((x, y, _),) = relocated(heard, (4.5, 3.1, Kind.SOURCE))
    np.testing.assert_allclose((x, y), PLACE_M, atol=0.15)


def test_a_source_at_its_place_is_left_alone(heard):
    assert relocated(heard, (*PLACE_M, Kind.SOURCE)) == [(*PLACE_M, Kind.SOURCE)]


def test_a_true_image_stays_one():
    evidence = gathered_evidence(*observed([(4.0, 6.6, 40.0), (*PLACE_M, 20.0)]), ScanConfig())
    kinds = {kind for _, _, kind in relocated(evidence, (4.0, 6.6, Kind.IMAGE))}
    assert kinds == {Kind.IMAGE}


def test_nothing_is_relocated_where_nothing_is(heard):
    assert relocated(heard) == []
