"""What became of sources: matched by place, judged by measured errors."""

import numpy as np
import pytest

from soundmap.change import ChangeKind
from soundmap.config import DiffConfig
from soundmap.detect.place_levels import PlaceLevels
from soundmap.detect.source_changes import (
    chance_of_change,
    matched_sources,
    paired_places,
    source_changes,
)
from soundmap.sound import LevelReference, Source, SourceFit, SourceList

TEN = 10.0


def sources(*places, sigma_m=0.02):
    fit = SourceFit(1e-7, sigma_m**2 * np.eye(2), 0.0, 1.0, ())
    made = tuple(Source(x, y, 1e-7, 50, fit) for x, y in places)
    return SourceList(made, LevelReference.FULL_SCALE)


def heard(power, error=0.05, freedom=TEN):
    power = np.array(power, dtype=float)
    sigma = np.where(power > 0.01, error * power, error * 0.1)
    return PlaceLevels(power, sigma, np.full(len(power), freedom))


def changes(run, background, pairs=None):
    count = len(run.power_1m)
    pairs = pairs or [(i, i) for i in range(count)]
    return source_changes(pairs, np.zeros((count, 2)), [7] * count, run, background, DiffConfig())


def test_sources_are_matched_one_to_one_by_distance():
    run, background = sources((1, 1), (3, 1), (1.2, 1)), sources((3.02, 1), (1.05, 1))
    assert matched_sources(run, background) == [(1, 0), (0, 1), (2, None)]


def test_uncertain_places_match_from_farther_away():
    far = (0.4, 0.0)
    assert matched_sources(sources((0, 0)), sources(far)) == [(0, None), (None, 0)]
    vague = sources(far, sigma_m=0.15)
    assert matched_sources(sources((0, 0), sigma_m=0.15), vague) == [(0, 0)]


def test_each_run_is_asked_at_its_own_place_and_at_the_others_where_it_has_none():
    run, background = sources((1, 1), (3, 1)), sources((1.05, 1), (5, 5))
    here, there = paired_places(matched_sources(run, background), run, background)
    assert here.tolist() == [[1, 1], [3, 1], [5, 5]]
    assert there.tolist() == [[1.05, 1], [3, 1], [5, 5]]


def test_four_kinds_of_change_and_none():
    run, background = heard([1, 1, 1, 0.0, 1]), heard([1, 0.25, 4, 1, 0.0])
    pairs = [(0, 0), (1, 1), (2, 2), (None, 3), (3, None)]
    kinds = [change.kind for change in changes(run, background, pairs)]
    assert kinds == ["unchanged", "louder", "quieter", "gone", "appeared"]


def test_change_has_its_ratio_its_error_and_where_it_was_found():
    (change,) = changes(heard([2.0]), heard([1.0]))
    assert change.ratio_db == pytest.approx(10 * np.log10(2))
    assert change.sigma_db == pytest.approx(10 / np.log(10) * np.hypot(0.05, 0.05))
    assert (change.run_source, change.background_source, change.visits) == (0, 0, 7)


def test_of_silence_the_error_stands_in_and_the_change_is_at_least_so_great():
    (change,) = changes(heard([1.0]), heard([-0.002]), [(0, None)])
    assert change.ratio_db == pytest.approx(10 * np.log10(1.0 / 0.005))
    assert change.sigma_db is None


def test_the_same_change_with_greater_errors_is_none():
    assert changes(heard([2.0], 0.05), heard([1.0], 0.05))[0].kind == ChangeKind.LOUDER
    assert changes(heard([2.0], 0.3), heard([1.0], 0.3))[0].kind == ChangeKind.UNCHANGED
    assert changes(heard([2.0], 0.05, 1.0), heard([1.0], 0.05, 1.0))[0].kind == "unchanged"


def test_what_cannot_be_told_is_said():
    unknown = PlaceLevels(np.array([np.nan]), np.array([np.nan]), np.zeros(1))
    (change,) = changes(heard([1.0]), unknown)
    assert change.kind == ChangeKind.UNTOLD
    assert change.false_alarm_probability is None


def test_exchanged_runs_exchange_the_kinds_and_the_sign():
    run, background = heard([1, 1, 3, 0.0]), heard([1, 4, 1, 1])
    there = changes(run, background, [(0, 0), (1, 1), (2, 2), (None, 3)])
    back = changes(background, run, [(0, 0), (1, 1), (2, 2), (3, None)])
    assert [c.ratio_db for c in back] == pytest.approx([-c.ratio_db for c in there])
    assert [c.kind for c in back] == ["unchanged", "louder", "quieter", "appeared"]
    a, b = ([c.false_alarm_probability for c in each] for each in (there, back))
    assert a == pytest.approx(b)


def test_unchanged_sources_are_called_changed_no_more_often_than_stated():
    rng = np.random.default_rng(3)
    count, stretches = 20_000, 8
    strengths = 1.0 + 0.2 * rng.standard_normal((2, stretches, count))
    power = strengths.mean(axis=1)
    sigma = strengths.std(axis=1, ddof=1) / np.sqrt(stretches)
    run, background = (
        PlaceLevels(power[i], sigma[i], np.full(count, stretches - 1.0)) for i in range(2)
    )
    chance = chance_of_change(run, background, margin_db=0.0)
    for rate in (0.01, 0.05):
        assert (chance < rate).mean() == pytest.approx(rate, rel=0.2)
    margin = chance_of_change(run, background, margin_db=1.5)
    assert (margin < 0.01).mean() < 0.001
