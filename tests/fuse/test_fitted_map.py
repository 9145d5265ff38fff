"""The map of a rectangular room, whose walls every range meets, from scans made by the physics."""

from dataclasses import replace

import numpy as np
import pytest
from heard import circle, drive, heard_scans

from soundmap.config import FuseConfig, ScanConfig
from soundmap.fuse.fitted_map import fitted_power_map, mapped_scans
from soundmap.grid import GridFrame
from soundmap.sensors import MicArray
from soundmap.sound import LevelReference, Source, SourceFit, SourceList, decibels

WIDTH, HEIGHT = 6.0, 4.5
FRAME = GridFrame(0.05, (-0.5, -0.5), (110, 140))
TRUTH = drive([(1.0, 1.0), (5.0, 1.0), (5.0, 3.5), (1.0, 3.5)])
PLACE, LOUDNESS = (3.0, 0.05), 2e-6
OPPOSITE = (3.0, 4.5)
SCANS = heard_scans(TRUTH, [(*PLACE, LOUDNESS)], seed=1)
ARRAY = MicArray(circle(), SCANS.mount, None)


def ranges(trajectory=TRUTH):
    """To the walls, on 360 bearings of the array, which looks as the robot does."""
    x, y, heading = trajectory.pose.T[..., None]
    angle = heading + 2 * np.pi * np.arange(360) / 360
    cos, sin = np.cos(angle), np.sin(angle)
    along = np.where(cos > 0, WIDTH - x, x) / np.maximum(np.abs(cos), 1e-9)
    across = np.where(sin > 0, HEIGHT - y, y) / np.maximum(np.abs(sin), 1e-9)
    return np.minimum(along, across).astype(np.float32)


def source(place=PLACE, power=LOUDNESS, sigma_m=0.02):
    fit = SourceFit(power, sigma_m**2 * np.eye(2), 1e-9, 2.0, (), 0.5)
    return Source(*place, power, 90, fit)


def mapped(sources, scans=SCANS, around=None):
    listed = SourceList(tuple(sources), LevelReference.FULL_SCALE)
    around = ranges() if around is None else around
    return fitted_power_map(listed, scans, around, TRUTH, ARRAY, FRAME, ScanConfig(), FuseConfig())


def at(place, values):
    """The value of the cell that holds a place."""
    return values[tuple(FRAME.cells(place))]


def near(place, values):
    """The greatest value within 0.2 m of a place."""
    row, column = FRAME.cells(place)
    return np.nanmax(values[row - 4 : row + 5, column - 4 : column + 5])


def test_a_source_has_its_level_and_is_the_loudest_of_the_map():
    power_map = mapped([source()])
    level = decibels(power_map.power(min_visit_share=0.1))
    assert at(PLACE, level) == pytest.approx(decibels(LOUDNESS), abs=0.5)
    assert not at(PLACE, power_map.is_limit)
    row, column = np.unravel_index(np.nanargmax(level), level.shape)
    assert np.hypot(*(FRAME.centres((row, column)) - PLACE)) < 0.06


def test_a_wall_that_only_lies_behind_or_opposite_is_no_more_than_a_low_limit():
    power_map = mapped([source()])
    level = decibels(power_map.power(min_visit_share=0.1))
    assert near(OPPOSITE, level) < decibels(LOUDNESS) - 10.0
    centres = FRAME.centres(np.moveaxis(np.indices(FRAME.shape), 0, -1))
    distance = np.hypot(*np.moveaxis(centres - np.array(PLACE), -1, 0))
    assert power_map.is_limit[distance > 0.4].all()
    assert np.nanmax(level[distance > 0.4]) < decibels(LOUDNESS) - 4.0
    assert np.nanmax(level[distance > 1.2]) < decibels(LOUDNESS) - 8.0


def test_what_no_laser_met_is_empty_but_for_a_source_that_hangs_there():
    hanging = (3.0, 2.2)
    power = mapped([source(), source(hanging, 0.5 * LOUDNESS)]).power()
    assert at(hanging, power) == pytest.approx(0.5 * LOUDNESS, rel=0.1)
    assert np.isnan(at((2.0, 2.2), power))
    assert np.isnan(at((-0.4, 2.2), power))


def test_without_a_source_every_level_is_a_limit_and_finite():
    power_map = mapped([])
    power = power_map.power()
    assert power_map.is_limit.all()
    assert np.isfinite(power[power_map.visits > 0]).all()
    assert (power_map.visits > 0).sum() > 500
    assert (power[power_map.visits > 0] > 0).all()


def test_a_source_that_was_missed_keeps_a_higher_limit_than_the_rest():
    level = decibels(mapped([]).power())
    assert near(PLACE, level) > np.nanmedian(level) + 6.0


def test_an_uncertain_place_gets_a_larger_spot():
    sure, unsure = (mapped([source(sigma_m=sigma)]) for sigma in (0.02, 0.3))
    assert (~unsure.is_limit).sum() > 3 * (~sure.is_limit).sum()


def test_twice_the_power_is_three_decibels_everywhere():
    once = decibels(mapped([source()]).power())
    loud = replace(SCANS, power=2 * SCANS.power)
    twice = decibels(mapped([source(power=2 * LOUDNESS)], loud).power())
    seen = np.isfinite(once)
    np.testing.assert_allclose((twice - once)[seen], 10 * np.log10(2), atol=1e-4)


def test_silence_and_unknown_ranges_leave_no_warning_and_nothing_but_the_truth():
    silent = mapped([], replace(SCANS, power=np.zeros_like(SCANS.power)))
    assert (silent.power()[silent.visits > 0] == 0).all()
    blind = mapped([], around=np.full((len(SCANS), 360), np.nan, np.float32))
    assert not blind.visits.any()
    outside = mapped([source((40.0, 40.0))])
    assert outside.is_limit.all()


def test_only_the_scans_of_the_map_need_ranges(monkeypatch):
    monkeypatch.setattr("soundmap.fuse.fitted_map.MOST_SCANS", 40)
    needed = mapped_scans(SCANS, TRUTH)
    assert len(needed) == 40
    others = np.setdiff1d(np.arange(len(SCANS)), needed)
    around = ranges()
    around[others] = np.nan
    whole, part = mapped([source()]), mapped([source()], around=around)
    assert np.array_equal(whole.power_sum, part.power_sum)
