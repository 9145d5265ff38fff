import numpy as np

from soundmap.outputs.labels import LETTER_HEIGHT, LETTER_WIDTH, is_far, label_offsets


def boxes(points, names, offsets):
    for point, name, offset in zip(points, names, offsets, strict=True):
        if offset is not None:
            half = np.array([LETTER_WIDTH * len(name), LETTER_HEIGHT]) / 2
            yield np.concatenate([point + offset - half, point + offset + half])


def test_labels_cover_neither_one_another_nor_other_markers_nor_the_edge():
    rng = np.random.default_rng(2)
    points = rng.uniform(5.0, 195.0, (30, 2))
    names = [f"S{number}" for number in range(1, 31)]
    offsets = label_offsets(points, names, (200.0, 200.0), marker=10.0)
    placed = list(boxes(points, names, offsets))
    assert len(placed) > 15
    for index, box in enumerate(placed):
        assert (box >= 0).all()
        assert (box <= 200).all()
        for other in placed[index + 1 :]:
            assert (box[2:] <= other[:2]).any() or (box[:2] >= other[2:]).any()


def test_the_loudest_are_labelled_where_there_is_no_room_for_all():
    points = np.full((20, 2), 50.0)
    names = [f"S{number}" for number in range(1, 21)]
    offsets = label_offsets(points, names, (100.0, 100.0), marker=2.0)
    assert offsets[0] is not None
    assert offsets[-1] is None
    labelled = [offset is not None for offset in offsets]
    assert labelled == sorted(labelled, reverse=True)


def test_at_the_edge_a_label_goes_inwards():
    ((x, y),) = label_offsets(np.array([[199.0, 199.0]]), ["S1"], (200.0, 200.0), marker=10.0)
    assert x < 0
    assert y < 0


def test_each_of_a_few_near_ones_has_its_label_if_need_be_far_off():
    cross = np.array([[0.0, 0.0], [20.0, 0.0], [-20.0, 0.0], [0.0, 20.0], [0.0, -20.0]])
    points = np.array([100.0, 100.0]) + cross
    names = [f"S{number}*" for number in range(1, 6)]
    offsets = label_offsets(points, names, (200.0, 200.0), marker=15.0)
    placed = list(boxes(points, names, offsets))
    assert len(placed) == 5
    assert [is_far(offset) for offset in offsets] == [True, False, False, False, False]
    for box in placed:
        gap = points - np.clip(points, box[:2], box[2:])
        assert np.hypot(*gap.T).min() >= 7.5


def test_a_label_without_a_line_is_clearly_nearest_to_its_own_marker():
    rng = np.random.default_rng(4)
    points = rng.uniform(20.0, 180.0, (12, 2))
    names = [f"S{number}" for number in range(1, 13)]
    offsets = label_offsets(points, names, (200.0, 200.0), marker=15.0)
    near = [index for index, offset in enumerate(offsets) if offset and not is_far(offset)]
    assert len(near) > 5
    for index in near:
        distance = np.hypot(*(points - points[index] - offsets[index]).T)
        assert np.argmin(distance) == index
