import numpy as np
import pytest

from soundmap.config import ScanConfig
from soundmap.detect import sparse_fit
from soundmap.detect.evidence import gathered_evidence
from soundmap.detect.sound_paths import Kind
from soundmap.detect.sparse_fit import SparseFit
from soundmap.detect.walls import surface_points, wall_lines
from tests.detect.box_room import WIDTH, observed


def fitted(emitters, x, y):
    evidence = gathered_evidence(*observed(emitters), ScanConfig())
    fit = SparseFit(evidence, wall_lines(surface_points(evidence)))
    component = fit.add(np.array([x, y]), 0.3, Kind.SOURCE)
    fit.renew()
    for _ in range(8):
        fit.move()
    return fit, component


def test_small_steps_lead_to_where_bearings_point():
    _, component = fitted([(5.5, 3.1, 20.0)], 5.35, 3.25)
    np.testing.assert_allclose(component.place_m, (5.5, 3.1), atol=0.03)


def test_a_source_is_held_before_the_wall_that_its_sound_seems_to_come_out_of(monkeypatch):
    in_the_wall = [(6.25, 3.1, 0.5)]  # no louder than what surrounds it
    _, held = fitted(in_the_wall, 5.9, 3.1)
    monkeypatch.setattr(sparse_fit, "HOLD_BEHIND", 0.0)
    _, free = fitted(in_the_wall, 5.9, 3.1)
    assert free.place_m[0] > WIDTH + 0.15
    assert held.place_m[0] - WIDTH < 0.6 * (free.place_m[0] - WIDTH)


def test_a_component_that_no_scan_hears_goes():
    evidence = gathered_evidence(*observed([(5.5, 3.1, 20.0)]), ScanConfig())
    fit = SparseFit(evidence, wall_lines(surface_points(evidence)))
    fit.add(np.array([5.5, 3.1]), 0.3, Kind.SOURCE)
    fit.add(np.array([40.0, 40.0]), 0.3, Kind.IMAGE)
    fit.refit()
    assert [component.place_m[0] for component in fit.components] == pytest.approx([5.5])
