import dataclasses

import numpy as np
import pytest

from soundmap.change import ChangeKind
from soundmap.detect.difference import (
    CellLevels,
    cell_levels,
    chance,
    changed_cells,
    family_chance,
    power_ratio,
    seen_from_the_other_side,
)
from soundmap.grid import GridFrame
from soundmap.sound import LevelReference, PowerMap, decibels

FRAME = GridFrame(0.05, (0.0, 0.0), (30, 40))


def maps(seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(1, 2, FRAME.shape), rng.uniform(1, 2, FRAME.shape)


def known(power, sigma_db=0.5, freedom=9.0):
    """Levels of cells of a known error."""
    level = decibels(power)
    return CellLevels(level, np.full(level.shape, sigma_db), np.full(level.shape, freedom))


def ratio_of(power, frame, background, background_frame):
    ratio, measured = power_ratio(known(power), frame, known(background), background_frame)
    return ratio.level_db, measured


def test_ratio_is_the_difference_in_decibels():
    power, background = maps()
    ratio, measured = ratio_of(power, FRAME, background, FRAME)
    assert np.allclose(ratio, 10 * np.log10(power) - 10 * np.log10(background))
    assert measured.all()


def test_ten_times_the_power_is_ten_decibels():
    power, _ = maps()
    ratio, _ = ratio_of(10 * power, FRAME, power, FRAME)
    assert ratio == pytest.approx(10.0)


def test_two_limits_tell_of_no_difference_but_a_source_against_a_limit_does():
    power, background = maps()
    ones = np.ones(FRAME.shape, dtype=bool)
    some = ones.copy()
    some[3, 4] = False
    background[7, 8] = np.nan
    run = dataclasses.replace(known(10 * power), is_limit=some)
    other = dataclasses.replace(known(background), is_limit=ones)
    ratio, measured = power_ratio(run, FRAME, other, FRAME)
    assert not measured[7, 8]
    assert (ratio.level_db[some] == 0.0).all()
    assert (chance(ratio)[some] == 1.0).all()
    assert ratio.level_db[3, 4] == pytest.approx(decibels(10 * power / background)[3, 4])


def test_grids_need_not_coincide():
    power, _ = maps()
    other = GridFrame(0.05, (-0.45, 0.31), (60, 70))
    centres = other.centres(np.moveaxis(np.indices(other.shape), 0, -1))
    background = 1.0 + centres[..., 0] + 10 * centres[..., 1]
    ratio, measured = ratio_of(power, FRAME, background, other)
    here = FRAME.centres(np.moveaxis(np.indices(FRAME.shape), 0, -1))
    expected = 1.0 + here[..., 0] + 10 * here[..., 1]
    off = 10 ** ((10 * np.log10(power) - ratio) / 10) - expected
    assert np.abs(off[measured]).max() < 0.03 * 11
    assert not measured[:6].any(), "rows below the background's grid"


def test_where_only_the_run_measured_the_median_of_the_background_stands_in():
    power, background = maps()
    background[3, 4] = np.nan
    ratio, measured = power_ratio(known(power), FRAME, known(background), FRAME)
    assert not measured[3, 4]
    median = np.median(background[np.isfinite(background)])
    assert ratio.level_db[3, 4] == pytest.approx(10 * np.log10(power[3, 4] / median))
    level = 10 * np.log10(background[np.isfinite(background)])
    scatter = 1.4826 * np.median(np.abs(level - np.median(level)))
    assert ratio.sigma_db[3, 4] == pytest.approx(np.hypot(0.5, scatter))


def test_where_only_the_background_measured_there_is_no_ratio():
    power, background = maps()
    power[3, 4] = np.nan
    assert np.isnan(ratio_of(power, FRAME, background, FRAME)[0][3, 4])


def test_an_unmeasured_background_is_refused():
    power, _ = maps()
    with pytest.raises(ValueError, match="no measurement"):
        ratio_of(power, FRAME, np.full(FRAME.shape, np.nan), FRAME)


def test_changes_are_the_maxima_above_the_threshold():
    level = np.zeros(FRAME.shape)
    level[5, 5], level[20, 30], level[25, 8] = 12.0, 6.0, 2.0
    measured = np.ones(FRAME.shape, dtype=bool)
    measured[20, 30] = False
    ratio = CellLevels(level, np.full(level.shape, 1.5), np.full(level.shape, 9.0))
    visits = np.full(FRAME.shape, 7, dtype=np.int64)
    changes = changed_cells(ratio, visits, measured, FRAME, separation_m=0.2, min_ratio_db=3.0)
    assert [change.ratio_db for change in changes] == [12.0, 6.0]
    assert (changes[0].x_m, changes[0].y_m) == pytest.approx((0.275, 0.275))
    assert [change.kind for change in changes] == [ChangeKind.LOUDER, ChangeKind.APPEARED]
    sure, less_sure = (change.false_alarm_probability for change in changes)
    assert 0.0 < sure < less_sure < 1.0
    turned = seen_from_the_other_side(changes[1])
    assert (turned.ratio_db, turned.kind) == (-6.0, ChangeKind.GONE)


def test_error_of_a_cell_is_that_of_the_mean_of_its_shares():
    rng = np.random.default_rng(4)
    count, shape = 100, (40, 50)
    shares = rng.gamma(50.0, 0.02, (count, *shape))
    frame = GridFrame(0.05, (0.0, 0.0), shape)
    power_map = PowerMap(
        frame,
        shares.sum(axis=0),
        np.full(shape, count),
        LevelReference.FULL_SCALE,
        (shares**2).sum(axis=0),
    )
    levels = cell_levels(power_map, min_visit_share=0.1)
    # five shares in a row count as one, so the error is that of a fifth of them
    expected = levels.level_db.std() * np.sqrt(5.0)
    assert np.median(levels.sigma_db) == pytest.approx(expected, rel=0.05)
    assert levels.freedom == pytest.approx(19.0)


def test_unknown_scatter_leaves_the_chance_unknown():
    power = np.ones(FRAME.shape)
    visits = np.full(FRAME.shape, 40)
    old = PowerMap(FRAME, power * 40, visits, LevelReference.FULL_SCALE)
    levels = cell_levels(old, min_visit_share=0.1)
    ratio, _ = power_ratio(levels, FRAME, levels, FRAME)
    assert np.isnan(chance(ratio)).all()
    assert family_chance(float("nan"), 5) is None


def test_equal_maps_differ_by_chance_as_often_as_stated():
    rng = np.random.default_rng(5)
    shape = (100, 200)
    frame = GridFrame(0.05, (0.0, 0.0), shape)
    sigma, freedom = np.full(shape, 0.5), np.full(shape, 200.0)
    one, other = (CellLevels(rng.normal(0.0, 0.5, shape), sigma, freedom) for _ in range(2))
    ratio, _ = power_ratio(one, frame, other, frame)
    assert (chance(ratio) < 0.05).mean() == pytest.approx(0.05, rel=0.1)
