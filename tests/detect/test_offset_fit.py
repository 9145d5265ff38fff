"""Clock and yaw by the sparse fit, in scans from a rectangular room."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from soundmap.config import ScanConfig
from soundmap.detect.component import Share
from soundmap.detect.evidence import gathered_evidence, velocities
from soundmap.detect.offset_fit import (
    MOST_SCANS,
    STEP_SHARE,
    _some,
    _Told,
    offsets_by_fit,
)
from soundmap.detect.unknowns import LOBE, PLACE
from tests.detect.box_room import observed

SOURCES = ((6.0, 3.0, 50.0), (2.5, 0.0, 15.0), (0.0, 3.5, 30.0))
SCAN = ScanConfig()


def heard_in_room(emitters=SOURCES, *, clock_s=0.0, yaw_rad=0.0, scans=None, **more):
    """What was heard, to which so much is to be added to be right."""
    true, around, way, array = observed(emitters, **more)
    some = slice(scans)
    stamped = replace(
        true,
        time_ns=(true.time_ns - round(clock_s * 1e9))[some],
        power=true.power[some],
        sub_bands=true.sub_bands[some],
    )

    def heard_at(clock, yaw):
        off = yaw - yaw_rad
        turned = replace(array, mount=array.mount.turned(off))
        late = replace(stamped, time_ns=stamped.time_ns + round(clock * 1e9))
        seen = np.roll(around[some], -round(np.degrees(off)), axis=1)
        run = way, turned, SCAN
        return gathered_evidence(late, seen, *run), velocities(late, *run)

    return heard_at


@pytest.mark.parametrize(
    ("more", "clock_ms", "yaw_deg"),
    [
        ({}, 12.0, -1.2),
        ({}, -10.0, 1.0),
        ({"far": [(0.5, 6.0), (2.0, 3.0)]}, 10.0, 1.0),
        ({"above_m": 0.4}, 10.0, 1.0),
    ],
    ids=["late", "early", "with a far field", "above the array"],
)
def test_what_a_rough_start_has_wrong_is_found(more, clock_ms, yaw_deg):
    true = 1e-3 * clock_ms, np.radians(yaw_deg)
    told = offsets_by_fit(np.zeros(2), heard_in_room(clock_s=true[0], yaw_rad=true[1], **more))
    assert told is not None
    clock, yaw = told.state
    assert 1e3 * clock == pytest.approx(clock_ms, abs=2.5)
    assert np.degrees(yaw) == pytest.approx(yaw_deg, abs=0.25)
    assert 0.8 < told.explained < 1.0
    assert np.all(np.sqrt(np.diag(told.covariance)) < [0.01, np.radians(1.0)])


def test_a_field_from_above_does_not_pull_the_clock():
    far = [(0.5, 40.0), (2.0, 25.0), (4.0, 30.0)]
    told = offsets_by_fit(np.zeros(2), heard_in_room(far=far, far_aperture=0.79))
    assert told is not None
    clock, yaw = told.state
    assert abs(clock) < 0.0025
    assert abs(yaw) < np.radians(0.25)


def test_a_place_moves_against_what_the_offsets_explain():
    source = SimpleNamespace(place_m=np.array([1.0, 2.0]))
    nothing, owners = np.zeros(2), [(source, 0), (source, 1)]
    told = _Told(np.eye(2), nothing, nothing, np.array([[0.0, 1.0], [2.0, 0.0]]), owners, ())
    told.move(np.array([0.01, 0.03]))
    np.testing.assert_allclose(source.place_m, [0.97, 1.98])


def test_shares_and_directivities_move_with_the_places():
    shares = {Share.ROOM: 0.5}
    source = SimpleNamespace(place_m=np.zeros(2), directivity=np.zeros(2), shares=shares)
    owners = [(source, axis) for axis in (*PLACE, Share.ROOM, *LOBE)]
    alone = np.array([0.0, 0.0, 0.1, 0.2, -0.1, 9.0])  # the last is a strength's
    _Told(np.eye(2), np.zeros(2), alone, np.zeros((6, 2)), owners, ()).move(np.zeros(2))
    np.testing.assert_allclose(source.directivity, [STEP_SHARE * 0.2, STEP_SHARE * -0.1])
    assert shares[Share.ROOM] == pytest.approx(0.5 + STEP_SHARE * 0.1)
    assert not source.place_m.any()


def test_of_many_scans_some_are_looked_at_evenly():
    many = 7 + np.arange(3 * MOST_SCANS)
    assert np.array_equal(_some(many), many[::3])
    assert np.array_equal(_some(many[:5]), many[:5])


def test_silence_and_few_scans_tell_nothing():
    assert offsets_by_fit(np.zeros(2), heard_in_room(())) is None
    assert offsets_by_fit(np.zeros(2), heard_in_room(scans=20)) is None
