import numpy as np
import pytest

from soundmap.detect.difference import changed_places, power_ratio
from soundmap.grid import GridFrame

FRAME = GridFrame(0.05, (0.0, 0.0), (30, 40))


def maps(seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(1, 2, FRAME.shape), rng.uniform(1, 2, FRAME.shape)


def test_ratio_is_the_difference_in_decibels():
    power, background = maps()
    ratio, measured = power_ratio(power, FRAME, background, FRAME)
    assert np.allclose(ratio, 10 * np.log10(power) - 10 * np.log10(background))
    assert measured.all()


def test_ten_times_the_power_is_ten_decibels():
    power, _ = maps()
    ratio, _ = power_ratio(10 * power, FRAME, power, FRAME)
    assert ratio == pytest.approx(10.0)


def test_grids_need_not_coincide():
    power, _ = maps()
    other = GridFrame(0.05, (-0.45, 0.31), (60, 70))
    centres = other.centres(np.moveaxis(np.indices(other.shape), 0, -1))
    background = 1.0 + centres[..., 0] + 10 * centres[..., 1]
    ratio, measured = power_ratio(power, FRAME, background, other)
    here = FRAME.centres(np.moveaxis(np.indices(FRAME.shape), 0, -1))
    expected = 1.0 + here[..., 0] + 10 * here[..., 1]
    off = 10 ** ((10 * np.log10(power) - ratio) / 10) - expected
    assert np.abs(off[measured]).max() < 0.03 * 11
    assert not measured[:6].any(), "rows below the background's grid"


def test_where_only_the_run_measured_the_median_of_the_background_stands_in():
    power, background = maps()
    background[3, 4] = np.nan
    ratio, measured = power_ratio(power, FRAME, background, FRAME)
    assert not measured[3, 4]
    median = np.median(background[np.isfinite(background)])
    assert ratio[3, 4] == pytest.approx(10 * np.log10(power[3, 4] / median))


def test_where_only_the_background_measured_there_is_no_ratio():
    power, background = maps()
    power[3, 4] = np.nan
    assert np.isnan(power_ratio(power, FRAME, background, FRAME)[0][3, 4])


def test_an_unmeasured_background_is_refused():
    power, _ = maps()
    with pytest.raises(ValueError, match="no measurement"):
        power_ratio(power, FRAME, np.full(FRAME.shape, np.nan), FRAME)


def test_changes_are_the_maxima_above_the_threshold():
    ratio = np.zeros(FRAME.shape)
    ratio[5, 5], ratio[20, 30], ratio[25, 8] = 12.0, 6.0, 2.0
    visits = np.full(FRAME.shape, 7, dtype=np.int64)
    result = changed_places(
        ratio, visits, np.ones(FRAME.shape, dtype=bool), FRAME, separation_m=0.2, min_ratio_db=3.0
    )
    assert [change.ratio_db for change in result.changes] == [12.0, 6.0]
    assert (result.changes[0].x_m, result.changes[0].y_m) == pytest.approx((0.275, 0.275))
