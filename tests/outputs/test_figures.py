import io
from dataclasses import replace

import numpy as np
import pytest
from handmade import (
    fitted_run,
    heard_map,
    limited_run,
    made_ratio,
    made_run,
    round_trip,
    unlucky_run,
    walled_room,
)
from matplotlib.figure import Figure
from matplotlib.image import AxesImage, imread

from soundmap.grid import GridFrame
from soundmap.outputs.area import Area, area_of_interest, cropped
from soundmap.outputs.figures import power_map_figure, power_ratio_figure, trajectory_figure
from soundmap.outputs.picture_format import PictureFormat
from soundmap.outputs.pictures import picture_bytes
from soundmap.sound import LevelReference, PowerMap, Source, SourceList


def texts(figure: Figure) -> set[str]:
    return {text.get_text() for text in figure.axes[0].texts}


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def drawn_values(figure: Figure) -> np.ma.MaskedArray:
    """What the last image of the main axes shows, unmeasured cells masked."""
    image = figure.axes[0].images[-1]
    assert isinstance(image, AxesImage)
    return np.ma.masked_invalid(image.get_array())


def test_the_trajectory_shows_its_ends_its_lost_part_and_the_sources():
    figure = trajectory_figure(made_run())
    assert legend(figure) == ["trajectory", "not to be trusted", "start", "end", "found here"]
    assert {"S1", "S2"} <= texts(figure)
    start, end = (line for line in figure.axes[0].lines if line.get_label() in ("start", "end"))
    assert start.get_xydata()[0].tolist() == made_run().trajectory.pose[0, :2].tolist()
    assert end.get_xydata()[0].tolist() == made_run().trajectory.pose[-1, :2].tolist()


def test_what_is_only_a_limit_is_pale_and_the_legend_says_so():
    run = limited_run()
    figure = power_map_figure(run)
    alpha = figure.axes[0].images[-1].get_alpha()
    assert set(np.unique(alpha)) == {0.3, 1.0}
    assert np.sum(alpha == 1.0) == np.sum(~run.power_map.is_limit)
    assert "pale: at most so loud" in legend(figure)
    assert "pale: at most so loud" not in legend(power_map_figure(fitted_run()))


def test_a_wholly_usable_trajectory_has_no_lost_part_in_its_legend():
    run = made_run()
    trajectory = replace(run.trajectory, usable=np.ones(len(run.trajectory), dtype=bool))
    assert "not to be trusted" not in legend(trajectory_figure(replace(run, trajectory=trajectory)))


def test_direction_arrows_point_the_way_the_robot_drove():
    run = made_run()
    figure = trajectory_figure(run)
    arrows = [text for text in figure.axes[0].texts if text.get_text() == ""]
    assert len(arrows) == 10
    for arrow in arrows:
        tail, tip = np.array(arrow.xyann), np.array(arrow.xy)
        nearest = np.argmin(np.hypot(*(run.trajectory.pose[:, :2] - tip).T))
        heading = run.trajectory.pose[nearest, 2]
        assert np.dot(tip - tail, [np.cos(heading), np.sin(heading)]) > 0.04


def test_the_power_map_says_what_its_decibels_refer_to():
    run = made_run()
    labels = [axes.get_ylabel() for axes in power_map_figure(run).axes]
    assert labels == ["y [m]", "mean emitted power [dB re (full scale)²]"]
    calibrated = replace(run.power_map, reference=LevelReference.SOUND_PRESSURE)
    figure = power_map_figure(replace(run, power_map=calibrated))
    assert figure.axes[1].get_ylabel() == "mean emitted power [dB re (20 µPa)²]"


def test_unmeasured_cells_stay_empty_and_silent_cells_do_not():
    run = made_run()
    frame = GridFrame(0.05, (1.0, 1.0), (1, 3))
    power_map = PowerMap(
        frame, np.array([[2e-6, 0.0, 0.0]]), np.array([[2, 2, 0]]), LevelReference.FULL_SCALE
    )
    drawn = drawn_values(power_map_figure(replace(run, power_map=power_map)))
    assert drawn.mask.tolist() == [[False, False, True]]
    assert drawn[0, 0] == pytest.approx(-60.0)
    assert np.isfinite(drawn[0, 1])
    assert drawn[0, 1] < drawn[0, 0]


def test_the_colours_of_a_ratio_are_centred_on_no_difference():
    figure = power_ratio_figure(made_ratio(), room=walled_room(), title="run1 against run3")
    low, high = figure.axes[0].images[-1].get_clim()
    assert low == -high
    assert high == 20.0
    assert {"S1", "S2"} <= texts(figure)


def test_cells_without_a_background_of_their_own_are_marked():
    ratio = made_ratio()
    figure = power_ratio_figure(ratio, room=None, title="run1 against run3")
    (marks,) = (line for line in figure.axes[0].lines if "median" in str(line.get_label()))
    without = np.isfinite(ratio.ratio_db) & ~ratio.background_measured
    np.testing.assert_array_equal(ratio.frame.cells(marks.get_xydata()), np.argwhere(without))
    complete = replace(ratio, background_measured=np.ones_like(ratio.background_measured))
    figure = power_ratio_figure(complete, room=None, title="run1 against run3")
    assert not [line for line in figure.axes[0].lines if "median" in str(line.get_label())]


def test_what_is_not_significant_is_pale():
    ratio = made_ratio()
    chance = np.full(ratio.ratio_db.shape, np.nan)
    chance[5, 5:8] = 0.5, 0.001, 0.02
    figure = power_ratio_figure(replace(ratio, chance=chance), room=None, title="a against b")
    alpha = figure.axes[0].images[-1].get_alpha()
    assert (alpha == 1.0).sum() == 1
    assert set(np.unique(alpha)) == {0.3, 1.0}
    opaque = {c.get_label(): c.get_facecolor()[0, 3] for c in figure.axes[0].collections}
    assert opaque["appeared"] == opaque["louder"] == 1.0
    assert opaque["unchanged"] == 0.3
    plain = power_ratio_figure(ratio, room=None, title="a against b")
    assert plain.axes[0].images[-1].get_alpha() is None


def test_kinds_of_change_have_marks_of_their_own():
    figure = power_ratio_figure(made_ratio(), room=walled_room(), title="run1 against run3")
    assert {"appeared", "louder", "gone", "unchanged"} <= set(legend(figure))
    (louder,) = (c for c in figure.axes[0].collections if c.get_label() == "louder")
    red, _, blue, _ = louder.get_facecolor()[0]
    assert red > blue
    assert louder.get_offsets()[0].tolist() == [5.725, 3.375]


def test_uncertain_places_are_drawn_with_their_ellipses_and_remarks():
    figure = trajectory_figure(fitted_run())
    assert legend(figure)[-4:] == ["mirror image", "95 %", "found here", "found here, with remarks"]
    assert {"S1", "S2*"} <= texts(figure)
    (ellipses,) = (c for c in figure.axes[0].collections if c.get_label() == "95 %")
    (line,) = ellipses.get_segments()
    reach = np.abs(line - [5.7251234, 3.375]).max(axis=0)
    assert reach == pytest.approx(np.sqrt(5.991) * np.array([0.12, 0.05]), rel=1e-3)
    (images,) = (c for c in figure.axes[0].collections if c.get_label() == "mirror image")
    assert images.get_offsets().tolist() == [[3.1, -0.4]]


def test_a_small_ratio_is_not_blown_up_to_full_colours():
    ratio = made_ratio()
    quiet = replace(ratio, ratio_db=np.clip(ratio.ratio_db, -0.5, 0.5), changes=())
    figure = power_ratio_figure(quiet, room=None, title="run1 against run1")
    assert figure.axes[0].images[-1].get_clim() == (-3.0, 3.0)


def test_a_run_that_heard_nothing_says_so():
    figure = power_map_figure(unlucky_run())
    assert "nothing measured" in texts(figure)
    assert len(figure.axes) == 1  # no colour bar of levels that nobody measured


@pytest.mark.parametrize(
    ("width_m", "height_m"), [(6.0, 4.5), (60.0, 2.0), (2.0, 60.0), (0.6, 0.4), (200.0, 150.0)]
)
def test_pictures_have_a_sensible_size_whatever_the_site(width_m, height_m):
    room = walled_room(width_m, height_m, step=0.05 if width_m < 100 else 0.2)
    run = replace(
        made_run(),
        room=room,
        trajectory=round_trip(width_m, height_m),
        sources=SourceList((), LevelReference.FULL_SCALE),
    )
    content = picture_bytes(trajectory_figure(run), PictureFormat.PNG)
    rows, columns, _ = imread(io.BytesIO(content)).shape
    assert 300 <= rows <= 1300
    assert 800 <= columns <= 1400


@pytest.mark.parametrize("name", ["$x^{.mcap", "走廊[red].mcap", "a_b^c%.mcap"])
def test_the_name_of_a_log_is_never_taken_for_a_formula(name):
    run = replace(made_run(), log=made_run().log.with_name(name))
    assert picture_bytes(power_map_figure(run), PictureFormat.PNG)[:4] == b"\x89PNG"


def test_the_area_shows_the_run_and_what_is_near_it_not_the_whole_site():
    room = walled_room(200.0, 100.0, step=0.5)
    area = area_of_interest([np.array([[10.0, 50.0], [20.0, 55.0]])], room)
    assert area.left < 9.0
    assert area.right > 21.0
    assert area.width < 20.0


def test_cropping_keeps_every_cell_that_reaches_into_the_area():
    frame = GridFrame(1.0, (-2.0, 10.0), (5, 6))
    values = np.arange(30).reshape(5, 6)
    part, extent = cropped(values, frame, Area(-0.5, 1.5, 11.5, 12.5))
    np.testing.assert_array_equal(part, values[1:3, 1:4])
    assert extent == (-1.0, 2.0, 11.0, 13.0)


def overlap(a, b) -> bool:
    return a.x0 < b.x1 and b.x0 < a.x1 and a.y0 < b.y1 and b.y0 < a.y1


@pytest.mark.parametrize(("width_m", "height_m"), [(6.0, 4.5), (60.0, 2.0), (2.0, 60.0)])
def test_nothing_written_is_clipped_or_overlaps(width_m, height_m):
    room = walled_room(width_m, height_m)
    run = replace(
        made_run(made_run().log.with_name("a_name_of_a_log_that_is_rather_long_" * 3)),
        room=room,
        trajectory=round_trip(width_m, height_m),
        power_map=heard_map(room.frame, [(1.0, 1.0, 1e-6)]),
        sources=SourceList((Source(1.0, 1.0, 1e-6, 9),), LevelReference.FULL_SCALE),
    )
    for figure in (power_map_figure(run), trajectory_figure(run)):
        figure.canvas.draw()
        boxes = [text.get_window_extent() for text in figure.texts]
        boxes += [axes.xaxis.label.get_window_extent() for axes in figure.axes]
        boxes += [axes.yaxis.label.get_window_extent() for axes in figure.axes]
        boxes += [legend.get_window_extent() for legend in figure.legends]
        boxes = [box for box in boxes if box.width > 1 and box.height > 1]
        for index, box in enumerate(boxes):
            assert box.x0 >= 0
            assert box.y0 >= 0
            assert box.x1 <= figure.bbox.x1
            assert box.y1 <= figure.bbox.y1
            assert not any(overlap(box, other) for other in boxes[index + 1 :])
            assert not any(overlap(box, axes.get_window_extent()) for axes in figure.axes)


def test_the_truth_is_drawn_as_crosses_inside_the_picture():
    figure = power_map_figure(made_run(), truth=[(3.0, 0.3), (11.0, 3.0)])
    (crosses,) = (c for c in figure.axes[0].collections if c.get_label() == "truth")
    assert crosses.get_offsets().tolist() == [[3.0, 0.3], [11.0, 3.0]]
    assert figure.axes[0].get_xlim()[1] > 11.0
    assert "truth" not in legend(power_map_figure(made_run()))


def test_a_lone_loud_cell_of_a_huge_site_is_still_seen():
    room = walled_room(200.0, 150.0, step=0.2)
    frame = GridFrame(0.05, room.frame.origin_m, (3020, 4020))
    visits = np.zeros(frame.shape, dtype=np.int64)
    power_sum = np.zeros(frame.shape)
    visits[1234, 2345] = visits[10, 10] = 20
    power_sum[1234, 2345], power_sum[10, 10] = 2e-5, 2e-8
    run = replace(
        made_run(),
        room=room,
        trajectory=round_trip(200.0, 150.0),
        power_map=PowerMap(frame, power_sum, visits, LevelReference.FULL_SCALE),
    )
    figure = power_map_figure(run)
    drawn = drawn_values(figure)
    assert drawn.count() == 2
    row, column = np.unravel_index(np.argmax(drawn), drawn.shape)
    left, right, bottom, _ = figure.axes[0].images[-1].get_extent()
    edge = (right - left) / drawn.shape[1]
    assert edge * 1000 / 200.0 >= 2.5  # dots of a picture of 1000 dots
    x, y = frame.centres((1234, 2345))
    assert left + column * edge <= x <= left + (column + 1) * edge
    assert bottom + row * edge <= y <= bottom + (row + 1) * edge
    assert "greatest of each" in figure.axes[1].get_ylabel()


def test_a_difference_keeps_its_sign_where_cells_are_drawn_together():
    ratio = made_ratio()
    frame = GridFrame(0.05, (0.0, 0.0), (2000, 3000))
    level = np.full(frame.shape, np.nan)
    level[100, 200:203] = [1.0, -8.0, np.nan]
    measured = np.ones(frame.shape, dtype=bool)
    level[0, 0] = level[-1, -1] = 0.0
    sparse = replace(ratio, frame=frame, ratio_db=level, background_measured=measured, changes=())
    drawn = drawn_values(power_ratio_figure(sparse, room=None, title="run1 against run3"))
    assert drawn.min() == -8.0
