"""The covariance of what scans hear, and its inverse."""

from itertools import pairwise

import numpy as np
import pytest

from soundmap.config import ScanConfig
from soundmap.detect.component import Share
from soundmap.detect.evidence import gathered_evidence
from soundmap.detect.model_errors import ComponentErrors, Precision
from soundmap.detect.sound_paths import Kind, Path, waves_heard
from soundmap.detect.sparse_fit import SparseFit
from soundmap.detect.unknowns import derivatives
from tests.detect.box_room import observed


@pytest.fixture(scope="module")
def fit():
    evidence = gathered_evidence(*observed([(5.9, 3.1, 20.0)]), ScanConfig())
    fit = SparseFit(evidence, np.zeros((0, 3)))
    fit.add(np.array([5.9, 3.1]), 0.1, Kind.SOURCE).shares[Share.ROOM] = 0.5
    fit.refit()
    return fit


def test_harmonics_that_err_alone_add_their_own_variance(fit):
    component, starts = fit.components[0], fit.evidence.table.starts
    usual, alone = (
        Precision(fit.evidence, fit.components, errors=ComponentErrors(harmonic=share))
        for share in (0.0, 0.7)
    )
    paths, path = component.paths, Path.DIRECT
    heard = waves_heard(fit.evidence, paths.wave[path], paths.aperture[path], paths.gain[path])
    direct = heard * component.strength[fit.evidence.table.part]
    for band, (start, stop) in enumerate(pairwise(starts)):
        real, imaginary = np.split(direct[:, start:stop], 2, axis=1)
        variance = 0.7**2 * 0.5 * np.tile(real**2 + imaginary**2, 2)
        for scan in (0, 40, 80):
            added = np.linalg.inv(alone.inverse[band][scan]) - np.linalg.inv(
                usual.inverse[band][scan]
            )
            np.testing.assert_allclose(
                added, np.diag(variance[scan]), atol=2e-3 * variance[scan].max() + 1e-3
            )


def test_a_source_whose_bearing_is_sure_tells_more(fit):
    vague, sure = (
        Precision(fit.evidence, fit.components, errors=ComponentErrors(bearing=error))
        for error in (0.2, 0.02)
    )
    turned = next(iter(derivatives(fit, [(fit.components[0], 0)], slice(None))))
    assert np.sum(turned * sure.times(turned)) > 2.0 * np.sum(turned * vague.times(turned))


@pytest.mark.parametrize(
    ("path", "errors"),
    [(Path.DIRECT, ComponentErrors(strength=1.0)), (Path.FLOOR, ComponentErrors(reflection=1.0))],
    ids=["strength", "reflection"],
)
def test_what_may_be_louder_or_not_tells_less(fit, path, errors):
    usual, free = (
        Precision(fit.evidence, fit.components, errors=each) for each in (ComponentErrors(), errors)
    )
    paths, strength = fit.components[0].paths, fit.components[0].strength
    heard = waves_heard(fit.evidence, paths.wave[path], paths.aperture[path], paths.gain[path])
    heard *= strength[fit.evidence.table.part].astype(np.float32)
    assert np.sum(heard * free.times(heard)) < 0.9 * np.sum(heard * usual.times(heard))
