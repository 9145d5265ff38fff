"""Image sources against pyroomacoustics in a shoebox, and against geometry elsewhere."""

import numpy as np
import pyroomacoustics as pra
import pytest

from soundmap.simulate.floor_plan import FloorPlan
from soundmap.simulate.image_sources import level_sequences, visible, wall_sequences
from soundmap.simulate.propagation import KNOT_STEP, SoundTable
from soundmap.simulate.scene import Source
from soundmap.simulate.sound_field import Emitter, SoundField

SIZE = (6.0, 4.5, 2.6)
SOURCE, RECEIVER = np.array([1.3, 3.1, 0.4]), np.array([4.1, 1.2, 0.9])
WALLS = {"south": 0.9, "east": 0.8, "north": 0.85, "west": 0.7, "floor": 0.6, "ceiling": 0.5}
RATE, SPEED = 48000.0, 343.0


def shoebox_plan() -> FloorPlan:
    x, y, _ = SIZE
    return FloorPlan.from_rings([[[0, 0], [x, 0], [x, y], [0, y]]], [list(WALLS.values())[:4]])


def peer_images(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Image positions (N, 3) and pressure coefficients (N,) after pyroomacoustics."""
    materials = {name: pra.Material(1.0 - value**2) for name, value in WALLS.items()}
    room = pra.ShoeBox(SIZE, fs=48000, materials=materials, max_order=order, air_absorption=False)
    room.add_source(SOURCE)
    room.add_microphone(RECEIVER)
    room.image_source_model()
    return room.sources[0].images.T, room.sources[0].damping[0]


def own_images(plan: FloorPlan, order: int) -> tuple[np.ndarray, np.ndarray]:
    levels = level_sequences(SIZE[2], WALLS["floor"], WALLS["ceiling"], order)
    place, coefficient = [], []
    for sequences in wall_sequences(plan, order):
        seen = visible(sequences, plan, SOURCE[None, :2], RECEIVER[None, :2])[:, 0]
        flat = sequences.images(SOURCE[:2])[:, -1]
        for i in np.flatnonzero(seen):
            for v in np.flatnonzero(levels.order <= order - sequences.order):
                height = levels.sign[v] * SOURCE[2] + levels.shift_m[v]
                place.append([*flat[i], height])
                coefficient.append(sequences.coefficient[i] * levels.coefficient[v])
    return np.array(place), np.array(coefficient)


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_the_images_of_a_shoebox_are_those_of_pyroomacoustics(order: int) -> None:
    place, coefficient = own_images(shoebox_plan(), order)
    peer_place, peer_coefficient = peer_images(order)
    assert len(place) == len(peer_place)
    for image, expected in zip(peer_place, peer_coefficient, strict=True):
        nearest = np.argmin(np.linalg.norm(place - image, axis=1))
        assert place[nearest] == pytest.approx(image, abs=1e-4)
        assert coefficient[nearest] == pytest.approx(expected, rel=1e-4)


def test_the_early_response_of_a_shoebox_is_that_of_pyroomacoustics() -> None:
    centre, width = 500.0, 3.0  # a short pulse [samples]

    def pulse(at: np.ndarray) -> np.ndarray:
        return np.exp(-0.5 * ((at - centre) / width) ** 2)

    table = SoundTable.from_period(pulse(np.arange(4 * 8192) / 4).astype(np.float32), 4, RATE)
    source = Source(id="S", position_m=tuple(SOURCE), level_dba_5cm=80.0)
    plan = shoebox_plan()
    field = SoundField(
        plan,
        SPEED,
        tuple(wall_sequences(plan, 2)),
        level_sequences(SIZE[2], WALLS["floor"], WALLS["ceiling"], 2),
        (Emitter(source, np.zeros(4097, dtype=complex), table),),
        (),
    )
    knots = 31
    out = np.zeros((1, (knots - 1) * KNOT_STEP), dtype=np.float32)
    field.add_sound(
        out, np.arange(knots) * KNOT_STEP / RATE, np.tile(RECEIVER, (1, knots, 1)).astype(float)
    )
    time = np.arange(out.shape[1])
    expected = np.zeros(out.shape[1])
    for image, coefficient in zip(*peer_images(2), strict=True):
        distance = float(np.linalg.norm(image - RECEIVER))
        expected += coefficient / distance * pulse(time - distance / SPEED * RATE)
    # An arrival late by 0.1 sample would differ by 2 % of its height, a gain off by 1 % by 1 %.
    assert np.abs(out[0] - expected).max() < 0.005 * expected.max()


def test_a_pillar_hides_the_source_and_a_reflection_goes_round_it() -> None:
    plan = FloorPlan.from_rings(
        [
            [[0, 0], [8, 0], [8, 8], [0, 8]],
            [[3, 1], [5, 1], [5, 5], [3, 5]],
        ],
        [0.9, 0.9],
    )
    source, receiver = np.array([[1.0, 4.0]]), np.array([[7.0, 4.0], [1.0, 7.0]])
    source = np.repeat(source, 2, axis=0)
    direct, once, _ = wall_sequences(plan, 2)
    assert visible(direct, plan, source, receiver)[0].tolist() == [False, True]
    seen = visible(once, plan, source, receiver)
    assert once.walls[seen[:, 0], 0].tolist() == [2]  # only by the upper outer wall
    assert {1, 4, 5, 6}.isdisjoint(once.walls[seen[:, 1], 0].tolist())


def test_a_niche_reflects_only_where_its_wall_is() -> None:
    corners = [[0, 0], [6, 0], [6, 3], [4, 3], [4, 4], [2, 4], [2, 3], [0, 3]]
    plan = FloorPlan.from_rings([corners], [1.0])
    _, once = wall_sequences(plan, 1)
    niche = int(np.flatnonzero((plan.start_m[:, 1] == 4) & (plan.end_m[:, 1] == 4))[0])
    source = np.array([[2.5, 2.0], [0.5, 2.0]])
    receiver = np.array([[3.5, 2.0], [5.5, 2.0]])
    seen = visible(once, plan, source, receiver)[once.walls[:, 0] == niche][0]
    assert seen.tolist() == [True, False]  # the second way meets the niche's edge
