from itertools import pairwise

import numpy as np

from soundmap.detect import steps
from soundmap.detect.sound_paths import Kind
from soundmap.detect.steps import move
from soundmap.detect.unknowns import derivatives
from tests.detect.box_room import FAR, WIDTH, begun_fit


def fitted(emitters, x, y, **more):
    fit = begun_fit(emitters, **more)
    component = fit.add(np.array([x, y]), 0.3, Kind.SOURCE)
    fit.renew()
    for _ in range(8):
        move(fit)
    return fit, component


def test_small_steps_lead_to_where_bearings_point():
    _, component = fitted([(5.5, 3.1, 20.0)], 5.35, 3.25)
    np.testing.assert_allclose(component.place_m, (5.5, 3.1), atol=0.03)


def test_a_source_is_held_before_the_wall_that_its_sound_seems_to_come_out_of(monkeypatch):
    in_the_wall = [(6.25, 3.1, 0.5)]  # no louder than what surrounds it
    _, held = fitted(in_the_wall, 5.9, 3.1)
    monkeypatch.setattr(steps, "HOLD_BEHIND", 0.0)
    _, free = fitted(in_the_wall, 5.9, 3.1)
    assert free.place_m[0] > WIDTH + 0.15
    assert held.place_m[0] - WIDTH < 0.6 * (free.place_m[0] - WIDTH)


def test_a_step_that_the_far_field_could_explain_leads_to_the_same_place():
    _, component = fitted([(5.5, 3.1, 4.0)], 5.35, 3.25, far=FAR)
    np.testing.assert_allclose(component.place_m, (5.5, 3.1), atol=0.05)


def test_half_steps_come_to_rest_where_whole_ones_swing():
    fit = begun_fit([(5.5, 3.1, 20.0)])
    source = fit.add(np.array([5.5, 3.1]), 0.3, Kind.SOURCE)
    fit.refit()
    fit.renew()
    for _ in range(12):
        move(fit, share=0.5)
    at_rest = source.place_m.copy()
    move(fit, share=0.5)
    np.testing.assert_allclose(source.place_m, at_rest, atol=0.002)


def test_the_far_field_is_taken_out_of_the_equations_of_places():
    fit = begun_fit([(5.5, 3.1, 20.0)], far=FAR)
    fit.add(np.array([5.4, 3.0]), 0.3, Kind.SOURCE)
    fit.refit()
    hessian, _, owners = steps._system(fit, fit.components)
    count, starts = len(owners), fit.evidence.table.starts
    own = np.stack(list(derivatives(fit, owners, slice(None)))).astype(np.float64)
    column = fit.components[0].column.astype(np.float64)
    size = int(starts[-1])
    far = np.stack([fit.far_field.heard(unit) for unit in np.eye(size)]).astype(np.float64)
    inverse = fit.far_field.inverse(fit.precision)
    coupling = np.einsum("ksd,fsd->kf", own, far)
    squares = np.einsum("ksd,lsd->kl", own, own) - coupling @ inverse @ coupling.T
    scale = np.sqrt(np.diag(squares))
    held = (hessian[:count, :count] - squares) / np.outer(scale, scale)
    assert np.abs(held - np.diag(np.diag(held))).max() < 1e-3  # places and shares are held
    own_far = np.einsum("sd,fsd->f", column, far)
    for band, (start, stop) in enumerate(pairwise(starts)):
        across = np.einsum("ksd,sd->k", own[:, :, start:stop], column[:, start:stop])
        part = slice(start, stop)
        across = across - coupling[:, part] @ inverse[part, part] @ own_far[part]
        size_of = scale * np.linalg.norm(column[:, part])
        np.testing.assert_allclose(hessian[:count, count + band] / size_of, across / size_of,
                                   atol=2e-4)  # fmt: skip


def test_only_places_move_if_nothing_else_shall():
    fit = begun_fit([(5.5, 3.1, 20.0, (0.0, -0.8))], reflected=0.8)
    source = fit.add(np.array([5.4, 3.0]), 0.3, Kind.SOURCE)
    fit.directed = True
    fit.refit()
    shares, place = dict(source.shares), source.place_m.copy()
    move(fit, only_places=True)
    assert np.hypot(*(source.place_m - place)) > 0.01
    assert source.shares == shares
    assert not source.directivity.any()
    move(fit)
    assert source.shares != shares
    assert source.directivity.any()
