import numpy as np
import pytest
from scipy.optimize import least_squares

from soundmap.geometry import relative, wrapped_angle
from soundmap.mapping.pose_graph import Links, link_costs, link_errors, solved_graph, told_errors


def made_graph(count=12, seed=5, noise=0.05):
    rng = np.random.default_rng(seed)
    truth = np.column_stack([rng.uniform(-3, 3, (count, 2)), rng.uniform(-3, 3, count)])
    truth[0] = 0.0
    pairs = np.array([(k, k - 1) for k in range(1, count)] + [(5, 0), (9, 2), (count - 1, 1)])
    root = rng.normal(0, 1, (len(pairs), 3, 3))
    information = root @ np.swapaxes(root, 1, 2) + 5 * np.eye(3)
    measured = relative(truth[pairs[:, 1]], truth[pairs[:, 0]])
    measured = measured + rng.normal(0, noise, measured.shape)
    start = truth + rng.normal(0, 0.2, truth.shape) * (np.arange(count) > 0)[:, None]
    return truth, start, Links(pairs, measured, information)


def test_links_without_noise_are_met_exactly():
    truth, start, links = made_graph(noise=0.0)
    found = solved_graph(start, links, most_iterations=50)
    np.testing.assert_allclose(found.pose[:, :2], truth[:, :2], atol=1e-5)
    np.testing.assert_allclose(wrapped_angle(found.pose[:, 2] - truth[:, 2]), 0.0, atol=1e-5)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_solution_is_that_of_a_general_least_squares_solver(seed):
    _, start, links = made_graph(seed=seed)
    found = solved_graph(start, links, most_iterations=50)
    roots = np.linalg.cholesky(links.information)

    def residuals(flat):
        pose = np.concatenate([start[:1], flat.reshape(-1, 3)])
        return np.einsum("mji,mj->mi", roots, link_errors(pose, links)).ravel()

    slow = least_squares(residuals, start[1:].ravel(), xtol=1e-12, ftol=1e-12)
    assert found.cost == pytest.approx(2 * slow.cost, rel=2e-3)


def test_a_false_link_is_outvoted():
    truth, start, links = made_graph(noise=0.005, count=30)
    false = Links(np.array([[20, 3]]), np.array([[9.0, 9.0, 1.0]]), 100 * np.eye(3)[None])
    twice = Links.joined([links, links, links, false])
    plain = solved_graph(start, twice, most_iterations=50)
    robust = solved_graph(start, twice, most_iterations=50, robust_scale=2.0)
    off = [np.hypot(*(found.pose - truth)[:, :2].T).max() for found in (plain, robust)]
    assert off[1] < 0.3 * off[0]


def test_the_first_pose_is_held_and_the_cost_never_rises():
    _, start, links = made_graph()
    found = solved_graph(start, links)
    np.testing.assert_array_equal(found.pose[0], start[0])
    assert found.cost <= link_costs(start, links).sum()


def test_a_single_pose_stays():
    none = Links(np.empty((0, 2), dtype=np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))
    alone = np.array([[1.0, 2.0, 3.0]])
    np.testing.assert_array_equal(solved_graph(alone, none).pose, alone)


def test_links_need_a_measurement_each():
    with pytest.raises(ValueError, match="a pair"):
        Links(np.zeros((2, 2), dtype=np.int64), np.zeros((1, 3)), np.zeros((2, 3, 3)))


def test_an_error_along_a_corridor_is_none_that_a_link_tells_of():
    pose = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.1]])
    links = Links(
        np.array([[1, 0], [1, 0]]),
        np.array([[0.8, 0.03, 0.1], [0.8, 0.03, 0.0]]),
        np.array([np.diag([0.0, 9e4, 1e4]), np.diag([9e4, 9e4, 1e4])]),
    )
    off_m, off_rad = told_errors(pose, links)
    np.testing.assert_allclose(off_m, [0.03, np.hypot(0.2, 0.03)])
    np.testing.assert_allclose(off_rad, [0.0, 0.1], atol=1e-12)
