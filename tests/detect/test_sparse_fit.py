from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import nnls

from soundmap.detect.far_field import USUAL
from soundmap.detect.model_errors import Precision
from soundmap.detect.sound_paths import Kind
from soundmap.detect.sparse_fit import SparseFit
from tests.detect.box_room import FAR, begun_fit


def test_a_component_that_no_scan_hears_goes():
    fit = begun_fit([(5.5, 3.1, 20.0)])
    fit.add(np.array([5.5, 3.1]), 0.3, Kind.SOURCE)
    fit.add(np.array([40.0, 40.0]), 0.3, Kind.IMAGE)
    fit.refit()
    assert [component.place_m[0] for component in fit.components] == pytest.approx([5.5])


def test_the_misfit_is_that_of_sources_and_far_field_fitted_together():
    fit = begun_fit([(5.5, 3.1, 20.0)], far=FAR)
    components = [fit.add(np.array(place), 0.3, Kind.SOURCE) for place in [(5.5, 3.1), (2.0, 4.8)]]
    fit.refit()
    evidence, misfit = fit.evidence, 0.0
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


@pytest.fixture(scope="module")
def before_far_field():
    fit = begun_fit([(5.5, 3.1, 20.0)], far=FAR)
    fit.add(np.array([5.4, 3.0]), 0.3, Kind.SOURCE)
    fit.refit()
    return fit


def test_what_the_far_field_could_be_does_not_pull_at_strengths(before_far_field):
    fit, rng = before_far_field, np.random.default_rng(3)
    kept = fit.residual
    fit.residual = fit.far_field.heard(rng.standard_normal(int(fit.evidence.table.starts[-1])))
    pull, alone = fit.pulls().sum(), (fit.weighted_column(0) * fit.residual).sum()
    fit.residual = kept
    assert abs(pull) < 0.1 * abs(alone)


def test_what_the_far_field_adds_to_a_scan_is_known_less_well_than_anything_else(before_far_field):
    fit = before_far_field
    loud = 10.0 * fit.far_field.heard(np.ones(int(fit.evidence.table.starts[-1])))
    without, with_it = (Precision(fit.evidence, fit.components, far) for far in (None, loud))
    assert np.sum(loud * with_it.times(loud)) < 0.5 * np.sum(loud * without.times(loud))


def test_normal_equations_are_the_same_whichever_columns_were_known():
    """Components came, went and moved; another fit gets all of them at once."""
    fit = begun_fit([(5.5, 3.1, 20.0), (2.0, 4.8, 10.0)])
    first, second, _ = (
        fit.add(np.array(place), 0.3, Kind.SOURCE) for place in [(5.5, 3.1), (2.3, 4.5), (1.9, 5.1)]
    )
    fit.refit()
    fit.components = [component for component in fit.components if component is not second]
    fit.add(np.array([2.1, 4.7]), 0.3, Kind.SOURCE)
    first.place_m[0] += 0.1
    fit.hear_anew(first)
    fit.refit()
    anew = SparseFit(fit.evidence, fit.walls)
    for component in fit.components:
        anew.add(component.place_m, component.height_m, component.kind)
    anew.refit()
    assert len(anew.components) == len(fit.components) >= 2
    scale = np.sqrt(np.einsum("bkk->bk", anew.gram))
    away = (fit.gram - anew.gram) / (scale[:, :, None] * scale[:, None])
    assert np.abs(away).max() < 1e-5
    np.testing.assert_allclose(fit.product / scale, anew.product / scale, rtol=1e-4)
    np.testing.assert_allclose(fit.strengths, anew.strengths, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(fit.coupling, anew.coupling, rtol=1e-3, atol=1e-3)
