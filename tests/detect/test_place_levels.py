"""Levels of places: against sources of known strength, with errors that are those seen."""

from dataclasses import replace

import numpy as np
import pytest

from soundmap.config import ScanConfig
from soundmap.detect.place_levels import place_levels, with_level_errors
from soundmap.geometry import Mount, Trajectory
from soundmap.grid import OccupancyGrid
from soundmap.sensors import MicArray
from soundmap.sound import LevelReference, Reflection, Source, SourceFit, SourceList
from tests.handmade import walled_room
from tests.heard import circle, drive, heard_scans

ROOM = walled_room()
WAY = drive([(1.0, 1.0), (5.0, 1.0), (5.0, 3.5), (1.0, 3.5)])
ARRAY = MicArray(circle(), Mount.planar(0.0, 0.0, 0.5, 0.0), None)
PLACES = np.array([[2.5, 0.3], [5.7, 2.4], [2.0, 4.1]])
LOUDNESS = np.array([4e-7, 1e-7, 2e-7])
SOURCES = [(*place, loudness) for place, loudness in zip(PLACES, LOUDNESS, strict=True)]
NONE = np.zeros((0, 2))


def levels(places, scans, *, way=WAY, room=ROOM, images=NONE):
    return place_levels(places, scans, way, ARRAY, room, ScanConfig(), images_m=images)


def test_strengths_are_found_within_a_twentieth():
    found = levels(PLACES, heard_scans(WAY, SOURCES, seed=1, wobble_db=0.0))
    assert found.power_1m == pytest.approx(LOUDNESS, rel=0.05)
    assert (found.freedom > 3).all()


def test_the_error_is_the_spread_over_many_runs():
    runs = [levels(PLACES, heard_scans(WAY, SOURCES, seed=seed)) for seed in range(30)]
    strength = np.log(np.array([run.power_1m for run in runs]))
    claimed = np.array([run.sigma / run.power_1m for run in runs])
    seen = strength.std(axis=0, ddof=1)
    assert np.sqrt((claimed**2).mean(axis=0)) == pytest.approx(seen, rel=0.45)


def test_where_nothing_sounds_the_strength_scatters_round_nothing():
    silent = np.array([[0.4, 2.2]])
    found = [
        levels(np.concatenate([PLACES, silent]), heard_scans(WAY, SOURCES, seed=seed))
        for seed in range(8)
    ]
    t = np.array([run.power_1m[3] / run.sigma[3] for run in found])
    assert np.abs(t).max() < 5.0
    assert np.abs([run.power_1m[3] for run in found]).max() < 0.1 * LOUDNESS.min()


def test_twice_the_power_is_twice_the_strength():
    scans = heard_scans(WAY, SOURCES, seed=2)
    once, twice = levels(PLACES, scans), levels(PLACES, replace(scans, power=2 * scans.power))
    assert twice.power_1m == pytest.approx(2 * once.power_1m, rel=1e-5)
    assert twice.sigma == pytest.approx(2 * once.sigma, rel=1e-4)


def test_order_of_the_places_does_not_matter():
    scans = heard_scans(WAY, SOURCES, seed=3)
    forward, backward = levels(PLACES, scans), levels(PLACES[::-1], scans)
    assert backward.power_1m[::-1] == pytest.approx(forward.power_1m, rel=1e-6)


def test_a_turned_world_gives_the_same_levels():
    scans = heard_scans(WAY, SOURCES, seed=4)
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    pose = np.column_stack([WAY.pose[:, :2] @ turn.T, WAY.pose[:, 2] + np.pi / 2])
    turned = Trajectory(WAY.time_ns, pose, WAY.usable)
    frame = replace(ROOM.frame, origin_m=(-4.5, -0.5), shape=ROOM.frame.shape[::-1])
    open_floor = np.zeros(frame.shape, dtype=bool)
    nowhere = OccupancyGrid(frame, open_floor, ~open_floor)
    straight = replace(ROOM, occupied=np.zeros_like(ROOM.occupied))
    expected = levels(PLACES, scans, room=straight)
    found = levels(PLACES @ turn.T, scans, way=turned, room=nowhere)
    assert found.power_1m == pytest.approx(expected.power_1m, rel=1e-5)


def test_behind_a_wall_nothing_can_be_told_but_of_mirror_images():
    scans = heard_scans(WAY, [*SOURCES, (2.5, -0.8, 2e-7)], seed=5)
    outside = np.array([[2.5, -0.8]])
    found = levels(np.concatenate([PLACES, outside]), scans)
    assert np.isnan(found.power_1m[3])
    assert found.freedom[3] == 0
    alone, with_image = levels(PLACES, scans), levels(PLACES, scans, images=outside)
    off_alone, off = (np.abs(f.power_1m[0] / LOUDNESS[0] - 1) for f in (alone, with_image))
    assert off < off_alone
    assert len(with_image.power_1m) == 3


def test_without_scans_or_places_there_are_no_levels():
    scans = heard_scans(WAY, SOURCES, seed=6)
    lost = replace(WAY, usable=np.zeros(len(WAY), dtype=bool))
    assert np.isnan(levels(PLACES, scans, way=lost).power_1m).all()
    assert len(levels(NONE, scans).power_1m) == 0


def test_sources_get_the_error_of_their_level():
    fit = SourceFit(1e-7, np.eye(2), 0.0, 1.0, ())
    sources = SourceList(
        tuple(Source(x, y, power, 9, fit) for x, y, power in SOURCES),
        LevelReference.FULL_SCALE,
        (Reflection(2.5, 0.35, 1e-8, 0),),
    )
    scans = heard_scans(WAY, SOURCES, seed=7)
    told = with_level_errors(sources, scans, WAY, ARRAY, ROOM, ScanConfig())
    expected = levels(PLACES, scans)  # the image is too near to its source to be told from it
    sigma_db = 10 / np.log(10) * expected.sigma / expected.power_1m
    assert [source.fit.level_sigma_db for source in told] == pytest.approx(sigma_db)
    assert [source.power for source in told] == [source.power for source in sources]
    nobody = SourceList((), LevelReference.FULL_SCALE)
    assert with_level_errors(nobody, scans, WAY, ARRAY, ROOM, ScanConfig()) == nobody
