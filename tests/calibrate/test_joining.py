"""Two estimates of clock and yaw as one."""

from __future__ import annotations

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
    found = joined(by_peaks(0.066, 2.4), 0.060, 2.0)
    sigma = np.hypot(1.4 * 0.004, 0.001)
    weight = sigma**-2 / (sigma**-2 + 0.006**-2)
    assert found.clock.value == pytest.approx(0.066 - 0.006 * weight, abs=1e-5)
    assert 2.0 < np.degrees(found.yaw.value) < 2.2
    assert found.clock.sigma == pytest.approx(sigma, rel=1e-3)  # no surer than the fit alone
    assert (found.explained, found.places) == (0.9, 7)


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
