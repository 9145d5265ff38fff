import numpy as np

from soundmap.geometry import relative
from soundmap.mapping.alignment import PairFits
from soundmap.mapping.links import PAIR_SIGMA, odometry_links, scan_links
from soundmap.odometry_model import OdometryModel
from tests import worlds
from tests.mapping import drives

POSE = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 0.5]])
PAIR = np.array([[1, 0]])


def test_a_link_is_where_the_normal_equations_are_solved():
    information = np.diag([4e4, 9e4, 1e5])[None]
    step = np.array([0.02, -0.01, 0.005])
    fits = PairFits(information, -(information @ step), np.array([50]))
    links = scan_links(POSE, PAIR, fits, least_matched=20)
    expected = relative(POSE[0], POSE[1]) + step
    np.testing.assert_allclose(links.measured[0], expected, atol=1e-5)


def test_errors_of_a_pair_and_of_its_sensors_add_up():
    sigma = np.array([0.01, 0.02, 0.001])
    fits = PairFits(np.diag(sigma**-2.0)[None], np.zeros((1, 3)), np.array([50]))
    links = scan_links(POSE, PAIR, fits, least_matched=20)
    added = np.diag(np.linalg.inv(links.information[0]))
    np.testing.assert_allclose(added, sigma**2 + PAIR_SIGMA**2)


def test_a_corridor_stays_loose_along_itself():
    fits = PairFits(np.diag([0.0, 1e5, 1e5])[None], np.zeros((1, 3)), np.array([90]))
    links = scan_links(POSE, PAIR, fits, least_matched=20)
    assert abs(links.information[0][0, 0]) < 1e-6
    assert links.information[0][1, 1] > 1e3


def test_pairs_that_hardly_touch_or_would_leap_give_no_link():
    information = np.tile(np.diag([1e4, 1e4, 1e4]), (2, 1, 1))
    gradient = np.array([[0.0, 0.0, 0.0], [-5e3, 0.0, 0.0]])
    fits = PairFits(information, gradient, np.array([19, 200]))
    pairs = np.array([[1, 0], [1, 0]])
    assert len(scan_links(POSE, pairs, fits, least_matched=20)) == 0


def test_odometry_links_lead_from_scan_to_scan_as_corrected():
    truth = worlds.driven([(1, 1), (3, 1), (3, 2)])
    odometry = drives.reported(truth, scale=1.1)
    scans = worlds.laser_scans(truth, [worlds.FRONT], rate_hz=5, beams=91)
    keys = drives.keys(scans, odometry).scans
    links = odometry_links(keys, OdometryModel(distance_scale=1 / 1.1))
    true = truth.at([key.time_ns for key in keys])
    np.testing.assert_array_equal(links.pairs[:, 0], links.pairs[:, 1] + 1)
    np.testing.assert_allclose(links.measured, relative(true[:-1], true[1:]), atol=1e-3)
    assert len(odometry_links(keys[:1], OdometryModel())) == 0
