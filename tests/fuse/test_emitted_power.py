import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soundmap.fuse.emitted_power import emitted_power

TABLE_1 = {"alpha": 0.5, "d_min": 0.3, "d_max": 3.0}


@given(st.floats(0.3, 3.0), st.floats(0, 1e6), st.floats(0, 4))
def test_the_emitted_power_is_given_back_at_every_range(distance, emitted, alpha):
    received = emitted * (0.3 / distance) ** alpha
    back = emitted_power([received], [distance], alpha=alpha, d_min=0.3, d_max=3.0)
    assert back == pytest.approx([emitted], rel=1e-9)


def test_both_ends_of_the_range_are_inside():
    power = emitted_power([1.0, 1.0, 1.0, 1.0], [0.3, 3.0, 0.2999, 3.0001], **TABLE_1)
    assert power[:2] == pytest.approx([1.0, 10.0**0.5])
    assert np.isnan(power[2:]).all()


def test_ranges_that_are_missing_or_infinite_are_not_measured():
    assert np.isnan(emitted_power([1.0, 2.0], [np.nan, np.inf], **TABLE_1)).all()


def test_power_is_linear_in_what_is_received():
    rng = np.random.default_rng(0)
    received, ranges = rng.random((2, 4, 120))
    ranges += 0.3
    once = emitted_power(received, ranges, **TABLE_1)
    assert np.allclose(emitted_power(3 * received, ranges, **TABLE_1), 3 * once)


def test_leading_axes_equal_single_calls():
    rng = np.random.default_rng(1)
    received, ranges = rng.random((2, 3, 5, 7)) * 4
    many = emitted_power(received, ranges, **TABLE_1)
    for index in np.ndindex(3, 5):
        single = emitted_power(received[index], ranges[index], **TABLE_1)
        assert np.array_equal(many[index], single, equal_nan=True)


@pytest.mark.parametrize(("d_min", "d_max"), [(0.0, 3.0), (3.0, 3.0), (-1.0, 1.0)])
def test_impossible_ranges_are_refused(d_min, d_max):
    with pytest.raises(ValueError, match="0 < d_min < d_max"):
        emitted_power([1.0], [1.0], alpha=2.0, d_min=d_min, d_max=d_max)
