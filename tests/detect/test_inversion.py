import numpy as np
import pytest

from soundmap.detect.inversion import invert


@pytest.mark.parametrize("size", [1, 2, 24, 75])
def test_inverses_are_those_of_double_precision(size):
    """Though loud modes make some directions a million times wider than others."""
    rng = np.random.default_rng(size)
    modes = rng.normal(size=(7, max(1, size // 2), size)).astype(np.float32) * 100.0
    covariance = np.matmul(modes.transpose(0, 2, 1), modes) + np.eye(size, dtype=np.float32)
    expected = np.linalg.inv(covariance.astype(np.float64))
    invert(covariance)
    assert np.abs(covariance - expected).max() < 1e-6 * np.abs(expected).max()
    assert np.array_equal(covariance, covariance.transpose(0, 2, 1))


def test_no_matrices_have_no_inverses():
    nothing = np.empty((0, 5, 5), dtype=np.float32)
    invert(nothing)
    assert nothing.shape == (0, 5, 5)
