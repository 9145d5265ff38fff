import numpy as np

from soundmap.detect.matched_filter import fast_arctan2


def test_the_fast_arctan2_is_that_of_numpy_in_all_directions():
    angle = np.linspace(-np.pi + 1e-6, np.pi - 1e-6, 4001)
    fast = [fast_arctan2(3.0 * np.sin(a), 3.0 * np.cos(a)) for a in angle]
    np.testing.assert_allclose(fast, angle, atol=3e-5)
    corners = [(0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0), (1.0, 1.0), (-1.0, -1.0)]
    for y, x in corners:
        assert abs(fast_arctan2(y, x) - np.arctan2(y, x)) < 3e-5
