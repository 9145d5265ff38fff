"""Two estimates of clock and yaw as one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soundmap.calibrate.joining import joined_offsets
from soundmap.config import CalibrateConfig, ScanConfig
from soundmap.geometry import Mount
from soundmap.sensors import ArrayOffsets, MicArray, Offset, OffsetVerdict

AROUND = 2.0 * np.pi * np.arange(16) / 16
RING_M = 0.155 * np.stack([np.cos(AROUND), np.sin(AROUND), 0.0 * AROUND], axis=-1)
COVARIANCE = np.diag([0.004**2, np.radians(0.2) ** 2])


def by_peaks(clock_s, yaw_deg):
    known = OffsetVerdict.NOUGHT
    yaw = Offset(float(np.radians(yaw_deg)), float(np.radians(0.4)), known)
    return ArrayOffsets(Offset(clock_s, 0.006, known), yaw, 0.9, 7)


def joined(first, clock_s, yaw_deg, *, explained=0.8, mode="correct", scale=1.0):
    fitted = np.array([clock_s, np.radians(yaw_deg)]), COVARIANCE, explained
    array = MicArray(scale * RING_M, Mount.planar(0.0, 0.0, 0.5, 0.0), None)
    how = array, ScanConfig(), CalibrateConfig(mode=mode)
    return joined_offsets(first, fitted, *how, bearings=120)


def test_each_counts_by_what_it_is_sure_of():
    own = 1.4 * 0.004
    found = joined(by_peaks(0.066, 2.4), 0.060, 2.0)
    assert found.clock.value == pytest.approx(0.066 - 0.006 * weight_of(own, 0.006), abs=1e-5)
    assert 2.0 < np.degrees(found.yaw.value) < 2.2
    sigma = np.hypot(own, 0.001)  # no surer than the fit alone
    assert found.clock.sigma == pytest.approx(sigma, rel=1e-3)
    assert (found.explained, found.places) == (0.9, 7)


def weight_of(own, other):
    """By the covariance of both estimates, half of whose errors are alike: generalised means."""
    covariance = np.array([[own**2, 0.5 * own * other], [0.5 * own * other, other**2]])
    inverse = np.linalg.inv(covariance)
    return inverse.sum(axis=1)[0] / inverse.sum()


def test_a_fit_that_is_twice_as_sure_says_it_all():
    unsure = Offset(0.066, 0.02, OffsetVerdict.NOUGHT)
    found = joined(replace(by_peaks(0.066, 2.4), clock=unsure), 0.060, 2.0)
    assert found.clock.value == 0.060


def test_a_fit_that_is_not_half_as_sure_says_nothing():
    sure = Offset(0.066, 0.002, OffsetVerdict.NOUGHT)
    found = joined(replace(by_peaks(0.066, 2.4), clock=sure), 0.060, 2.0)
    assert found.clock.value == pytest.approx(0.066, abs=1e-12)


def test_a_fit_that_leaves_much_unexplained_is_less_sure_and_counts_less():
    well, badly = (joined(by_peaks(0.066, 2.4), 0.060, 2.0, explained=e) for e in (0.75, 0.4))
    assert badly.clock.sigma > 1.8 * well.clock.sigma
    assert abs(badly.clock.value - 0.066) < abs(well.clock.value - 0.066)


def test_both_are_less_sure_if_they_are_apart_by_more_than_they_should():
    near, far = (joined(by_peaks(0.0, 0.0), 0.0, yaw_deg) for yaw_deg in (0.3, 1.5))
    each = np.hypot(1.4 * 0.2, 0.28)
    assert np.degrees(near.yaw.sigma) == pytest.approx(each, rel=0.02)
    assert np.degrees(far.yaw.sigma) == pytest.approx(each * 1.5 / np.hypot(each, 0.4), rel=0.02)


@pytest.mark.parametrize(
    ("mode", "verdict"), [("correct", OffsetVerdict.CORRECTED), ("report", OffsetVerdict.CLEAR)]
)
def test_what_is_clear_is_corrected_unless_it_shall_only_be_told(mode, verdict):
    found = joined(by_peaks(0.066, 2.4), 0.060, 2.0, mode=mode)
    assert (found.clock.verdict, found.yaw.verdict) == (verdict, verdict)


@pytest.mark.parametrize(("clock_s", "yaw_deg"), [(0.0, 4.0), (0.04, 0.0)])
def test_a_fit_that_disagrees_with_the_peaks_is_believed_if_it_explains_enough(clock_s, yaw_deg):
    first = by_peaks(0.0, 0.0)
    assert joined(first, clock_s, yaw_deg, explained=0.5) is first
    found = joined(first, clock_s, yaw_deg)
    assert (found.clock.value, found.yaw.value) == (clock_s, np.radians(yaw_deg))


def test_a_small_array_is_less_sure():
    first = by_peaks(0.0, 0.0)
    small, large = (joined(first, 0.0, 0.0, scale=scale) for scale in (0.3, 1.0))
    assert small.yaw.sigma > 2.0 * large.yaw.sigma


def test_where_peaks_tell_nothing_a_fit_that_explains_enough_is_believed():
    unknown = Offset(np.nan, np.nan, OffsetVerdict.UNKNOWN)
    first = ArrayOffsets(unknown, unknown, 0.5, 0, "too little", guess=(0.04, 0.1))
    assert joined(first, 0.066, 2.4, explained=0.5) is first
    found = joined(first, 0.066, 2.4, explained=0.7)
    assert found.clock.value == 0.066
    assert (found.clock.verdict, found.why) == (OffsetVerdict.CORRECTED, "")
