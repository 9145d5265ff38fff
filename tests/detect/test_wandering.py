"""What goes about is told from what stands."""

import numpy as np
import pytest

from soundmap.detect.sound_paths import Kind
from soundmap.detect.sparse_fit import SparseFit
from soundmap.detect.walls import surface_points, wall_lines
from soundmap.detect.wandering import CELLS, _best_way, is_moving
from tests.detect.box_room import begun_fit

MACHINE = (5.9, 3.1, 20.0)


def walker(time_s):
    """To and fro between x = 0.8 and 4 m, at 0.8 m/s."""
    return 0.8 + 3.2 * abs(1.0 - time_s / 4.0 % 2.0), 4.2, 10.0


def valve(time_s):
    return 2.4, 4.2, 10.0 if time_s % 6.0 < 3.0 else 1e-3


@pytest.mark.parametrize(("second", "moves"), [(walker, True), (valve, False)])
def test_who_walks_moves_what_stands_does_not_be_it_silent_now_and_then(second, moves):
    fit = begun_fit([MACHINE, second])
    machine = fit.add(np.array(MACHINE[:2]), 0.1, Kind.SOURCE)
    other = fit.add(np.array([2.4, 4.2]), 0.1, Kind.SOURCE)
    fit.refit()
    fit.renew()
    assert is_moving(fit, other) == moves
    assert not is_moving(fit, machine)


def test_of_a_few_seconds_nothing_is_told():
    whole = begun_fit([MACHINE, walker]).evidence
    for last_s, moves in ((20.0, True), (7.0, False)):
        evidence = whole.chosen(np.flatnonzero(whole.time_s < last_s))
        fit = SparseFit(evidence, wall_lines(surface_points(evidence)))
        fit.add(np.array(MACHINE[:2]), 0.1, Kind.SOURCE)
        other = fit.add(np.array([2.4, 4.2]), 0.1, Kind.SOURCE)
        fit.refit()
        fit.renew()
        assert is_moving(fit, other) == moves


def test_a_way_is_no_faster_than_someone_walks():
    told = np.zeros((3, CELLS, CELLS))
    told[0, 10, 10] = told[2, 10, 10] = 1.0
    told[1, 10, 14] = 5.0  # a metre away
    for wait_s, most in ((0.8, 7.0), (0.3, 5.0)):
        assert _best_way(wait_s * np.arange(3.0), told.reshape(3, -1)) == most
