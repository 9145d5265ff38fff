import numpy as np
import pytest

from soundmap.config import ScanConfig
from soundmap.detect import growth
from soundmap.detect.evidence import gathered_evidence
from soundmap.detect.matched_filter import HEIGHTS_M, explained, matched_scans
from soundmap.detect.model_errors import FREE_ERRORS
from soundmap.detect.sound_paths import Kind
from soundmap.detect.sparse_fit import SparseFit
from soundmap.detect.steps import move
from tests.detect.box_room import begun_fit, observed


def left_of_two(apart_m, monkeypatch):
    """Components that are left of two sources if joining them may cost nothing."""
    monkeypatch.setattr(growth, "MERGE_SHARE", 0.0)
    monkeypatch.setattr(growth, "JOINT_SHARE", 0.0)
    places = [(5.5, 3.1), (5.5, 3.1 + apart_m)]
    fit = begun_fit([(*place, 20.0) for place in places])
    for place in places:
        fit.add(np.array(place), 0.3, Kind.SOURCE)
    fit.renew()
    growth._merge(fit)
    return len(fit.components)


def test_components_a_hand_apart_are_one_and_others_only_if_that_costs_little(monkeypatch):
    assert left_of_two(0.2, monkeypatch) == 1
    assert left_of_two(0.6, monkeypatch) == 2


def test_a_settled_source_does_not_hang_on_a_ghost_beside_it():
    fit = begun_fit([(5.5, 3.1, 20.0)])
    source = fit.add(np.array([5.4, 2.95]), 0.6, Kind.SOURCE)
    fit.add(np.array([5.6, 3.3]), 0.3, Kind.SOURCE)  # together they explain it
    fit.refit()
    growth.settle(fit, [source])
    assert fit.components == [source]
    assert fit.errors == FREE_ERRORS
    np.testing.assert_allclose(source.place_m, (5.5, 3.1), atol=0.02)
    assert source.height_m == growth.SETTLED_HEIGHTS_M[0]


def test_a_settled_source_is_at_rest():
    fit = begun_fit([(5.5, 3.1, 20.0)])
    source = fit.add(np.array([5.5, 3.1]), 0.3, Kind.SOURCE)
    growth.settle(fit, [source])
    settled = source.place_m.copy()
    for _ in range(20):
        move(fit, share=0.5)
    np.testing.assert_allclose(settled, source.place_m, atol=0.003)


@pytest.mark.parametrize("lobe", [(0.2, -1.0), (-0.8, -0.3), (-0.3, 0.9)])
def test_a_settled_source_knows_which_side_of_it_is_loud(lobe):
    fit = begun_fit([(5.5, 3.1, 20.0, lobe)], reflected=0.5)
    source = fit.add(np.array([5.4, 3.0]), 0.3, Kind.SOURCE)
    fit.refit()
    growth.settle(fit, [source])
    np.testing.assert_allclose(source.place_m, (5.5, 3.1), atol=0.02)
    np.testing.assert_allclose(source.directivity, lobe, atol=0.25)


def test_a_high_source_explains_most_at_the_greatest_height():
    evidence = gathered_evidence(*observed([(5.0, 3.1, 20.0)], above_m=1.2), ScanConfig())
    fit = SparseFit(evidence, np.zeros((0, 3)))
    matched = matched_scans(evidence, evidence.heard, fit.precision)
    (value,) = explained(evidence, matched, np.array([[5.0, 3.1]]), Kind.SOURCE)
    assert HEIGHTS_M[int(np.argmax(value))] > 1.0
