from dataclasses import replace

import numpy as np
import pytest
from handmade import START_NS, made_ratio, made_run, round_trip, unlucky_run, walled_room
from matplotlib.figure import Figure
from matplotlib.image import AxesImage, imread

from soundmap.grid import GridFrame
from soundmap.outputs.figures import (
    audio_scan_figure,
    power_map_figure,
    power_ratio_figure,
    trajectory_figure,
    write_png,
)
from soundmap.outputs.floor import Area, area_of_interest, cropped
from soundmap.sound import AudioScans, LevelReference, PowerMap, SourceList


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
    assert legend(figure) == ["trajectory", "not to be trusted", "start", "end", "local maxima"]
    assert {"S1", "S2"} <= texts(figure)
    start, end = (line for line in figure.axes[0].lines if line.get_label() in ("start", "end"))
    assert start.get_xydata()[0].tolist() == made_run().trajectory.pose[0, :2].tolist()
    assert end.get_xydata()[0].tolist() == made_run().trajectory.pose[-1, :2].tolist()


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
    labels = [axes.get_ylabel() for axes in power_map_figure(run).axes[0].child_axes]
    assert labels == ["mean emitted power [dB re (full scale)²]"]
    calibrated = replace(run.power_map, reference=LevelReference.SOUND_PRESSURE)
    figure = power_map_figure(replace(run, power_map=calibrated))
    assert figure.axes[0].child_axes[0].get_ylabel() == "mean emitted power [dB re (20 µPa)²]"


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


def test_a_small_ratio_is_not_blown_up_to_full_colours():
    ratio = made_ratio()
    quiet = replace(ratio, ratio_db=np.clip(ratio.ratio_db, -0.5, 0.5), changes=())
    figure = power_ratio_figure(quiet, room=None, title="run1 against run1")
    assert figure.axes[0].images[-1].get_clim() == (-3.0, 3.0)


def test_the_audio_scans_stand_at_their_bearing_and_time_and_gaps_stay_empty():
    bearing = np.arange(8) * np.pi / 4
    power = np.full((6, 8), 1e-6, dtype=np.float32)
    power[0, 6] = 1e-3  # 270 degrees, that is -90
    time_ns = START_NS + np.array([0, 1, 2, 7, 8, 9]) * 100_000_000
    scans = AudioScans(time_ns, bearing, power, LevelReference.FULL_SCALE)
    drawn = drawn_values(audio_scan_figure(replace(made_run(), scans=scans)))
    assert drawn.shape == (8, 10)
    assert drawn[2, 0] == pytest.approx(-30.0)  # rows: -180, -135, -90, ...
    assert drawn.mask.all(axis=0).tolist() == [False] * 3 + [True] * 4 + [False] * 3


def test_an_hour_of_audio_scans_is_averaged_to_what_a_picture_can_show():
    time_ns = START_NS + np.arange(36_000) * 100_000_000
    power = np.ones((36_000, 4), dtype=np.float32)
    power[::2] = 3.0
    scans = AudioScans(time_ns, np.arange(4) * np.pi / 2, power, LevelReference.FULL_SCALE)
    drawn = drawn_values(audio_scan_figure(replace(made_run(), scans=scans)))
    assert drawn.shape == (4, 1200)
    np.testing.assert_allclose(drawn, 10 * np.log10(2.0), atol=1e-6)


@pytest.mark.parametrize("figure", [power_map_figure, audio_scan_figure])
def test_a_run_that_heard_nothing_says_so(figure):
    assert "nothing measured" in texts(figure(unlucky_run()))


@pytest.mark.parametrize(
    ("width_m", "height_m"), [(6.0, 4.5), (60.0, 2.0), (2.0, 60.0), (0.6, 0.4), (200.0, 150.0)]
)
def test_pictures_have_a_sensible_size_whatever_the_site(tmp_path, width_m, height_m):
    room = walled_room(width_m, height_m, step=0.05 if width_m < 100 else 0.2)
    run = replace(
        made_run(),
        room=room,
        trajectory=round_trip(width_m, height_m),
        sources=SourceList((), LevelReference.FULL_SCALE),
    )
    write_png(trajectory_figure(run), tmp_path / "trajectory.png")
    rows, columns, _ = imread(tmp_path / "trajectory.png").shape
    assert 300 <= rows <= 1300
    assert 500 <= columns <= 1400


@pytest.mark.parametrize("name", ["$x^{.mcap", "走廊[red].mcap", "a_b^c%.mcap"])
def test_the_name_of_a_log_is_never_taken_for_a_formula(tmp_path, name):
    run = replace(made_run(), log=made_run().log.with_name(name))
    write_png(power_map_figure(run), tmp_path / "power_map.png")
    assert (tmp_path / "power_map.png").read_bytes()[:4] == b"\x89PNG"


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
