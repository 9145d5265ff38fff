import dataclasses

import numpy as np
import pytest

from soundmap.detect.significance import (
    GHOST_RATE,
    PER_STEADINESS,
    Marks,
    false_alarm_probabilities,
    log_odds,
)

USUAL = Marks(
    gain=np.array([400.0]),
    steadiness=np.array([5.0]),
    surface_odds=np.array([10.0]),
    behind_m=np.array([0.0]),
)


@pytest.mark.parametrize(
    "worse",
    [
        {"gain": np.array([200.0])},
        {"steadiness": np.array([2.0])},
        {"behind_m": np.array([0.4])},
        {"surface_odds": np.array([0.1])},
    ],
    ids=lambda marks: next(iter(marks)),
)
def test_whatever_ghosts_are_like_makes_a_false_alarm_likelier(worse):
    (usual,) = false_alarm_probabilities(USUAL)
    (ghostly,) = false_alarm_probabilities(dataclasses.replace(USUAL, **worse))
    assert ghostly > 1.5 * usual


def test_beside_something_loud_the_same_is_likelier_a_ghost():
    both = Marks(*(np.repeat(getattr(USUAL, field.name), 2) for field in dataclasses.fields(Marks)))
    alone, _ = false_alarm_probabilities(both)
    beside, _ = false_alarm_probabilities(dataclasses.replace(both, gain=np.array([400.0, 9e3])))
    assert beside > 10.0 * alone


def test_even_odds_are_as_probable_as_was_measured():
    score = log_odds(USUAL)
    even = dataclasses.replace(USUAL, steadiness=USUAL.steadiness - score / PER_STEADINESS)
    np.testing.assert_allclose(false_alarm_probabilities(even), GHOST_RATE, rtol=1e-6)


def test_to_lie_far_behind_a_surface_tells_no_more_than_to_lie_clearly_behind_it():
    behind = [dataclasses.replace(USUAL, behind_m=np.array([each])) for each in (0.02, 0.05, 0.5)]
    little, clearly, far = (float(log_odds(marks)[0]) for marks in behind)
    assert little > clearly == far


def test_probabilities_stay_between_0_and_1():
    extreme = Marks(
        gain=np.array([0.0, 1e-3, 1e9]),
        steadiness=np.array([0.0, 0.0, 1e9]),
        behind_m=np.array([2.0, 0.0, 0.0]),
        surface_odds=np.array([0.0, 0.0, 1e9]),
    )
    values = false_alarm_probabilities(extreme)
    assert np.all((values >= 0.0) & (values <= 1.0))
