import numpy as np
import pytest

from soundmap.along_walls import unsupported, without_hearsay


def test_what_walls_of_one_direction_seem_to_say_along_them_is_taken_off():
    normal = np.array([np.sin(0.4), np.cos(0.4), 0.0])
    along = np.array([np.cos(0.4), -np.sin(0.4), 0.0])
    turn = np.diag([0.0, 0.0, 5000.0])
    corridor = 3000.0 * np.outer(normal, normal) + 3.0 * np.outer(along, along) + turn
    corner = 3000.0 * np.outer(normal, normal) + 900.0 * np.outer(along, along) + turn
    pull = np.stack([30.0 * normal + 2.0 * along] * 2)
    information, pulled = without_hearsay(np.stack([corridor, corner]), pull)
    assert along @ information[0] @ along == pytest.approx(0.0, abs=1e-6)
    assert along @ pulled[0] == pytest.approx(0.0, abs=1e-6)
    assert normal @ information[0] @ normal == pytest.approx(3000.0)
    assert along @ information[1] @ along == pytest.approx(891.0)
    assert normal @ pulled[1] == pytest.approx(30.0)


def test_what_is_in_doubt_is_taken_off_along_walls_but_never_more_than_is_known():
    information = np.tile(np.diag([3000.0, 400.0, 5000.0]), (3, 1, 1))
    doubt = np.zeros((3, 2, 2))
    doubt[:, 1, 1] = 100.0, 1e4, -50.0
    told, _ = without_hearsay(information, np.zeros((3, 3)), doubt)
    np.testing.assert_allclose(told[:, 1, 1], [400.0 - 9.0 - 100.0, 0.0, 400.0], atol=1e-9)
    np.testing.assert_allclose(told[:, 0, 0], 3000.0)


def test_what_a_single_scan_sees_is_unsupported_and_what_its_neighbours_see_is_not():
    corridor, corner = np.diag([3000.0, 0.0, 5000.0]), np.diag([3000.0, 60.0, 5000.0])
    once = np.stack([corridor] * 5 + [corner] + [corridor] * 5)
    often = np.stack([corridor] * 5 + [corner] * 4)
    doubt = unsupported(once)
    assert doubt[5, 1, 1] == pytest.approx(60.0)
    assert not np.delete(doubt, 5, axis=0).any()
    assert not unsupported(often).any()
    assert not unsupported(corner[None]).any()


def test_what_is_known_of_the_place_by_the_heading_alone_counts_at_no_scan():
    row = np.array([0.0, 1.0, 3.0])  # returns 3 m ahead tell y if the heading is known
    told = np.diag([3000.0, 0.0, 0.0]) + 100.0 * np.outer(row, row)
    assert unsupported(np.stack([told, np.diag([3000.0, 0.0, 1.0])])) == pytest.approx(
        0.0, abs=1e-6
    )


def test_evidence_never_becomes_negative_whatever_is_in_doubt():
    rng = np.random.default_rng(7)
    root = rng.normal(size=(500, 3, 3)) * [1.0, 1.0, 3.0]
    information = root @ root.swapaxes(1, 2)
    doubt = np.tile(1e6 * np.eye(2), (500, 1, 1))
    told, _ = without_hearsay(information, np.zeros((500, 3)), doubt)
    assert np.linalg.eigvalsh(told).min() > -1e-6
