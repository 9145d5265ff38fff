import numpy as np
import pytest

from soundmap.along_walls import without_hearsay
from soundmap.geometry import composed, relative, wrapped_angle
from soundmap.mapping.alignment import (
    CORRELATION,
    ROBUST_M,
    SAME_SIDE,
    SIGMA_M,
    PointStore,
    aligned_scan,
    matched_share,
    pair_fits,
)
from soundmap.mapping.key_scans import KeyScan, strip_order
from tests import worlds
from tests.mapping import drives

NO_PRIOR = np.diag([1e-6, 1e-6, 1e-6])


@pytest.fixture(scope="module")
def keys():
    truth = worlds.driven([(1, 1), (4, 1.2), (5, 2)])
    scans = worlds.laser_scans(truth, [worlds.FRONT, worlds.BACK], rate_hz=10, beams=541)
    found = drives.keys(scans, truth).scans[::3]
    return found, truth.at([key.time_ns for key in found])


def handmade_key(end, normal):
    end = end.astype(np.float32)
    origin = np.zeros_like(end)
    return KeyScan(0, 0, np.zeros(3), 0.0, 0.0, origin, end, normal.astype(np.float32))


def slow_fit(moving, others, between, gate):
    """Normal equations by trying every return, straight from the formula."""
    x, y, turn = between
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    information, gradient, matched = np.zeros((3, 3)), np.zeros(3), 0
    doubt = np.zeros((2, 2))
    for point, facing in zip(moving.end_m, moving.normal, strict=True):
        if not facing.any():
            continue
        turned = rotation @ point
        distance = np.hypot(*(others.end_m - turned - [x, y]).T)
        distance[others.normal @ (rotation @ facing) <= SAME_SIDE] = np.inf
        near = np.argmin(distance)
        if distance[near] >= gate:
            continue
        normal = others.normal[near].astype(float)
        residual = normal @ (np.add(turned, [x, y]) - others.end_m[near])
        row = np.array([*normal, normal @ [-turned[1], turned[0]]])
        weight = 1 / (1 + (residual / ROBUST_M) ** 2)
        information += weight * np.outer(row, row)
        gradient += weight * row * residual
        both = np.outer(normal, rotation @ facing)
        doubt += weight * (np.outer(normal, normal) - 0.5 * (both + both.T))
        matched += 1
    scale = CORRELATION / SIGMA_M**2
    information, gradient = without_hearsay(
        information[None] * scale, gradient[None] * scale, doubt[None] * scale
    )
    return information[0], gradient[0], matched


def test_the_normal_equations_are_those_of_the_formula(keys):
    scans, pose = keys
    pose = pose + np.random.default_rng(2).normal(0, 0.02, pose.shape)
    pairs = np.array([[1, 0], [0, 1], [5, 2], [len(scans) - 1, 0]])
    fits = pair_fits(PointStore.of(scans), pose, pairs, gate_m=0.2)
    for m, (i, j) in enumerate(pairs):
        slow = slow_fit(scans[i], scans[j], relative(pose[j], pose[i]), 0.2)
        assert fits.matched[m] == slow[2]
        np.testing.assert_allclose(fits.information[m], slow[0], rtol=1e-3, atol=1.0)
        np.testing.assert_allclose(fits.gradient[m], slow[1], rtol=1e-3, atol=1.0)


@pytest.mark.parametrize("offset", [(0.15, -0.1, 0.06), (-0.1, 0.15, -0.08)])
def test_a_scan_put_down_wrongly_finds_back(keys, offset):
    scans, pose = keys
    moved = pose.copy()
    moved[4] = composed(pose[4], offset)
    found = aligned_scan(
        PointStore.of(scans),
        moved,
        moving=4,
        prior=moved[4],
        prior_information=NO_PRIOR,
        gates_m=(0.3, 0.15),
    )
    assert np.hypot(*(found.pose - pose[4])[:2]) < 0.002
    assert abs(wrapped_angle(found.pose[2] - pose[4][2])) < 0.001
    assert found.matched > 0.9


def test_a_strong_prior_holds(keys):
    scans, pose = keys
    moved = pose.copy()
    moved[4] = composed(pose[4], [0.05, 0.0, 0.0])
    found = aligned_scan(
        PointStore.of(scans),
        moved,
        moving=4,
        prior=moved[4],
        prior_information=1e9 * np.eye(3),
        gates_m=(0.3,),
    )
    np.testing.assert_allclose(found.pose, moved[4], atol=1e-4)


def test_the_back_of_a_wall_is_not_its_front():
    one = drives.keys(
        worlds.laser_scans(worlds.driven([(1, 1), (1.1, 1)]), [worlds.FRONT]),
        worlds.driven([(1, 1), (1.1, 1)]),
    ).scans[0]
    # Seen from behind, every surface faces the other way.
    other = type(one)(**{**vars(one), "normal": -one.normal})
    fits = pair_fits(PointStore.of([one, other]), np.zeros((2, 3)), np.array([[0, 1]]), gate_m=0.3)
    assert fits.matched[0] < 0.1 * len(one)


def test_the_share_matched_counts_each_return_once(keys):
    scans, pose = keys
    store = PointStore.of([scans[4], scans[4], scans[4]])
    same = np.tile(pose[4], (3, 1))
    assert matched_share(store, same, moving=0, gate_m=0.05) == 1.0
    away = same.copy()
    away[0, :2] += 50.0
    assert matched_share(store, away, moving=0, gate_m=0.05) == 0.0


def test_moving_everything_together_changes_nothing(keys):
    scans, pose = keys
    pairs = np.array([[3, 1], [6, 2]])
    elsewhere = composed(np.array([10.0, -4.0, 2.0]), pose)
    here = pair_fits(PointStore.of(scans), pose, pairs, gate_m=0.2)
    there = pair_fits(PointStore.of(scans), elsewhere, pairs, gate_m=0.2)
    np.testing.assert_allclose(here.information, there.information, rtol=1e-6)


def test_scatter_of_normals_tells_nothing_along_a_bare_wall():
    """Normals of the two scans err by 10 degrees, each by its own; a real second wall is kept."""
    rng = np.random.default_rng(6)
    along = np.linspace(-3, 3, 200)
    wall = np.stack([along, np.ones(200)], axis=-1)
    second = np.stack([np.full(40, 3.2), np.linspace(-1, 0.9, 40)], axis=-1)

    def seen(parts):
        end = np.concatenate([end for end, _ in parts])
        facing = np.concatenate([np.full(len(end), angle) for end, angle in parts])
        facing = facing + rng.normal(0, np.radians(10), len(end))
        order = strip_order(end)
        normal = np.stack([np.cos(facing), np.sin(facing)], axis=-1)
        return handmade_key(end[order], normal[order])

    parts = [(wall, -np.pi / 2), (wall * [1, -1], np.pi / 2)]
    pairs = np.array([[1, 0]])
    bare = PointStore.of([seen(parts), seen(parts)])
    ended = PointStore.of([seen([*parts, (second, np.pi)]) for _ in range(2)])
    pose = np.array([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0]])
    told = pair_fits(bare, pose, pairs, gate_m=0.15).information[0]
    assert told[1, 1] > 1e4
    assert told[0, 0] < 0.004 * told[1, 1]
    assert pair_fits(ended, pose, pairs, gate_m=0.15).information[0, 0, 0] > 2e3
