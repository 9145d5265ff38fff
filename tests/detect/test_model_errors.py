"""The covariance of what scans hear, and its inverse."""

from itertools import pairwise

import numpy as np
import pytest

from soundmap.config import ScanConfig
from soundmap.detect.component import Share
from soundmap.detect.evidence import gathered_evidence
from soundmap.detect.model_errors import APERTURE_ERROR, ComponentErrors, Precision
from soundmap.detect.sound_paths import Kind, Path, waves_heard
from soundmap.detect.sparse_fit import SparseFit
from soundmap.detect.unknowns import derivatives
from tests.detect.box_room import begun_fit, observed


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


def test_what_errors_may_add_counts_no_more_than_chance_does():
    """Along every path, and with its bearing and elevation."""
    fit = begun_fit([(5.5, 3.1, 200.0)], reflected=0.5)
    component = fit.add(np.array([5.5, 3.1]), 0.1, Kind.SOURCE)
    fit.refit()
    evidence, paths, usual = fit.evidence, component.paths, ComponentErrors()
    part = evidence.table.part

    def heard(path, lowered=0.0, *, turned=False):
        own = paths.wave[path], paths.aperture[path] - lowered, paths.gain[path]
        return component.strength[part] * waves_heard(evidence, *own, turned=turned)

    walls = [path for path in range(Path.WALLS, len(paths.gain)) if paths.gain[path].any()]
    assert walls
    modes = [usual.reflection * heard(path) for path in (Path.FLOOR, *walls)]
    modes.append(usual.strength * heard(Path.DIRECT))
    bearing = usual.bearing * evidence.table.width_rad[part]
    modes.append(bearing * heard(Path.DIRECT, turned=True))
    modes.append(heard(Path.DIRECT) - heard(Path.DIRECT, APERTURE_ERROR))
    precision = Precision(evidence, fit.components)
    for mode in modes:
        single = mode.astype(np.float32)
        starts = evidence.table.starts[:-1]
        counted, alone = (
            np.add.reduceat(single * other, starts, axis=1)
            for other in (precision.times(single), single)
        )
        assert counted.max() < 1.01
        assert alone.max() > 2.0
