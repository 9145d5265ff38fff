"""Changes with clock and yaw, against differences of what the fit predicts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soundmap.detect.component import Share
from soundmap.detect.offset_derivatives import by_offsets
from soundmap.detect.sound_paths import Kind, Path, sound_paths, waves_heard
from soundmap.detect.sparse_fit import SparseFit
from tests.detect.box_room import DEPTH, relative_error, still_evidence

WALLS = np.array([[0.0, 1.0, 0.0], [0.0, 1.0, DEPTH]])
PLACE, HEIGHT_M, STRENGTH = np.array([5.5, 3.0]), 0.1, 20.0
STEP = np.radians(1.0)  # as far apart as the beams that are told apart


@pytest.fixture
def evidence():
    return still_evidence()


def sounding(evidence, walls=WALLS):
    fit = SparseFit(evidence, walls)
    source = fit.add(PLACE, HEIGHT_M, Kind.SOURCE)
    source.strength = np.full(evidence.sub_bands, STRENGTH)
    return fit, source


@pytest.mark.parametrize("hand", [1, -1])
def test_scans_change_with_clock_and_yaw_as_the_array_moves(evidence, hand):
    evidence = replace(evidence, handedness=hand)
    rng = np.random.default_rng(5)
    velocity = rng.standard_normal((len(evidence), 3)) * [0.3, 0.3, 0.8]
    fit, source = sounding(evidence)
    fit.far_harmonics = rng.standard_normal(len(fit.far_harmonics))
    paths = source.paths
    assert {Share.ROOM} <= set(source.ways)

    def heard_after(time_s, turned_rad, *, directly):
        """Along those paths that there are now."""
        after = replace(
            evidence,
            place_m=evidence.place_m + time_s * velocity[:, :2],
            axis_rad=evidence.axis_rad + time_s * velocity[:, 2] + turned_rad,
        )
        moved = sound_paths(after, WALLS, PLACE, HEIGHT_M, Kind.SOURCE)
        total = SparseFit(after, WALLS).far_field.heard(fit.far_harmonics)
        for path, share in zip(*source.taken(), strict=True):
            if path == Path.DIRECT or not directly:
                there = moved.wave[path] if path < Path.WALLS else mirrored(after, path)
                own = waves_heard(after, there, paths.aperture[path], paths.gain[path])
                total = total + STRENGTH * share * own
        return total

    def mirrored(after, path):
        """Where the image is heard, whether or not the lasers see its wall there."""
        image = PLACE * [1.0, -1.0] + [0.0, 2.0 * WALLS[path - Path.WALLS, 2]]
        step = image - after.place_m
        turn = hand * (np.arctan2(step[:, 1], step[:, 0]) - after.axis_rad) / (2.0 * np.pi)
        return (turn - np.floor(turn)) * evidence.table.waves

    clock, yaw = by_offsets(fit, velocity)
    later, sooner = (heard_after(side * STEP, 0.0, directly=False) for side in (1, -1))
    assert relative_error(clock, (later - sooner) / (2.0 * STEP)) < 0.1
    left, right = (heard_after(0.0, side * STEP, directly=True) for side in (1, -1))
    assert relative_error(yaw, (left - right) / (2.0 * STEP)) < 0.1
