import dataclasses

import numpy as np
import pytest

from soundmap.detect.evidence import Evidence
from soundmap.detect.harmonics import BeamTable
from soundmap.detect.regions import MARGIN_M, MOST_IN_REGION, MOST_SCANS, regions

TABLE = BeamTable(np.zeros((1, 1, 0), np.float32), np.zeros(1, np.int64), (), np.zeros(0))


def evidence_at(place):
    count = len(place)
    return Evidence(
        time_s=np.arange(count, dtype=float),
        place_m=place,
        axis_rad=np.zeros(count),
        handedness=1,
        height_m=0.5,
        turn_rad=np.zeros(count),
        merged=np.ones(count, np.int64),
        range_m=np.zeros((count, 4), np.float32),
        heard=np.zeros((count, 0), np.float32),
        weight=np.zeros((count, 0)),
        table=TABLE,
    )


def test_a_short_run_is_one_region():
    evidence = evidence_at(np.random.default_rng(1).uniform(-50.0, 50.0, (MOST_SCANS, 2)))
    (region,) = regions(evidence)
    assert region.evidence is evidence
    assert region.owns(np.array([1e6, -1e6]))


@pytest.fixture(scope="module")
def long_run():
    place = np.random.default_rng(2).uniform([0.0, 0.0], [70.0, 40.0], (6000, 2))
    return place, list(regions(evidence_at(place)))


def test_every_place_is_in_exactly_one_region(long_run):
    _, parts = long_run
    for place in np.random.default_rng(3).uniform(-30.0, 100.0, (200, 2)):
        assert sum(region.owns(place) for region in parts) == 1


def test_a_region_hears_what_is_near_it_and_no_more_than_it_can_bear(long_run):
    place, parts = long_run
    for region in parts:
        own = [region.owns(each) for each in region.evidence.place_m]
        assert sum(own) > 0
        assert len(region.evidence) <= MOST_IN_REGION
        low = np.maximum(region.low_m, place.min(axis=0)) - MARGIN_M
        assert np.all(region.evidence.place_m >= low)


def test_chosen_scans_keep_all_that_is_known_of_them():
    evidence = evidence_at(np.arange(20.0).reshape(10, 2))
    few = evidence.chosen(np.array([3, 7]))
    for field in dataclasses.fields(few):
        value = getattr(few, field.name)
        if isinstance(value, np.ndarray):
            assert len(value) == 2
    np.testing.assert_array_equal(few.place_m, [[6.0, 7.0], [14.0, 15.0]])
