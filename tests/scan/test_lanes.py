from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError

from soundmap.scan.lanes import (
    LANES,
    constant,
    lanes_array,
    load,
    minus_product,
    plus_product,
    spread,
    store,
    transpose,
    whole_lanes,
)


@njit
def sums(a, b, result):
    x, y, z = load(a, 1), load(b, 3), spread(a, 2)
    store(result, 0, x + y)
    store(result, LANES, x - y)
    store(result, 2 * LANES, x * y)
    store(result, 3 * LANES, plus_product(z, x, y))
    store(result, 4 * LANES, minus_product(z, x, y))
    store(result, 5 * LANES, constant(1.5) * z)


@njit
def transposed(rows, columns):
    transpose(rows, LANES, columns, 2, LANES + 5)


def test_arithmetic_is_that_of_single_numbers():
    rng = np.random.default_rng(1)
    a, b = rng.standard_normal((2, 40)).astype(np.float32)
    result = np.zeros((6, LANES), dtype=np.float32)
    sums(a, b, result)
    x, y = a[1 : 1 + LANES], b[3 : 3 + LANES]
    assert np.array_equal(result[:3], [x + y, x - y, x * y])
    assert np.allclose(result[3:5], [a[2] + x * y, a[2] - x * y], rtol=0, atol=1e-6)
    assert np.array_equal(result[5], np.full(LANES, np.float32(1.5) * a[2]))


def test_rows_become_columns():
    rows = np.arange(18 * LANES, dtype=np.float32).reshape(18, LANES)
    columns = np.full((LANES, LANES + 5), -1.0, dtype=np.float32)
    transposed(rows, columns)
    assert np.array_equal(columns[:, 2 : 2 + LANES], rows[1 : 1 + LANES].T)
    assert np.all(np.delete(columns, np.s_[2 : 2 + LANES], axis=1) == -1.0)


def test_memory_for_lanes_begins_a_cache_line():
    for shape in [(3,), (5, 16), (2, 3, 32)]:
        array = lanes_array(*shape)
        assert array.shape == shape
        assert array.ctypes.data % 64 == 0
        assert not array.any()
    assert [whole_lanes(count) for count in (1, 16, 17)] == [16, 16, 32]


@pytest.mark.parametrize("array", [np.zeros(32), np.zeros((32, 2), dtype=np.float32)[:, 0]])
def test_other_arrays_are_refused(array):
    with pytest.raises(TypingError, match="float32 in C order"):
        sums(array, array, array)
