import numpy as np
import pytest

from soundmap.detect.inversion import inverse_covariances


def inverted(modes, variance):
    out = np.empty((*variance.shape, variance.shape[1]), dtype=np.float32)
    inverse_covariances(modes, variance, out)
    return out


@pytest.mark.parametrize(("count", "size"), [(0, 4), (1, 1), (12, 24), (20, 75), (40, 24)])
def test_inverses_are_those_of_double_precision(count, size):
    """Though loud modes make some directions a million times wider than others."""
    rng = np.random.default_rng(size)
    modes = rng.normal(size=(count, 7, size)).astype(np.float32) * np.float32(100.0)
    modes[::2] /= np.float32(500.0)
    variance = rng.uniform(1.0, 3.0, size=(7, size)).astype(np.float32)
    wide = modes.astype(np.float64)
    covariance = np.einsum("msi,msj->sij", wide, wide)
    covariance[:, np.arange(size), np.arange(size)] += variance
    expected = np.linalg.inv(covariance)
    assert np.abs(inverted(modes, variance) - expected).max() < 1e-6
    assert np.abs(expected).max() > 0.01


def test_no_matrices_have_no_inverses():
    nothing = np.empty((0, 5), dtype=np.float32)
    assert inverted(np.empty((3, 0, 5), dtype=np.float32), nothing).shape == (0, 5, 5)
