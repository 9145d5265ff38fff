"""Two run folders compared: nothing changes by itself, and what changes is told."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from soundmap.change import ChangeKind
from soundmap.comparison import compared
from soundmap.config import Config
from soundmap.geometry import inverted, relative, transformed
from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.outputs.run_folder import write_run
from soundmap.sound import Reflection, Source, SourceFit, SourceList
from tests.handmade import NO_PICTURES, made_run, walled_room
from tests.heard import drive, heard_scans

CONFIG = Config()
PLACES = [(2.5, 0.3), (5.7, 2.4), (2.0, 4.1)]
LOUDNESS = [4e-7, 1e-7, 2e-7]


def folder(
    path,
    sounding,
    *,
    found=None,
    seed,
    way=((1.0, 1.0), (5.0, 1.0), (5.0, 3.5), (1.0, 3.5)),
    room=None,
    frame_pose=(0.0, 0.0, 0.0),
):
    """A run folder whose scans hold some sources (x, y, loudness), and which names some of them."""
    track = drive(way)
    rng = np.random.default_rng(seed)
    fit = SourceFit(1e-7, 0.02**2 * np.eye(2), 1e-9, 1.0, ())
    named = sounding if found is None else found
    sources = tuple(
        Source(
            *(np.array(place) + rng.normal(0.0, 0.01, 2)), power, 80, replace(fit, power_1m=power)
        )
        for *place, power in named
    )
    base = made_run(Path("run.mcap"))
    scans = heard_scans(track, sounding, seed=seed)
    images = (Reflection(2.5, -0.4, 1e-8, 0),) if named else ()
    run = replace(
        base,
        room=room or base.room,
        trajectory=replace(track, pose=relative(frame_pose, track.pose)),
        scans=scans,
        sources=moved(SourceList(sources, scans.reference, images), frame_pose),
    )
    path.mkdir()
    write_run(run, path, NO_PICTURES)
    return path


def moved(sources, pose):
    """Sources as a frame tells of them that has a pose in that of the sources."""

    def there(thing):
        x, y = transformed(inverted(pose), (thing.x_m, thing.y_m)).tolist()
        return replace(thing, x_m=x, y_m=y)

    return replace(
        sources,
        sources=tuple(map(there, sources)),
        reflections=tuple(map(there, sources.reflections)),
    )


def everything(factors=(1.0, 1.0, 1.0)):
    rows = zip(PLACES, LOUDNESS, factors, strict=True)
    return [(*place, power * factor) for place, power, factor in rows if factor > 0.0]


def differences(run, background):
    return compared(run, background, CONFIG.diff, CONFIG.detect).ratio.changes


def kinds(changes):
    """Kind of each source by its place."""
    nearest = {
        min(range(3), key=lambda n: np.hypot(PLACES[n][0] - c.x_m, PLACES[n][1] - c.y_m)): c
        for c in changes
    }
    return [str(nearest[n].kind) for n in sorted(nearest)]


def test_an_unchanged_site_shows_no_change_between_any_two_runs(tmp_path):
    back = ((1.2, 3.4), (4.8, 3.4), (4.9, 1.2), (1.0, 1.1))
    runs = [folder(tmp_path / f"run{n}", everything(), seed=n) for n in range(3)]
    runs.append(folder(tmp_path / "back", everything(), seed=9, way=back))
    for one in runs:
        for other in runs:
            assert kinds(differences(one, other)) == ["unchanged"] * 3


def test_changes_of_each_kind_between_two_loud_runs(tmp_path):
    before = folder(tmp_path / "before", everything((1.0, 1.0, 0.0)), seed=1)
    after = folder(tmp_path / "after", everything((3.0, 0.0, 1.0)), seed=2)
    changes = differences(after, before)
    assert kinds(changes) == ["louder", "gone", "appeared"]
    louder = next(c for c in changes if c.kind == ChangeKind.LOUDER)
    assert louder.ratio_db == pytest.approx(10 * np.log10(3.0), abs=1.2)
    assert 0.1 < louder.sigma_db < 1.0
    assert kinds(differences(before, after)) == ["quieter", "appeared", "gone"]


def test_louder_ones_come_first_the_greatest_first(tmp_path):
    before = folder(tmp_path / "before", everything((1.0, 1.0, 0.0)), seed=1)
    after = folder(tmp_path / "after", everything((3.0, 0.0, 1.0)), seed=2)
    order = [change.kind for change in differences(after, before)]
    assert order == ["appeared", "louder", "gone"]


def test_a_source_that_one_run_missed_has_not_changed(tmp_path):
    first = folder(tmp_path / "first", everything(), seed=1)
    second = folder(tmp_path / "second", everything(), found=everything((1, 0, 1)), seed=2)
    assert kinds(differences(first, second)) == ["unchanged"] * 3
    assert kinds(differences(second, first)) == ["unchanged"] * 3


def test_against_a_silent_background_all_appeared(tmp_path):
    run = folder(tmp_path / "run", everything(), seed=1)
    silent = folder(tmp_path / "silent", [], seed=2)
    assert kinds(differences(run, silent)) == ["appeared"] * 3
    assert kinds(differences(silent, run)) == ["gone"] * 3
    assert differences(silent, silent) == ()


def corner_room(pose=(0.0, 0.0, 0.0)):
    """A room with a corner cut out, in a frame that has a pose in the room's."""
    corners = np.array([(0, 0), (6, 0), (6, 4.5), (1.5, 4.5), (1.5, 3.7), (0, 3.7), (0, 0)])
    steps = np.linspace(0.0, 1.0, 600)[:, None]
    walls = np.concatenate([a + steps * (b - a) for a, b in itertools.pairwise(corners)])
    walls = transformed(inverted(pose), walls)
    low = walls.min(axis=0) - 0.5
    columns, rows = np.ceil((walls.max(axis=0) + 0.5 - low) / 0.05).astype(int).tolist()
    frame = GridFrame(0.05, (float(low[0]), float(low[1])), (rows, columns))
    occupied = np.zeros(frame.shape, dtype=bool)
    occupied[tuple(frame.cells(walls).T)] = True
    return OccupancyGrid(frame, occupied, ~occupied)


def test_runs_in_maps_of_their_own_are_laid_on_each_other(tmp_path):
    pose = np.array([0.8, -0.5, 0.25])
    run = folder(tmp_path / "run", everything((1.0, 1.0, 0.0)), seed=1, room=corner_room())
    other = folder(
        tmp_path / "other", everything(), seed=2, room=corner_room(pose), frame_pose=pose
    )
    comparison = compared(run, other, CONFIG.diff, CONFIG.detect)
    (note,) = comparison.notes
    assert "different maps" in note.what
    assert not note.data_lost
    assert kinds(comparison.ratio.changes) == ["unchanged", "unchanged", "gone"]
    back = compared(other, run, CONFIG.diff, CONFIG.detect).ratio.changes
    (appeared,) = (change for change in back if change.kind == ChangeKind.APPEARED)
    place = transformed(pose, (appeared.x_m, appeared.y_m))
    assert place == pytest.approx(PLACES[2], abs=0.06)


def test_maps_that_do_not_match_are_told_of(tmp_path):
    run = folder(tmp_path / "run", everything(), seed=1)
    post = np.zeros(walled_room().frame.shape, dtype=bool)
    post[20, 30] = True
    other = folder(
        tmp_path / "other", everything(), seed=2, room=replace(walled_room(), occupied=post)
    )
    assert compared(run, run, CONFIG.diff, CONFIG.detect).notes == ()
    (note,) = compared(run, other, CONFIG.diff, CONFIG.detect).notes
    assert "cannot be laid on each other" in note.what


def test_folders_that_tell_of_no_sources_are_compared_cell_by_cell(tmp_path):
    """As the paper does, and as folders of an earlier soundmap have to be."""
    run = folder(tmp_path / "run", everything(), seed=1)
    other = folder(tmp_path / "other", everything(), seed=2)
    (other / "trajectory.npz").unlink()
    changes = differences(run, other)
    assert all(change.run_source is None for change in changes)
