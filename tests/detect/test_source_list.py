import numpy as np
import pytest

from soundmap.config import DetectConfig
from soundmap.detect.source_list import detect_sources
from soundmap.grid import GridFrame
from soundmap.sound import LevelReference, PowerMap

FRAME = GridFrame(0.05, (10.0, -2.0), (40, 60))


def power_map(peaks):
    power, visits = np.zeros(FRAME.shape), np.zeros(FRAME.shape, dtype=np.int64)
    for row, column, mean, count in peaks:
        power[row, column], visits[row, column] = mean * count, count
    return PowerMap(FRAME, power, visits, LevelReference.FULL_SCALE)


def test_sources_are_listed_loudest_first_with_place_power_and_visits():
    sources = list(detect_sources(power_map([(5, 6, 2.0, 50), (30, 40, 7.0, 40)]), DetectConfig()))
    assert [(s.power, s.visits) for s in sources] == [(7.0, 40), (2.0, 50)]
    assert (sources[0].x_m, sources[0].y_m) == pytest.approx((12.025, -0.475))


def test_only_cells_with_more_than_a_tenth_of_the_greatest_visits_count():
    exactly = power_map([(5, 6, 1.0, 100), (30, 40, 9.0, 10), (20, 20, 8.0, 11)])
    found = [source.visits for source in detect_sources(exactly, DetectConfig())]
    assert found == [11, 100]


def test_doubling_the_power_changes_no_place():
    peaks = [(5, 6, 2.0, 50), (30, 40, 7.0, 40)]
    once = detect_sources(power_map(peaks), DetectConfig())
    twice = detect_sources(power_map([(r, c, 2 * p, n) for r, c, p, n in peaks]), DetectConfig())
    assert [(s.x_m, s.y_m) for s in once] == [(s.x_m, s.y_m) for s in twice]
    assert [2 * s.power for s in once] == [s.power for s in twice]


def test_a_map_without_measurements_has_no_source():
    assert len(detect_sources(power_map([]), DetectConfig())) == 0
