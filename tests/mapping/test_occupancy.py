import numpy as np
import pytest

from soundmap.grid import GridFrame
from soundmap.mapping.key_scans import KeyScan
from soundmap.mapping.occupancy import drawn_map, ray_counts
from tests import worlds
from tests.mapping import drives


def single_ray(start, end, normal=(0.0, 0.0)):
    rays = [np.array([value], dtype=np.float32) for value in (start, end, normal)]
    return KeyScan(0, 0, np.zeros(3), 0.0, 0.0, *rays)


@pytest.mark.parametrize("seed", range(5))
def test_a_ray_visits_the_cells_that_finely_spaced_points_on_it_visit(seed):
    rng = np.random.default_rng(seed)
    start, end = rng.uniform(0.3, 3.7, (2, 2))
    frame = GridFrame(0.1, (0.0, 0.0), (40, 40))
    hits, misses = ray_counts([single_ray(start, end)], np.zeros((1, 3)), frame)
    length = np.hypot(*(end - start))
    # As far as one cell from the end, whole cells only.
    along = np.arange(0, length - 0.1, 1e-4) / length
    cells = frame.cells(start + along[:, None] * (end - start))
    visited = np.zeros(frame.shape, dtype=bool)
    visited[cells[:, 0], cells[:, 1]] = True
    last = cells[-1]
    visited[last[0], last[1]] = misses[last[0], last[1]] > 0
    np.testing.assert_array_equal(misses > 0, visited)
    assert misses.max() <= 1
    row, column = frame.cells(end)
    assert hits[row, column] == 1
    assert hits.sum() == 1


def test_a_grazing_ray_does_not_erase_the_wall_that_it_meets():
    frame = GridFrame(0.1, (0.0, 0.0), (40, 40))
    start, end = (0.25, 1.0), (3.25, 2.04)
    bare, _ = ray_counts([single_ray(start, end)], np.zeros((1, 3)), frame)
    _, passed = ray_counts([single_ray(start, end, (0.0, -1.0))], np.zeros((1, 3)), frame)
    wall_row = frame.cells(np.array(end))[0]
    assert passed[wall_row].sum() == 0
    assert bare[wall_row].sum() == 1


def test_a_room_is_drawn_as_it_is():
    truth = worlds.driven(drives.ROUND)
    scans = worlds.laser_scans(truth, [worlds.FRONT, worlds.BACK], rate_hz=5, beams=541)
    keys = drives.keys(scans, truth)
    pose = truth.at([scan.time_ns for scan in keys.scans])
    found = drawn_map(keys.scans, pose, cell_m=0.05, occupied_share=0.35)
    centres = found.frame.centres(np.argwhere(found.occupied))
    walls = worlds.segments()
    along = walls[:, 1] - walls[:, 0]
    share = np.einsum("psk,sk->ps", centres[:, None] - walls[:, 0], along) / np.sum(along**2, 1)
    foot = walls[:, 0] + np.clip(share, 0, 1)[..., None] * along
    distance = np.hypot(*np.moveaxis(centres[:, None] - foot, -1, 0)).min(axis=1)
    assert distance.max() < 0.05 * np.sqrt(2) / 2 + 1e-3, "no occupied cell off the walls"
    true = worlds.room()
    free = true.frame.centres(np.argwhere(true.free))
    cells = found.frame.cells(free)
    inside = found.frame.contains(cells)
    assert np.mean(found.free[cells[inside, 0], cells[inside, 1]]) > 0.97
    assert not np.any(found.free & found.occupied)


def test_what_moved_on_is_not_on_the_map():
    frame_pose = np.zeros((20, 3))
    person = single_ray((0.0, 0.0), (1.01, 0.01))
    wall = single_ray((0.0, 0.0), (3.01, 0.01))
    found = drawn_map([person] * 3 + [wall] * 17, frame_pose, cell_m=0.05, occupied_share=0.35)
    at = tuple(found.frame.cells(np.array([1.01, 0.01])))
    assert found.free[at]
    assert found.occupied[tuple(found.frame.cells(np.array([3.01, 0.01])))]
