"""Sound that comes from the same bearings of the map wherever the robot stands."""

from dataclasses import replace

import numpy as np
import pytest

from soundmap.config import DetectConfig, ScanConfig
from soundmap.detect.evidence import gathered_evidence
from soundmap.detect.far_field import FarField
from soundmap.detect.fitted_sources import fitted_sources
from soundmap.detect.model_errors import Precision
from soundmap.detect.sound_paths import waves_heard
from tests.detect.box_room import observed

FAR = [(0.3, 0.8), (1.9, 0.5), (2.6, 1.0), (4.4, 0.7)]
SOURCE = (5.9, 3.1)


def sources(emitters, **more):
    return fitted_sources(*observed(emitters, **more), ScanConfig(), DetectConfig())


@pytest.fixture(scope="module")
def evidence():
    return gathered_evidence(*observed([(*SOURCE, 8.0)], far=FAR), ScanConfig())


def test_what_has_no_place_is_no_source():
    assert len(sources([], far=FAR)) == 0


def test_a_source_before_a_far_field_is_found_alone_and_where_it_is():
    (found,) = sources([(*SOURCE, 8.0)], far=FAR)
    np.testing.assert_allclose((found.x_m, found.y_m), SOURCE, atol=0.08)


def test_a_far_field_does_not_take_a_source_away():
    plain = sources([(*SOURCE, 8.0)])
    before = sources([(*SOURCE, 8.0)], far=FAR)
    assert before.sources[0].power == pytest.approx(plain.sources[0].power, rel=0.25)


@pytest.mark.parametrize("hand", [1, -1])
def test_one_far_wave_is_heard_as_a_wave_from_its_bearing(evidence, hand):
    evidence = replace(evidence, handedness=hand, turn_rad=0.0 * evidence.turn_rad)
    bearing = 1.1
    phases = [bearing * np.arange(1, len(factor) + 1) for factor in evidence.table.factor]
    field = [part for phase in phases for part in (np.cos(phase), np.sin(phase))]
    heard = FarField(evidence).heard(np.concatenate(field))
    wave = hand * (bearing - evidence.axis_rad) / (2.0 * np.pi) % 1.0 * evidence.table.waves
    ones = np.ones(len(evidence))
    expected = waves_heard(evidence, wave, ones, ones)
    for start, stop in zip(evidence.table.starts[:-1], evidence.table.starts[1:], strict=True):
        count = (stop - start) // 2
        for harmonic in (start, start + count // 2):  # in phase, however strong each is
            pairs = [harmonic, harmonic + count]
            got, wanted = heard[:, pairs], expected[:, pairs]
            along = np.sum(got * wanted, axis=1)
            sizes = np.linalg.norm(got, axis=1) * np.linalg.norm(wanted, axis=1)
            np.testing.assert_allclose(along / sizes, 1.0, atol=3e-3)  # beams are interpolated


def test_its_part_of_the_normal_equations_is_that_of_its_columns(evidence):
    far, precision = FarField(evidence), Precision(evidence, [])
    size = int(evidence.table.starts[-1])
    columns = np.stack([far.heard(unit) for unit in np.eye(size)]).astype(np.float64)
    heard = evidence.heard.astype(np.float64)
    np.testing.assert_allclose(
        far.pull(evidence.heard), np.einsum("fsd,sd->f", columns, heard), rtol=1e-3, atol=0.05
    )
    np.testing.assert_allclose(
        far.pulls(evidence.heard).sum(axis=0), far.pull(evidence.heard), rtol=1e-3, atol=0.05
    )
    normal = np.einsum("fsd,gsd->fg", columns, columns)
    inverse = np.linalg.inv(far.inverse(precision))
    held = inverse - normal
    scale = float(np.diag(normal).mean())
    np.testing.assert_allclose(held, np.diag(np.diag(held)), atol=2e-4 * scale)
    assert np.all(np.diag(held) > 0.0)
    assert np.all(np.diag(held) < 0.1 * np.diag(normal))


@pytest.mark.parametrize("hand", [1, -1])
def test_a_far_field_changes_as_the_array_turns(evidence, hand):
    evidence = replace(evidence, handedness=hand)
    field = np.random.default_rng(3).standard_normal(int(evidence.table.starts[-1]))
    step = 1e-3
    before, after = (
        FarField(replace(evidence, axis_rad=evidence.axis_rad + side * step)).heard(field)
        for side in (-1.0, 1.0)
    )
    turned = FarField(evidence).turned(field)
    assert np.abs(turned - (after - before) / (2.0 * step)).max() < 2e-3 * np.abs(turned).max()
