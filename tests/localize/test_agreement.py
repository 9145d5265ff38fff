import numpy as np
import pytest
import worlds

from soundmap.config import LocalizeConfig
from soundmap.geometry import transformed
from soundmap.localize.agreement import agreement, view_shares
from soundmap.localize.views import Views, chosen_views
from soundmap.losses import LossLedger
from soundmap.raycast import cast_ranges

TRUTH = worlds.driven([(1.0, 1.0), (4.0, 1.2)])
SCANS = worlds.laser_scans(TRUTH, [worlds.FRONT, worlds.BACK])
VIEWS = chosen_views(SCANS, TRUTH, LocalizeConfig(), LossLedger())
POSES = TRUTH.at(VIEWS.time_ns)
ROOM = worlds.room()
TOLERANCE = 0.15


def with_ends(end_m):
    fields = {name: getattr(VIEWS, name) for name in VIEWS.__dataclass_fields__}
    return Views(**{**fields, "end_m": end_m.astype(np.float32)})


def test_from_the_true_poses_the_map_explains_every_view():
    right = agreement(ROOM, POSES, VIEWS, tolerance_m=TOLERANCE)
    assert right.matched.min() > 0.95
    assert right.beyond.max() < 0.05


def test_from_wrong_poses_rays_pass_through_walls():
    wrong = agreement(ROOM, POSES + np.array([0.8, 0.5, 0.7]), VIEWS, tolerance_m=TOLERANCE)
    assert wrong.matched.max() < 0.6
    assert np.median(wrong.beyond) > 0.2


def test_obstacles_before_the_walls_do_not_match_but_contradict_nothing():
    shortened = 1 - 0.4 * (np.arange(len(VIEWS.end_m)) % 4 == 0)
    views = with_ends(VIEWS.origin_m + (VIEWS.end_m - VIEWS.origin_m) * shortened[:, None])
    blocked = agreement(ROOM, POSES, views, tolerance_m=TOLERANCE)
    assert np.median(blocked.matched) == pytest.approx(0.75, abs=0.03)
    assert np.median(blocked.beyond) == 0.0


def test_the_kernel_agrees_with_cast_rays_and_the_cells_around_their_ends():
    rng = np.random.default_rng(4)
    poses = POSES + rng.normal(size=POSES.shape) * [0.1, 0.1, 0.05]
    fast = agreement(ROOM, poses, VIEWS, tolerance_m=TOLERANCE)
    for view in range(0, len(VIEWS), 7):
        rays, pose = VIEWS.rays(view), poses[view]
        origins = transformed(pose, rays.origin_m)
        bearings = rays.bearing_rad + pose[2]
        expected = cast_ranges(ROOM, origins, bearings, range_max_m=30.0)
        row, column = ROOM.frame.cells(transformed(pose, rays.end_m)).T
        around = [
            ROOM.occupied[np.clip(row + i, 0, 119), np.clip(column + j, 0, 179)]
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
        ]
        matched = (np.abs(rays.range_m - expected) < TOLERANCE) | np.any(around, axis=0)
        own = slice(VIEWS.first[view], VIEWS.first[view + 1])
        assert np.array_equal(fast.is_matched[own], matched)
        assert fast.matched[view] == pytest.approx(matched.mean())
        assert fast.beyond[view] == pytest.approx(np.mean(~matched & (rays.range_m > expected)))
        alone = view_shares(ROOM, pose, VIEWS, view, tolerance_m=TOLERANCE)
        assert alone == pytest.approx((fast.matched[view], fast.beyond[view]))
