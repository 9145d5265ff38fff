"""Machines that fall silent now and then are louder while they sound than on average."""

from types import SimpleNamespace

import numpy as np
import pytest

from soundmap.config import DetectConfig, ScanConfig
from soundmap.detect import pauses as module
from soundmap.detect.fitted_sources import fitted_sources
from soundmap.detect.pauses import CHANGE, SHORTEST_S, _cheapest, _shortest_s, find_pauses
from soundmap.detect.sound_paths import Kind
from tests.detect.box_room import begun_fit, observed
from tests.detect.test_wandering import walker

MACHINE = (5.9, 3.1, 20.0)
PLACE = (0.1, 3.0)


def valve(period_s, power=10.0):
    """Sounds for the first half of each period."""
    return lambda time_s: (*PLACE, power if time_s % period_s < 0.5 * period_s else 1e-3)


def fitted(second, place):
    fit = begun_fit([MACHINE, second], reflected=0.5)
    for where in (MACHINE[:2], place):
        fit.add(np.array(where), 0.1, Kind.SOURCE)
    fit.refit()
    fit.renew()
    before = [component.strength.sum() for component in fit.components]
    find_pauses(fit)
    return fit, before


def test_a_valve_is_as_loud_as_it_sounds_and_silent_while_it_pauses():
    fit, before = fitted(valve(5.0), PLACE)
    machine, other = fit.components
    assert machine.sounding is None
    sounds = fit.evidence.time_s % 5.0 < 2.5
    assert np.mean(other.sounding == sounds) > 0.95
    assert not other.column[~other.sounding].any()
    assert 10.0 * np.log10(before[1] / 10.0) < -2.0
    assert 10.0 * np.log10(other.strength.sum() / 10.0) == pytest.approx(0.0, abs=0.7)


@pytest.mark.parametrize(
    ("second", "place"),
    [
        ((*PLACE, 10.0), PLACE),  # steady
        (valve(20.0), PLACE),  # heard to stop once
        (valve(0.8), PLACE),  # beats
        (walker, (2.4, 4.2)),
    ],
)
def test_nothing_else_pauses(second, place):
    fit, _ = fitted(second, place)
    assert [component.sounding for component in fit.components] == [None, None]


def test_a_source_that_pauses_is_unsteady_and_has_the_level_at_which_it_sounds():
    sounding, steady = (
        next(iter(fitted_sources(*observed([each], reflected=0.5), ScanConfig(), DetectConfig())))
        for each in (valve(5.0), (*PLACE, 10.0))
    )
    assert "unsteady" in sounding.fit.flags
    assert "unsteady" not in steady.fit.flags
    assert 10.0 * np.log10(sounding.power / steady.power) == pytest.approx(0.0, abs=0.7)


def test_states_change_where_that_pays():
    worth = CHANGE + 1.0
    cost = np.repeat([-9.0, worth / 5, -9.0, 2.5 * worth / 5, -9.0], [20, 5, 20, 5, 20])
    expected = np.repeat([True, False, True], [45, 5, 20])
    assert np.array_equal(_cheapest(cost, CHANGE), expected)
    assert not _cheapest(np.full(9, 0.1), CHANGE).any()


def test_the_shortest_state_lies_between_two_changes():
    time_s = 0.5 * np.arange(10)
    states = np.array([1, 0, 0, 0, 1, 1, 1, 1, 1, 0], dtype=bool)
    assert _shortest_s(states, time_s) == pytest.approx(1.5)
    assert _shortest_s(np.ones(10, dtype=bool), time_s) > SHORTEST_S


def phases(*lasts_s):
    """States of scans every 0.1 s, sounding first."""
    return np.repeat(np.arange(len(lasts_s)) % 2 == 0, np.round(10 * np.array(lasts_s)).astype(int))


@pytest.mark.parametrize(
    ("states", "loudness", "pauses"),
    [
        (phases(3.0, 3.0, 3.0, 3.0, 3.0), 50.0, True),
        (phases(3.0, 3.0, 3.0, 6.0), 50.0, False),  # changes three times
        (phases(3.0, 3.0, 0.4, 3.0, 3.0), 500.0, False),  # a click
        (phases(3.0, 3.0, 3.0, 3.0, 3.0), 8.0, False),  # hardly heard
        (phases(9.0, 0.8, 9.0, 0.8, 9.0), 50.0, False),  # hardly silent
    ],
)
def test_pauses_are_long_many_and_worth_it(monkeypatch, states, loudness, pauses):
    energy = np.full((len(states), 1), loudness)
    monkeypatch.setattr(module, "_told", lambda fit, index: (energy * states[:, None], energy))
    monkeypatch.setattr(module, "is_moving", lambda fit, component: False)
    component = SimpleNamespace(kind=Kind.SOURCE, sounding=None)
    evidence = SimpleNamespace(time_s=0.1 * np.arange(len(states)))
    worth, sounding = module._states(SimpleNamespace(components=[component], evidence=evidence), 0)
    assert (worth > 0.0) == pauses
    assert sounding is None or np.array_equal(sounding, states)
