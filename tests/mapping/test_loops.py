"""A corridor round a block: once round, the robot must know its place again."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from soundmap.geometry import composed
from soundmap.mapping.growing_graph import GrowingGraph
from soundmap.mapping.loops import close_loops, recent_view, seen_through_share
from soundmap.odometry_model import OdometryModel
from tests import worlds
from tests.mapping import drives

LONG, SHORT, WIDE = 16.0, 10.0, 1.8


def block(niches):
    """Walls of a corridor round a block; the outer wall has niches (side, from, width, depth)."""
    outer = np.array([[0, 0], [LONG, 0], [LONG, SHORT], [0, SHORT]])
    inner = np.array([[WIDE, WIDE], [LONG - WIDE, WIDE], [LONG - WIDE, SHORT - WIDE],
                      [WIDE, SHORT - WIDE]])  # fmt: skip
    walls = [[a, b] for a, b in zip(inner, np.roll(inner, -1, axis=0), strict=True)]
    for side in range(4):
        start, end = outer[side], outer[(side + 1) % 4]
        along = (end - start) / np.linalg.norm(end - start)
        outward = np.array([along[1], -along[0]])
        corner = [start]
        for _, begin, width, depth in sorted(niche for niche in niches if niche[0] == side):
            near, far = start + begin * along, start + (begin + width) * along
            corner += [near, near + depth * outward, far + depth * outward, far]
        corner.append(end)
        walls += [[a, b] for a, b in pairwise(corner)]
    return np.array(walls)


VARIED = [(0, 3, 1.0, 0.5), (0, 6.5, 1.5, 0.3), (0, 11, 0.8, 0.9), (1, 2.5, 1.2, 0.6),
          (1, 6, 0.7, 0.4), (2, 2, 2.0, 0.3), (2, 7, 0.9, 0.7), (2, 12, 1.3, 0.5),
          (3, 3, 1.4, 0.8), (3, 7, 0.6, 0.3)]  # fmt: skip


def round_the_block(walls, **error):
    middle = WIDE / 2
    way = [(middle, middle), (LONG - middle, middle), (LONG - middle, SHORT - middle),
           (middle, SHORT - middle), (middle, middle), (middle + 4, middle)]  # fmt: skip
    truth = worlds.driven(way, speed=1.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(worlds, "segments", lambda _: walls)
        scans = worlds.laser_scans(truth, [worlds.FRONT], rate_hz=4, beams=181)
    short_sighted = [
        replace(scan, range_m=np.where(scan.range_m < 6.0, scan.range_m, np.nan))
        for scan in drives.noisy(scans, 0.01)
    ]
    keys = drives.keys(short_sighted, drives.reported(truth, **error)).scans
    return keys, drives.from_first(truth, np.array([key.time_ns for key in keys]))


def grown(keys, drift=None):
    """The graph as it stands without closing any loop, if wanted with poses bent by drift."""
    graph = GrowingGraph(keys, OdometryModel(), 14)
    distance = np.zeros(1)
    for _ in keys[1:]:
        graph.add_next(distance)
        distance = graph.distances_from(graph.count - 1)
    if drift is not None:
        share = np.linspace(0, 1, len(keys))[:, None]
        graph.replace_poses(composed(share * drift, graph.pose))
    return graph


@pytest.fixture(scope="module")
def drive():
    return round_the_block(block(VARIED), scale=1.05, turn_per_metre=0.05)


def test_without_closing_loops_the_graph_follows_the_walls_already(drive):
    keys, true = drive
    graph = grown(keys)
    assert graph.matched.all()
    assert np.max(drives.errors(graph.pose, true)[0]) < 1.0
    way = graph.distances_from(len(keys) - 1)
    assert way[0] > 40.0, "the first scan is far through the graph although it is near in space"


def test_a_place_seen_before_is_recognised_and_the_drift_removed(drive):
    keys, true = drive
    graph = grown(keys, drift=np.array([0.9, -0.6, 0.06]))
    last = len(keys) - 1
    before = drives.errors(graph.pose, true)[0]
    outcome = close_loops(graph, last, graph.distances_from(last), most_drift_m=6.0)
    assert (outcome.found, outcome.closed) == (1, 1)
    after = drives.errors(graph.pose, true)[0]
    assert before[-1] > 0.8
    assert after[-1] < 0.1
    assert graph.distances_from(last)[0] < 10.0


def test_a_corridor_that_looks_the_same_all_along_closes_no_loop():
    keys, _ = round_the_block(block([]))
    graph = grown(keys)
    middle = int(np.argmin(np.abs(np.array([key.driven_m for key in keys]) - 50.5)))
    # Between the corners there is nothing to tell one place from another.
    search = close_loops(graph, middle, graph.distances_from(middle), most_drift_m=6.0)
    assert search.closed == 0


def test_the_way_seen_last_is_one_scan_that_lies_on_the_walls(drive):
    keys, true = drive
    graph = grown(keys[:30])
    view = recent_view(graph, 29)
    assert len(view) > 1.2 * len(keys[29])
    start = composed(np.array([WIDE / 2, WIDE / 2, 0.0]), true[29])
    cos, sin = np.cos(start[2]), np.sin(start[2])
    points = start[:2] + view.end_m @ np.array([[cos, sin], [-sin, cos]])
    walls = block(VARIED)
    along = walls[:, 1] - walls[:, 0]
    share = np.einsum("psk,sk->ps", points[:, None] - walls[:, 0], along) / np.sum(along**2, 1)
    foot = walls[:, 0] + np.clip(share, 0, 1)[..., None] * along
    off = np.hypot(*np.moveaxis(points[:, None] - foot, -1, 0)).min(axis=1)
    assert np.median(off) < 0.03


def test_looking_through_walls_shows_a_false_place(drive):
    keys, true = drive
    here = 20
    old = [keys[here - 2]]
    right = seen_through_share(old, true[[here - 2]], keys[here], keys[here], true[here])
    wrong = composed(true[here], np.array([0.0, 0.0, np.pi / 2]))
    false = seen_through_share(old, true[[here - 2]], keys[here], keys[here], wrong)
    assert right < 0.05
    assert false > 0.2
