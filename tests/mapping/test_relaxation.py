import numpy as np

from soundmap.geometry import composed
from soundmap.mapping.founders import founders
from soundmap.mapping.links import odometry_links
from soundmap.mapping.pose_graph import link_costs
from soundmap.mapping.relaxation import overlapping_pairs, relaxed_poses
from soundmap.odometry_model import OdometryModel
from tests import worlds
from tests.mapping import drives

MODEL = OdometryModel()


def drive(beams=271):
    truth = worlds.driven([(1, 1), (4, 1.2), (6, 2), (3.5, 2.6), (3.5, 4)])
    scans = worlds.laser_scans(truth, [worlds.FRONT, worlds.BACK], rate_hz=8, beams=beams)
    keys = drives.keys(drives.noisy(scans, 0.01), truth)
    true = drives.from_first(truth, np.array([scan.time_ns for scan in keys.scans]))
    return keys.scans, true


def test_scattered_scans_fall_into_place():
    scans, true = drive()
    rng = np.random.default_rng(8)
    start = composed(true, rng.normal(0, 1, true.shape) * [0.05, 0.05, 0.02])
    start[0] = true[0]
    odometry = odometry_links(scans, MODEL)
    found, links = relaxed_poses(
        scans, start, odometry, neighbours=14, gates_m=(0.3, 0.2, 0.15, 0.1), fine_rounds=2
    )
    before = drives.errors(start, true)
    after = drives.errors(found, true)
    assert np.median(before[0]) > 0.04
    assert np.median(after[0]) < 0.006
    assert np.max(after[0]) < 0.02
    assert np.max(after[1]) < np.radians(0.3)
    assert np.median(link_costs(found, links)) < np.median(link_costs(start, links))


def test_scans_that_share_no_surface_keep_to_their_odometry():
    scans, true = drive()
    far = [scans[0], scans[-1]]
    odometry = odometry_links(far, MODEL)
    start = np.array([true[0], true[-1] + [50.0, 0.0, 0.0]])
    found, links = relaxed_poses(far, start, odometry, neighbours=4, gates_m=(0.2,), fine_rounds=1)
    np.testing.assert_array_equal(found, start)
    assert len(links) == 1


def test_every_pose_is_paired_with_enough_founders_near_it_and_none_twice():
    rng = np.random.default_rng(1)
    pose = np.column_stack([rng.uniform(0, 10, (200, 2)), rng.uniform(-3, 3, 200)])
    scanner = np.zeros(200, dtype=np.int64)
    pairs = overlapping_pairs(pose, scanner, 10)
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    assert np.all(pairs[:, 0] > pairs[:, 1])
    gap = np.hypot(*(pose[pairs[:, 0], :2] - pose[pairs[:, 1], :2]).T)
    assert gap.max() <= 5.0
    founding = founders(pose, scanner)
    distance = np.hypot(*(pose[:, None, :2] - pose[None, founding, :2]).transpose(2, 0, 1))
    near = (distance <= 5.0).sum(axis=1) - np.isin(np.arange(200), founding)
    count = np.bincount(pairs.ravel(), minlength=200)
    assert np.all(count >= np.minimum(near, 10))


def test_the_pairs_do_not_grow_with_the_visits_to_a_place():
    pose = np.zeros((300, 3))
    assert len(overlapping_pairs(pose, np.zeros(300, dtype=np.int64), 10)) <= 300 * 3


def test_a_place_has_one_founder_a_scanner_and_direction():
    pose = np.array([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [0.1, 0.1, 2.0], [0.1, 0.1, 0.1], [2, 0, 0]])
    assert founders(pose, np.array([0, 0, 0, 1, 0])).tolist() == [0, 2, 3, 4]
