import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plane_waves import angle_between

from soundmap.grid import GridFrame
from soundmap.sound import AudioScan, LevelReference, PowerMap, decibels

BEARING = 2.0 * np.pi * np.arange(120) / 120


@given(top=st.floats(0.0, 2.0 * np.pi), height=st.floats(1e-9, 1e9))
def test_a_parabola_is_found_exactly_all_around_the_circle(top, height):
    distance = np.array([angle_between(bearing, top) for bearing in BEARING])
    bearing, power = AudioScan(0, BEARING, height * (10.0 - distance**2)).peaks()
    assert angle_between(bearing[0], top) < 1e-5
    assert power[0] == pytest.approx(10.0 * height)
    assert 0.0 <= bearing[0] < 2.0 * np.pi


@given(top=st.floats(0.0, 2.0 * np.pi))
def test_a_lobe_12_degrees_wide_is_found_within_a_third_of_a_degree(top):
    distance = np.array([angle_between(bearing, top) for bearing in BEARING])
    lobe = 0.5 ** ((distance / np.radians(6.0)) ** 2)
    bearing, _ = AudioScan(0, BEARING, lobe).peaks()
    assert np.degrees(angle_between(bearing[0], top)) < 0.3


def test_every_local_maximum_is_a_peak_and_the_loudest_comes_first():
    power = np.ones(120)
    power[[0, 40, 80]] = 2.0, 5.0, 3.0
    bearing, heights = AudioScan(0, BEARING, power).peaks()
    assert np.degrees(bearing).round(6).tolist() == [120.0, 240.0, 0.0]
    assert heights.tolist() == [5.0, 3.0, 2.0]


def test_a_flat_scan_has_no_peak():
    bearing, power = AudioScan(0, BEARING, np.ones(120)).peaks()
    assert len(bearing) == len(power) == 0


def test_silence_and_what_is_missing_are_not_mixed():
    assert decibels(np.array([1.0, 0.0, np.nan])).tolist()[:2] == [0.0, -np.inf]
    frame = GridFrame(1.0, (0.0, 0.0), (1, 4))
    power_map = PowerMap(
        frame,
        np.array([[0.0, 6.0, 0.0, 5.0]]),
        np.array([[20, 3, 0, 2]]),
        LevelReference.FULL_SCALE,
    )
    power = power_map.power(min_visit_share=0.1)[0]
    assert power[:2].tolist() == [0.0, 2.0]
    assert np.isnan(power[2:]).all(), "never visited, and visited a tenth as often as the most"
