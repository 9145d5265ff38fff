"""Changes with a component's unknowns, against differences of what the fit predicts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soundmap.detect.component import ASSUMED, Share
from soundmap.detect.sound_paths import Kind, Path, heard_places, waves_heard
from soundmap.detect.sparse_fit import SparseFit
from soundmap.detect.unknowns import LOBE, PLACE, change, derivatives, held, unknowns
from tests.detect.box_room import DEPTH, WIDTH, relative_error, still_evidence

WALLS = np.array([[0.0, 1.0, 0.0], [0.0, 1.0, DEPTH], [1.0, 0.0, WIDTH]])
HERE, HEIGHT_M, STRENGTH = np.array([5.5, 3.0]), 0.1, 20.0
STEP_M = 0.02
EVERY = slice(None)


@pytest.fixture
def evidence():
    return still_evidence()


def sounding(evidence, kind=Kind.SOURCE, place=HERE):
    fit = SparseFit(evidence, WALLS)
    source = fit.add(place, HEIGHT_M, kind)
    source.strength = np.full(evidence.sub_bands, STRENGTH)
    return fit, source


@pytest.mark.parametrize("hand", [1, -1])
def test_scans_change_with_the_place_by_the_bearings_of_all_paths(evidence, hand):
    evidence = replace(evidence, handedness=hand)
    fit, source = sounding(evidence)
    paths = source.paths
    assert {Share.ROOM, Share.CLOSE_WALLS} <= set(source.ways)

    def heard_from(place):
        """As loud as from here, along those paths that there are from here."""
        total = 0.0
        for path, share in zip(*source.taken(), strict=True):
            step = heard_places(WALLS, place)[path] - evidence.place_m
            turn = hand * (np.arctan2(step[:, 1], step[:, 0]) - evidence.axis_rad) / (2.0 * np.pi)
            wave = (turn - np.floor(turn)) * evidence.table.waves
            own = waves_heard(evidence, wave, paths.aperture[path], paths.gain[path])
            total = total + STRENGTH * share * own
        return total

    told = derivatives(fit, [(source, axis) for axis in PLACE], EVERY)
    for step, own in zip(STEP_M * np.eye(2), told, strict=True):
        expected = (heard_from(HERE + step) - heard_from(HERE - step)) / (2.0 * STEP_M)
        assert relative_error(own, expected) < 0.1


def test_scans_change_with_the_directivity(evidence):
    def heard_with(lobe):
        fit = SparseFit(evidence, WALLS)
        return STRENGTH * fit.add(HERE, HEIGHT_M, Kind.SOURCE, np.array(lobe)).column

    fit, source = sounding(evidence)
    told = derivatives(fit, [(source, axis) for axis in LOBE], EVERY)
    for step, own in zip(0.05 * np.eye(2), told, strict=True):
        expected = (heard_with(step) - heard_with(-step)) / 0.1
        assert relative_error(own, expected) < 0.01


def test_scans_change_with_a_share_by_the_paths_that_have_it(evidence):
    fit, source = sounding(evidence)
    before = source.column.copy()
    (told,) = derivatives(fit, [(source, int(Share.ROOM))], EVERY)
    change((source, int(Share.ROOM)), 0.1)
    fit.hear_anew(source)
    assert relative_error(0.1 * told, STRENGTH * (source.column - before)) < 1e-4


def test_derivatives_come_in_the_order_of_the_unknowns(evidence):
    fit, source = sounding(evidence)
    axes = [LOBE[1], int(Share.ROOM), PLACE[0]]
    told = derivatives(fit, [(source, axis) for axis in axes], EVERY)
    for axis, own in zip(axes, told, strict=True):
        np.testing.assert_array_equal(own, derivatives(fit, [(source, axis)], EVERY)[0])


def test_derivatives_of_one_component_do_not_hang_on_others_or_on_other_scans(evidence):
    fit, source = sounding(evidence)
    other = fit.add(np.array([2.0, 4.8]), 0.5, Kind.SOURCE)
    other.strength = np.full(evidence.sub_bands, 3.0)
    owners = unknowns(fit.components, directed=True)
    together, few = derivatives(fit, owners, EVERY), slice(2, 5)
    for component in (source, other):
        own = [owner for owner in owners if owner[0] is component]
        index = [owners.index(owner) for owner in own]
        np.testing.assert_array_equal(derivatives(fit, own, few), together[index][:, few])


def test_a_share_of_nothing_can_still_grow(evidence):
    fit, source = sounding(evidence)
    source.shares[Share.ROOM] = 0.0
    fit.hear_anew(source)
    told = derivatives(fit, unknowns([source], directed=True), EVERY)
    assert np.isfinite(told).all()
    (share,) = derivatives(fit, [(source, int(Share.ROOM))], EVERY)
    assert np.abs(share).max() > 0.0


def test_a_machine_that_faces_the_array_is_louder_there(evidence):
    fit, even = sounding(evidence)
    facing = fit.add(HERE, HEIGHT_M, Kind.SOURCE, np.array([0.0, -0.7]))
    away = HERE - evidence.place_m
    expected = np.exp(0.7 * away[:, 1] / np.hypot(*away.T))
    there = even.paths.gain[Path.DIRECT] > 0.0
    ratio = facing.paths.gain[Path.DIRECT][there] / even.paths.gain[Path.DIRECT][there]
    np.testing.assert_allclose(ratio, expected[there])


def test_only_sources_have_a_directivity_and_only_where_asked(evidence):
    behind_the_wall = np.array([WIDTH + 0.5, 3.0])
    for kind, place, directed, count in [
        (Kind.SOURCE, HERE, True, 2),
        (Kind.SOURCE, HERE, False, 0),
        (Kind.IMAGE, behind_the_wall, True, 0),
    ]:
        fit, _ = sounding(evidence, kind, place)
        axes = [axis for _, axis in unknowns(fit.components, directed=directed)]
        assert sum(axis in LOBE for axis in axes) == count
        assert set(PLACE) <= set(axes)


def test_steps_are_limited_and_shares_stay_shares(evidence):
    _, source = sounding(evidence)
    change((source, PLACE[0]), 3.0)
    change((source, LOBE[1]), -3.0)
    for _ in range(9):
        change((source, int(Share.ROOM)), -3.0)
    np.testing.assert_allclose(source.place_m - HERE, (0.1, 0.0))
    np.testing.assert_allclose(source.directivity, (0.0, -0.3))
    assert source.shares[Share.ROOM] == 0.0


def test_shares_and_directivities_are_drawn_back_and_places_are_not(evidence):
    _, source = sounding(evidence)
    source.directivity[0], source.shares[Share.ROOM] = 0.4, 0.7
    assert held((source, PLACE[0]))[1] == 0.0
    assert held((source, LOBE[0])) == (4.0, 0.4)
    assert held((source, int(Share.ROOM)))[1] == pytest.approx(0.7 - ASSUMED[Share.ROOM])
