import numpy as np
from scipy.sparse.csgraph import floyd_warshall

from soundmap.mapping.growing_graph import GrowingGraph
from soundmap.odometry_model import OdometryModel
from tests import worlds
from tests.mapping import drives


def made_keys(**error):
    truth = worlds.driven([(1, 1), (4, 1.2), (6, 2), (3.5, 2.6)])
    scans = worlds.laser_scans(truth, [worlds.FRONT, worlds.BACK], rate_hz=6, beams=181)
    keys = drives.keys(drives.noisy(scans, 0.01), drives.reported(truth, **error)).scans
    return keys, drives.from_first(truth, np.array([key.time_ns for key in keys]))


def grown(keys):
    graph = GrowingGraph(keys, OdometryModel(), 14)
    while graph.count < len(keys):
        graph.add_next(graph.distances_from(graph.count - 1))
    return graph


def test_scan_after_scan_finds_its_place_with_poor_odometry():
    keys, true = made_keys(scale=0.94, turn_per_metre=0.06)
    graph = grown(keys)
    assert np.max(drives.errors(graph.pose, true)[0]) < 0.03
    assert graph.matched.all()


def test_leaping_odometry_is_caught_by_the_search():
    keys, true = made_keys()
    leap = np.array([0.25, -0.2, 0.15])
    driven = np.array([key.driven_m for key in keys])
    here = 20 + int(np.argmax(np.diff(driven)[20:] > 0.1)) + 1
    bent = [
        type(key)(**{**vars(key), "odometry": key.odometry + leap * (number >= here)})
        for number, key in enumerate(keys)
    ]
    model = OdometryModel(noise_distance_per_metre=1.5, noise_turn_per_metre=1.0)
    graph = GrowingGraph(bent, model, 14)
    while graph.count < len(bent):
        graph.add_next(graph.distances_from(graph.count - 1))
    assert np.max(drives.errors(graph.pose, true)[0]) < 0.05


def test_a_scan_of_another_world_stands_where_odometry_puts_it_and_is_told():
    keys, _ = made_keys()
    rng = np.random.default_rng(3)
    strange = keys[15]
    points = rng.uniform(-20, 20, strange.end_m.shape).astype(np.float32)
    replaced = list(keys)
    replaced[15] = type(strange)(**{**vars(strange), "end_m": points})
    graph = grown(replaced)
    assert not graph.matched[15]
    assert graph.matched.sum() == len(keys) - 1


def test_ways_through_the_graph_are_the_shortest():
    keys, _ = made_keys()
    graph = grown(keys[:20])
    pairs = graph.links().pairs
    dense = np.full((20, 20), np.inf)
    for a, b in pairs:
        gap = 0.02 + np.hypot(*(graph.pose[a, :2] - graph.pose[b, :2]))
        dense[a, b] = dense[b, a] = gap
    expected = floyd_warshall(dense)
    np.testing.assert_allclose(graph.distances_from(13), expected[13])
