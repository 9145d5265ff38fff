from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plane_waves import angle_between

from soundmap.scan.peak import refined_peak

BEARING = 2.0 * np.pi * np.arange(120) / 120


@given(top=st.floats(0.0, 2.0 * np.pi), height=st.floats(1e-9, 1e9))
def test_a_parabola_is_found_exactly_all_around_the_circle(top, height):
    distance = np.array([angle_between(bearing, top) for bearing in BEARING])
    peak = refined_peak(height * (1.0 - distance**2), BEARING)
    assert angle_between(peak.bearing_rad, top) < 1e-6
    assert peak.power == pytest.approx(height)
    assert 0.0 <= peak.bearing_rad < 2.0 * np.pi


@given(top=st.floats(0.0, 2.0 * np.pi))
def test_a_lobe_12_degrees_wide_is_found_within_a_third_of_a_degree(top):
    distance = np.array([angle_between(bearing, top) for bearing in BEARING])
    lobe = 0.5 ** ((distance / np.radians(6.0)) ** 2)
    assert np.degrees(angle_between(refined_peak(lobe, BEARING).bearing_rad, top)) < 0.3


def test_a_bearing_just_below_the_first_stays_below_the_full_circle():
    power = np.zeros(120)
    power[[-1, 0, 1]] = 1.0 - 0.5 + 1e-16, 1.0, 0.5 - 1e-16
    assert 0.0 <= refined_peak(power, BEARING).bearing_rad < 2.0 * np.pi


def test_a_flat_scan_has_its_peak_at_the_first_bearing():
    assert refined_peak(np.zeros(120), BEARING) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("power", "bearings"), [(np.ones(119), 120), ([1.0, np.nan, 0.0], 3), ([1.0, 2.0], 2)]
)
def test_what_is_no_scan_is_refused(power, bearings):
    with pytest.raises(ValueError, match="one finite power a bearing"):
        refined_peak(power, 2.0 * np.pi * np.arange(bearings) / bearings)
