from types import SimpleNamespace

import numpy as np

from soundmap.detect.steadiness import steadiness

STRETCHES, SCANS, NUMBERS = 40, 10, 6
STARTS = np.array([0, NUMBERS])
STRETCH = np.repeat(np.arange(STRETCHES), SCANS)


def fitted(columns, heard):
    flat = columns.reshape(len(columns), -1)
    gram = flat @ flat.T
    strength = np.linalg.solve(gram, flat @ heard.ravel())
    residual = heard - np.einsum("k,ksd->sd", strength, columns)
    return SimpleNamespace(
        components=[
            SimpleNamespace(column=column, strength=np.array([each]))
            for column, each in zip(columns, strength, strict=True)
        ],
        pulls=lambda: columns * residual,  # all noise alike, no far field
        gram=gram[None],
        evidence=SimpleNamespace(table=SimpleNamespace(starts=STARTS)),
    )


def test_errors_that_neighbouring_scans_share_count_once():
    rng = np.random.default_rng(4)
    column = np.ones((1, len(STRETCH), NUMBERS))
    sigma = 0.5
    heard = 1.0 + sigma * rng.standard_normal(STRETCHES)[STRETCH, None] * np.ones(NUMBERS)
    (value,) = steadiness(fitted(column, heard), STRETCH)
    expected = np.sqrt(STRETCHES) / sigma
    assert 0.7 * expected < value < 1.4 * expected


def test_what_one_stretch_alone_tells_is_not_steady():
    rng = np.random.default_rng(5)
    column = np.ones((1, len(STRETCH), NUMBERS))
    noise = 0.1 * rng.standard_normal(column.shape[1:])
    everywhere = noise + 1.0
    in_one = noise + STRETCHES * (STRETCH == 7)[:, None]
    (steady,) = steadiness(fitted(column, everywhere), STRETCH)
    (ghost,) = steadiness(fitted(column, in_one), STRETCH)
    assert steady > 50.0
    assert ghost < 1.5


def test_two_that_cannot_be_told_apart_are_both_uncertain():
    rng = np.random.default_rng(6)
    first = rng.standard_normal((len(STRETCH), NUMBERS))
    second = first + 0.02 * rng.standard_normal(first.shape)
    heard = first + 0.5 * rng.standard_normal(STRETCHES)[STRETCH, None] * first
    alone = steadiness(fitted(first[None], heard), STRETCH)
    pair = steadiness(fitted(np.stack([first, second]), heard), STRETCH)
    assert pair.min() < 0.2 * alone[0]
