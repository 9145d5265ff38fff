import numpy as np

from soundmap.detect.significance import GHOST_GAIN, GHOST_RATE, false_alarm_probabilities


def test_a_ghost_of_the_usual_size_is_as_probable_as_was_measured():
    (value,) = false_alarm_probabilities(np.array([GHOST_GAIN]), np.array([True]))
    np.testing.assert_allclose(value, GHOST_RATE, rtol=1e-6)


def test_what_stands_in_the_open_or_beside_something_loud_has_to_explain_more():
    alone, in_open = false_alarm_probabilities(np.array([400.0, 400.0]), np.array([True, False]))
    assert alone < 0.1 * in_open
    beside, _ = false_alarm_probabilities(np.array([400.0, 20_000.0]), np.array([True, True]))
    assert beside > 10.0 * alone


def test_probabilities_stay_between_0_and_1():
    gains = np.array([0.0, 1e-3, 1e9])
    values = false_alarm_probabilities(gains, np.array([True, False, True]))
    assert np.all((values >= 0.0) & (values <= 1.0))
