import numpy as np
import pytest
from handmade import START_NS, made_run, unlucky_run

from soundmap.outputs.time_figures import audio_scan_figure, unlocalized
from soundmap.sound import AudioScans, LevelReference


def figure_of(scans: AudioScans):
    return audio_scan_figure(scans, made_run().trajectory, "run1: audio scans")


def drawn_values(figure) -> np.ma.MaskedArray:
    """The bearing-time picture, cells without a scan masked."""
    return np.ma.masked_invalid(figure.axes[0].images[-1].get_array())


def test_the_audio_scans_stand_at_their_bearing_and_time_and_gaps_stay_empty():
    bearing = np.arange(8) * np.pi / 4
    power = np.full((6, 8), 1e-6, dtype=np.float32)
    power[0, 6] = 1e-3  # 270 degrees, that is -90
    time_ns = START_NS + np.array([0, 1, 2, 7, 8, 9]) * 100_000_000
    scans = AudioScans(time_ns, bearing, power, LevelReference.FULL_SCALE)
    drawn = drawn_values(figure_of(scans))
    assert drawn.shape == (8, 10)
    assert drawn[2, 0] == pytest.approx(-30.0)  # rows: -180, -135, -90, ...
    assert drawn.mask.all(axis=0).tolist() == [False] * 3 + [True] * 4 + [False] * 3


def test_an_hour_of_audio_scans_is_averaged_to_what_a_picture_can_show():
    time_ns = START_NS + np.arange(36_000) * 100_000_000
    power = np.ones((36_000, 4), dtype=np.float32)
    power[::2] = 3.0
    scans = AudioScans(time_ns, np.arange(4) * np.pi / 2, power, LevelReference.FULL_SCALE)
    drawn = drawn_values(figure_of(scans))
    assert drawn.shape == (4, 1000)
    np.testing.assert_allclose(drawn, 10 * np.log10(2.0), atol=1e-6)


def test_a_run_that_heard_nothing_says_so_and_shows_no_scale():
    figure = figure_of(unlucky_run().scans)
    for axes in figure.axes:
        assert "nothing measured" in {text.get_text() for text in axes.texts}
        assert len(axes.get_yticks()) == 0


def test_the_levels_are_those_of_the_loudest_bearing_and_of_the_mean():
    power = np.full((3, 4), 1e-6, dtype=np.float32)
    power[1, 2] = 5e-6
    time_ns = START_NS + np.arange(3) * 100_000_000
    scans = AudioScans(time_ns, np.arange(4) * np.pi / 2, power, LevelReference.SOUND_PRESSURE)
    lower = figure_of(scans).axes[1]
    lines = {line.get_label(): line.get_ydata() for line in lower.lines}
    # 10 log10(5e-6) = -53.010; the mean is 2e-6: -56.990
    assert lines["loudest bearing"] == pytest.approx([-60.0, -53.010, -60.0], abs=1e-3)
    assert lines["mean of all bearings"] == pytest.approx([-60.0, -56.990, -60.0], abs=1e-3)
    assert lower.get_ylabel() == "[dB re (20 µPa)²]"


def test_the_time_without_a_trusted_pose_is_shaded():
    run = made_run()
    ((start, end),) = unlocalized(run.trajectory, run.scans)
    # poses 200 to 239 of one every 50 ms; the last trusted ones are 199 and 240
    assert (start, end) == pytest.approx((9.95, 12.0))
    lower = figure_of(run.scans).axes[1]
    assert "robot not localized" in lower.get_legend_handles_labels()[1]


def test_long_numbers_at_the_colour_bar_stay_inside_the_picture():
    time_ns = START_NS + np.arange(50) * 100_000_000
    rng = np.random.default_rng(2)
    power = (1e-10 * rng.uniform(0.6, 1.0, (50, 8))).astype(np.float32)
    scans = AudioScans(time_ns, np.arange(8) * np.pi / 4, power, LevelReference.FULL_SCALE)
    figure = figure_of(scans)
    figure.canvas.draw()
    for axes in figure.axes:
        box = axes.get_tightbbox()
        assert box.x0 >= 0
        assert box.x1 <= figure.bbox.x1
        assert box.y0 >= 0
        assert box.y1 <= figure.bbox.y1
