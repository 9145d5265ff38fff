import numpy as np
import pytest

from soundmap.geometry import composed, relative, wrapped_angle
from soundmap.localize import smoothing
from soundmap.localize.smoothing import carried, smoothed_poses


def drive(count=60, seed=0):
    rng = np.random.default_rng(seed)
    step = np.zeros((count - 1, 3))
    step[:, 0], step[:, 2] = 0.1, rng.normal(0, 0.1, count - 1)
    pose = [np.array([1.0, 2.0, 3.0])]
    for part in step:
        pose.append(composed(pose[-1], part))
    return np.array(pose), step


def fixes_at(target, information):
    """Scans that say where each pose is, each with its own 3 x 3 information."""

    def evidence(pose):
        off = pose - target
        off[:, 2] = wrapped_angle(off[:, 2])
        return information.copy(), -np.einsum("kij,kj->ki", information, off)

    return evidence


WEIGHT = np.diag([1e4, 1e4, 1e5])


def weights(count):
    return np.repeat(WEIGHT[None], count, axis=0)


def test_perfect_evidence_gives_back_the_truth_from_a_poor_guess():
    truth, step = drive()
    information = np.repeat(np.diag([400.0, 400.0, 1000.0])[None], len(truth), axis=0)
    rng = np.random.default_rng(1)
    guess = truth + rng.normal(size=truth.shape) * [0.2, 0.2, 0.05]
    found = smoothed_poses(step, weights(len(step)), guess, fixes_at(truth, information))
    assert np.abs(found.pose - truth)[:, :2].max() < 1e-3
    assert np.abs(wrapped_angle(found.pose[:, 2] - truth[:, 2])).max() < 1e-3


def test_an_interval_without_scans_is_bridged_from_both_sides():
    truth, step = drive(80)
    information = np.repeat(np.diag([1e4, 1e4, 1e5])[None], len(truth), axis=0)
    information[20:60] = 0.0
    rng = np.random.default_rng(2)
    noisy = step + rng.normal(size=step.shape) * [0.005, 0.005, 0.003]
    trusted = np.ones(80, dtype=bool)
    trusted[20:60] = False
    guess = carried(truth + 0.0, noisy, trusted)
    found = smoothed_poses(noisy, weights(79), guess, fixes_at(truth, information))
    off = np.hypot(*(found.pose - truth)[:, :2].T)
    assert off[20:60].max() < 0.1
    spread = np.sqrt(found.covariance[:, 0, 0] + found.covariance[:, 1, 1])
    assert spread[40] > 3 * spread[10]
    assert np.argmax(spread) in range(30, 50)


def test_systematic_errors_of_the_odometry_add_up_where_no_scan_holds_the_pose():
    truth, step = drive(200)
    information = np.zeros((200, 3, 3))
    information[0] = np.diag([1e6, 1e6, 1e8])
    found = smoothed_poses(step, weights(199), truth, fixes_at(truth, information))
    way_m = np.hypot(step[:, 0], step[:, 1]).sum()
    away_m = np.hypot(*(truth[-1] - truth[0])[:2])
    sigma_m = np.sqrt(np.trace(found.covariance[-1, :2, :2]))
    assert sigma_m > smoothing.SYSTEMATIC[0] * away_m
    assert sigma_m < 0.2 * way_m


def test_covariances_are_the_blocks_of_the_inverse_of_the_whole_system(monkeypatch):
    """Central differences of the cost give the full matrix, inverted without any band."""
    monkeypatch.setattr(smoothing, "SYSTEMATIC", (0.0, 0.0, 0.0))
    truth, step = drive(6)
    information = np.repeat(np.diag([300.0, 200.0, 900.0])[None], 6, axis=0)
    evidence = fixes_at(truth, information)
    found = smoothed_poses(step, weights(5), truth, evidence)

    def residuals(flat):
        pose = flat.reshape(-1, 3)
        error = relative(pose[:-1], pose[1:]) - step
        error[:, 2] = wrapped_angle(error[:, 2])
        off = pose - truth
        root = np.sqrt(np.diag(WEIGHT)), np.sqrt([300.0, 200.0, 900.0])
        return np.concatenate([(error * root[0]).ravel(), (off * root[1]).ravel()])

    flat, small = found.pose.ravel(), 1e-6
    jacobian = np.array(
        [
            (residuals(flat + small * unit) - residuals(flat - small * unit)) / (2 * small)
            for unit in np.eye(18)
        ]
    ).T
    full = np.linalg.inv(jacobian.T @ jacobian)
    for k in range(6):
        block = full[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        assert found.covariance[k] == pytest.approx(block, rel=1e-3, abs=1e-9)


def test_a_slipping_wheel_does_not_bend_the_poses_around():
    truth, step = drive()
    information = np.repeat(np.diag([2e3, 2e3, 5e3])[None], len(truth), axis=0)
    slipped = step.copy()
    slipped[30] += [0.3, 0.0, 0.5]
    found = smoothed_poses(slipped, weights(len(step)), truth.copy(), fixes_at(truth, information))
    assert np.hypot(*(found.pose - truth)[:, :2].T).max() < 0.02


def test_untrusted_poses_are_carried_from_the_nearest_trusted_one():
    truth, step = drive(10)
    pose = truth.copy()
    trusted = np.array([1, 1, 0, 0, 0, 0, 0, 0, 1, 1], dtype=bool)
    pose[~trusted] = 99.0
    assert carried(pose, step, trusted) == pytest.approx(truth)
    assert np.array_equal(carried(pose, step, np.zeros(10, dtype=bool)), pose)


def test_cost_per_pose_does_not_grow_with_the_run():
    """The system is solved as a band: a thousand poses need no thousand-fold matrix."""
    truth, step = drive(3000)
    information = np.repeat(np.diag([400.0, 400.0, 1000.0])[None], len(truth), axis=0)
    found = smoothed_poses(step, weights(len(step)), truth + 0.01, fixes_at(truth, information))
    assert np.abs(found.pose - truth)[:, :2].max() < 1e-3
