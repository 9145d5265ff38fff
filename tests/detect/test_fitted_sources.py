"""The fit of sources to scans from a rectangular room."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from soundmap.config import DetectConfig, ScanConfig
from soundmap.detect import fitted_sources as module
from soundmap.detect.fitted_sources import _erring_alike, _loud_side, _squares, fitted_sources
from tests.detect.box_room import observed


def run(emitters, **more):
    return fitted_sources(*observed(emitters, **more), ScanConfig(), DetectConfig())


@pytest.fixture(scope="module")
def reflected():
    """Two sources 10 dB apart, the louder with its mirror image in the wall y = 5."""
    return run([(6.0, 3.0, 50.0), (6.0, 7.0, 15.0), (2.5, 0.0, 5.0)])


def test_a_weak_source_is_found_beside_a_strong_one_and_its_image(reflected):
    places = [(source.x_m, source.y_m) for source in reflected]
    assert len(places) == 2
    np.testing.assert_allclose(places[1], (2.5, 0.0), atol=0.08)


def test_a_source_on_a_wall_is_found_where_it_is_with_its_level():
    (source,) = run([(5.9, 3.1, 20.0), (6.1, 3.1, 10.0)])
    np.testing.assert_allclose((source.x_m, source.y_m), (5.9, 3.1), atol=0.11)
    # The fit expects floor and ceiling to reflect, too, which these scans do not have.
    assert 10.0 * np.log10(source.power / 20.0) == pytest.approx(0.0, abs=1.5)
    assert source.fit is not None
    assert source.fit.false_alarm_probability < 1e-4


def test_an_image_behind_a_wall_is_told_from_the_source_in_front_of_another():
    found = run([(0.0, 2.5, 30.0), (12.0 - 4.6, 4.9, 8.0)])
    assert len(found) == 1
    assert len(found.reflections) >= 1


@pytest.mark.parametrize(("step", "found"), [((0.3, 0.2), True), ((0.4, 0.2), False)])
def test_sources_are_where_they_settle_if_that_is_near(monkeypatch, step, found):
    hanging = [(3.5, 3.2, 20.0)]
    (before,) = run(hanging)

    def settle(fit, components):
        (source,) = fit.components = list(components)
        source.place_m += step
        fit.refit()

    monkeypatch.setattr(module, "settle", settle)
    after = list(run(hanging))
    assert len(after) == found
    for source in after:
        away = source.x_m - before.x_m, source.y_m - before.y_m
        np.testing.assert_allclose(away, step, atol=0.05)


@pytest.mark.parametrize(
    ("first", "settled", "probability"),
    [
        (0.01, 1e-6, 0.7e-4),
        (0.01, 1.0, None),
        (0.11, 1e-3, 0.7 * np.sqrt(0.11e-3)),  # may settle, though too likely a ghost at first
        (0.13, 1e-9, None),
    ],
)
def test_a_source_is_told_from_ghosts_twice(monkeypatch, first, settled, probability):
    said = iter([first, settled])
    monkeypatch.setattr(
        module, "false_alarm_probabilities", lambda marks: np.full(len(marks.gain), next(said))
    )
    found = run([(3.5, 3.2, 20.0)])
    told = [source.fit.false_alarm_probability for source in found]
    assert told == pytest.approx([] if probability is None else [probability])


def test_what_settling_shows_to_be_a_ghost_takes_no_part_in_the_end(monkeypatch):
    settled = []

    def settle(fit, components):
        settled.append(len(components))
        fit.components = list(components)
        fit.refit()

    def probabilities(marks):
        return np.where(marks.gain < marks.gain.max(), 0.5 if settled else 0.01, 1e-4)

    monkeypatch.setattr(module, "settle", settle)
    monkeypatch.setattr(module, "false_alarm_probabilities", probabilities)
    (source,) = run([(5.9, 3.1, 20.0), (0.1, 3.0, 5.0)])
    assert settled[-1] == 1
    assert len(settled) == 2
    np.testing.assert_allclose((source.x_m, source.y_m), (5.9, 3.1), atol=0.1)


def test_the_ellipse_of_a_settled_source_goes_with_what_errs_alike(monkeypatch):
    reach = []
    for share in (0.6, 60.0):
        monkeypatch.setattr(module, "SETTLED_ALIKE", share)
        (source,) = run([(3.5, 3.2, 20.0)])  # in the open
        reach.append(np.sqrt(np.linalg.eigvalsh(source.fit.covariance_m2)[-1]))
    assert reach[1] > 3.0 * reach[0]


@pytest.mark.parametrize(
    ("silent", "reflected", "flagged"),
    [
        (0, 0.0, False),
        (1, 0.0, False),
        (4, 0.0, True),
        (0, 0.5, False),
        (1, 0.5, False),
        (4, 0.5, True),
        (6, 0.5, True),
    ],
)
def test_a_source_that_sounds_at_times_only_is_unsteady(silent, reflected, flagged):
    """Of each ten seconds, so many are silent."""
    place = (5.9, 3.1, 20.0)
    scans, *rest = observed([place], reflected=reflected)
    quiet, *_ = observed([(*place[:2], 1e-3)])
    pause = ((scans.time_ns - scans.time_ns[0]) * 1e-9 % 10.0 < silent)[:, None, None]
    parts = np.where(pause, quiet.sub_bands, scans.sub_bands)
    scans = replace(scans, power=parts.sum(axis=1), sub_bands=parts)
    (source,) = fitted_sources(scans, *rest, ScanConfig(), DetectConfig())
    assert ("unsteady" in source.fit.flags) == flagged
    assert "moving" not in source.fit.flags


def test_a_source_that_faces_along_its_wall_is_steady_and_as_loud_as_it_is_there():
    lobe = -2.0
    scans, around, track, array = observed([(5.9, 3.1, 20.0, (0.0, lobe))], reflected=0.5)
    (source,) = fitted_sources(scans, around, track, array, ScanConfig(), DetectConfig())
    np.testing.assert_allclose((source.x_m, source.y_m), (5.9, 3.1), atol=0.03)
    assert "unsteady" not in source.fit.flags
    away = track.at(scans.time_ns)[:, :2] - (source.x_m, source.y_m)
    sent = 20.0 * np.exp(lobe * away[:, 1] / np.hypot(*away.T))
    assert sent.min() < 0.2 * sent.max()
    assert 10.0 * np.log10(source.fit.power_1m / sent.max()) == pytest.approx(0.0, abs=1.0)
    assert sent.min() < source.power < sent.max()


def test_only_what_is_silent_now_and_then_may_move(monkeypatch):
    monkeypatch.setattr(module, "is_moving", lambda fit, component: True)
    place = 5.9, 3.1
    (steady,) = run([(*place, 20.0)])
    (other,) = run([lambda time_s: (*place, 20.0 if time_s % 10.0 < 8.0 else 1e-3)])
    assert "moving" not in steady.fit.flags
    assert "moving" in other.fit.flags


@pytest.mark.parametrize("seed", range(3))
def test_a_silent_run_has_no_source(seed):
    assert len(run([], seed=seed)) == 0


def test_the_level_is_that_of_the_loud_side_whatever_one_loud_stretch_says():
    weight = np.ones(8)
    facing = np.array([0.2, 0.3, 0.5, 0.8, 1.1, 1.4, 1.5, 6.0])
    assert _loud_side(facing, weight) == 1.4
    assert _loud_side(np.ones(1), np.ones(1)) == 1.0
    assert _loud_side(np.zeros(0), np.zeros(0)) == 1.0


def test_from_nearly_one_place_no_source_in_the_open_is_told():
    hanging = [(3.5, 3.2, 20.0)]
    assert len(run(hanging)) == 1
    assert len(run(hanging, speed_m_s=0.01)) == 0


def test_scans_of_half_a_metre_err_alike_lap_for_lap():
    lap = np.column_stack([0.1 * np.arange(50), np.full(50, 0.2)])
    once, twice = (_squares(SimpleNamespace(place_m=np.tile(lap, (n, 1)))) for n in (1, 2))
    assert np.array_equal(once, np.repeat(np.arange(10), 5))
    assert np.array_equal(twice, np.tile(once, 2))
    heard = SimpleNamespace(paths=SimpleNamespace(gain=np.ones((1, 50))))
    assert _erring_alike(heard, once) == pytest.approx(5.0)
    again = SimpleNamespace(paths=SimpleNamespace(gain=np.ones((1, 100))))
    assert _erring_alike(again, twice) == pytest.approx(10.0)


def test_a_source_high_above_the_array_is_found():
    (source,) = run([(5.0, 3.1, 20.0)], above_m=1.2)
    np.testing.assert_allclose((source.x_m, source.y_m), (5.0, 3.1), atol=0.1)
