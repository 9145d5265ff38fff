import numpy as np
import pytest

from soundmap.along_walls import without_hearsay


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
