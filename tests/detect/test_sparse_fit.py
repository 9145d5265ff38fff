from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import nnls

from soundmap.config import ScanConfig
from soundmap.detect import sparse_fit
from soundmap.detect.evidence import gathered_evidence
from soundmap.detect.far_field import USUAL
from soundmap.detect.model_errors import Precision
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


def test_the_misfit_is_that_of_sources_and_far_field_fitted_together():
    far = [(0.3, 0.8), (1.9, 0.5), (4.4, 0.7)]
    evidence = gathered_evidence(*observed([(5.5, 3.1, 20.0)], far=far), ScanConfig())
    fit = SparseFit(evidence, wall_lines(surface_points(evidence)))
    components = [fit.add(np.array(place), 0.3, Kind.SOURCE) for place in [(5.5, 3.1), (2.0, 4.8)]]
    fit.refit()
    misfit = 0.0
    for band, (start, stop) in enumerate(pairwise(evidence.table.starts)):
        heard = evidence.heard[:, start:stop].ravel().astype(np.float64)
        unit = np.eye(int(evidence.table.starts[-1]))[start:stop]
        field = np.stack([fit.far_field.heard(each)[:, start:stop].ravel() for each in unit], -1)
        held = np.sqrt(np.mean(evidence.weight[:, band] ** 2)) / USUAL
        places = np.stack([each.column[:, start:stop].ravel() for each in components], -1)
        # Strengths are not negative, harmonics are of either sign, and held to nought.
        columns = np.hstack([places, field, -field])
        hold = held * np.eye(stop - start)
        full = np.vstack([columns, np.hstack([np.zeros((stop - start, 2)), hold, -hold])])
        solved, left = nnls(full, np.concatenate([heard, np.zeros(stop - start)]), maxiter=5000)
        misfit += left**2
        for component, strength in zip(components, solved[:2], strict=True):
            assert component.strength[band] == pytest.approx(strength, rel=1e-2, abs=1e-3)
    assert fit.misfit == pytest.approx(misfit, rel=1e-3)


def test_a_step_that_the_far_field_could_explain_leads_to_the_same_place():
    far = [(0.3, 0.8), (1.9, 0.5), (4.4, 0.7)]
    evidence = gathered_evidence(*observed([(5.5, 3.1, 4.0)], far=far), ScanConfig())
    fit = SparseFit(evidence, wall_lines(surface_points(evidence)))
    component = fit.add(np.array([5.35, 3.25]), 0.3, Kind.SOURCE)
    fit.renew()
    for _ in range(8):
        fit.move()
    np.testing.assert_allclose(component.place_m, (5.5, 3.1), atol=0.05)


@pytest.fixture(scope="module")
def before_far_field():
    far = [(0.3, 0.8), (1.9, 0.5), (4.4, 0.7)]
    evidence = gathered_evidence(*observed([(5.5, 3.1, 20.0)], far=far), ScanConfig())
    fit = SparseFit(evidence, wall_lines(surface_points(evidence)))
    fit.add(np.array([5.4, 3.0]), 0.3, Kind.SOURCE)
    fit.refit()
    return fit


def test_what_the_far_field_could_be_does_not_pull_at_strengths(before_far_field):
    fit, rng = before_far_field, np.random.default_rng(3)
    kept = fit.residual
    fit.residual = fit.far_field.heard(rng.standard_normal(int(fit.evidence.table.starts[-1])))
    pull, alone = fit.pulls().sum(), (fit.weighted_columns() * fit.residual).sum()
    fit.residual = kept
    assert abs(pull) < 0.1 * abs(alone)


def test_what_the_far_field_adds_to_a_scan_is_known_less_well_than_anything_else(before_far_field):
    fit = before_far_field
    loud = 10.0 * fit.far_field.heard(np.ones(int(fit.evidence.table.starts[-1])))
    without, with_it = (Precision(fit.evidence, fit.components, far) for far in (None, loud))
    assert np.sum(loud * with_it.times(loud)) < 0.5 * np.sum(loud * without.times(loud))


def test_the_far_field_is_taken_out_of_the_equations_of_places(before_far_field):
    fit = before_far_field
    hessian, _, owners = fit._system(fit.components)
    count, starts = len(owners), fit.evidence.table.starts
    own = np.stack(list(fit.derivatives(owners, slice(None)))).astype(np.float64)
    column = fit.components[0].column.astype(np.float64)
    size = int(starts[-1])
    far = np.stack([fit.far_field.heard(unit) for unit in np.eye(size)]).astype(np.float64)
    inverse = fit.far_field.inverse(fit.precision)
    coupling = np.einsum("ksd,fsd->kf", own, far)
    squares = np.einsum("ksd,lsd->kl", own, own) - coupling @ inverse @ coupling.T
    scale = np.sqrt(np.diag(squares))
    held = (hessian[:count, :count] - squares) / np.outer(scale, scale)
    assert np.abs(held - np.diag(np.diag(held))).max() < 1e-3  # places and shares are held
    own_far = np.einsum("sd,fsd->f", column, far)
    for band, (start, stop) in enumerate(pairwise(starts)):
        across = np.einsum("ksd,sd->k", own[:, :, start:stop], column[:, start:stop])
        part = slice(start, stop)
        across = across - coupling[:, part] @ inverse[part, part] @ own_far[part]
        size_of = scale * np.linalg.norm(column[:, part])
        np.testing.assert_allclose(hessian[:count, count + band] / size_of, across / size_of,
                                   atol=2e-4)  # fmt: skip


def test_half_steps_come_to_rest_where_whole_ones_swing():
    evidence = gathered_evidence(*observed([(5.5, 3.1, 20.0)]), ScanConfig())
    fit = SparseFit(evidence, wall_lines(surface_points(evidence)))
    source = fit.add(np.array([5.5, 3.1]), 0.3, Kind.SOURCE)
    fit.refit()
    fit.renew()
    for _ in range(12):
        fit.move(share=0.5)
    at_rest = source.place_m.copy()
    fit.move(share=0.5)
    np.testing.assert_allclose(source.place_m, at_rest, atol=0.002)
