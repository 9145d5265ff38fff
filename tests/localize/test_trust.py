import numpy as np

from soundmap.geometry import composed
from soundmap.localize.trust import bridged, slipping, without_scraps

VIEWS = 41
STEP = np.tile([0.5, 0.0, 0.0], (VIEWS - 1, 1))
WAY_M = 0.5 * np.arange(VIEWS)
TRUE = np.column_stack([WAY_M, np.zeros((VIEWS, 2))])


def trusted_at(*pieces: range) -> np.ndarray:
    trusted = np.zeros(VIEWS, dtype=bool)
    for piece in pieces:
        trusted[list(piece)] = True
    return trusted


def moved(pose: np.ndarray, views: range) -> np.ndarray:
    """The same poses, some of them ten metres aside."""
    result = pose.copy()
    result[list(views), 1] += 10.0
    return result


def kept(trusted: np.ndarray, pose: np.ndarray = TRUE) -> list[int]:
    return np.flatnonzero(without_scraps(trusted, pose, STEP, WAY_M)).tolist()


def test_a_run_that_matches_throughout_is_kept():
    assert kept(trusted_at(range(VIEWS))) == list(range(VIEWS))


def test_a_lone_match_far_from_where_odometry_leads_is_dropped():
    trusted = trusted_at(range(15), range(17, 18), range(19, VIEWS))
    assert kept(trusted, moved(TRUE, range(17, 18))) == [*range(15), *range(19, VIEWS)]


def test_a_lone_match_is_not_proved_by_the_way_to_the_next_one():
    # Ten metres of lost way after it: odometry cannot tell whether the two belong together.
    trusted = trusted_at(range(12), range(15, 16), range(36, VIEWS))
    assert 15 not in kept(trusted, moved(TRUE, range(15, 16)))


def test_scattered_matches_over_a_long_way_do_not_prove_one_another():
    trusted = trusted_at(range(12), range(20, 40, 4))
    assert kept(trusted, moved(TRUE, range(20, 40))) == list(range(12))


def test_a_few_matches_joined_by_odometry_to_a_long_piece_are_kept():
    trusted = trusted_at(range(15), range(19, 20), range(24, VIEWS))
    assert kept(trusted) == [*range(15), 19, *range(24, VIEWS)]


def test_a_short_run_keeps_its_longest_piece():
    trusted = trusted_at(range(3), range(4, 9))
    assert kept(trusted, moved(TRUE, range(3))) == list(range(4, 9))


def test_a_robot_at_rest_is_believed_where_most_scans_put_it():
    rest = np.zeros((VIEWS - 1, 3))
    pose = moved(np.zeros((VIEWS, 3)), range(4))
    result = without_scraps(trusted_at(range(VIEWS)), pose, rest, np.zeros(VIEWS))
    assert np.flatnonzero(result).tolist() == list(range(4, VIEWS))


def test_where_the_map_lies_does_not_matter():
    trusted = trusted_at(range(12), range(15, 16), range(19, VIEWS))
    pose = moved(TRUE, range(15, 16))
    turned = composed([3.0, -2.0, 2.5], pose)
    assert kept(trusted, turned) == kept(trusted, pose)


def test_nothing_trusted_stays_so():
    assert kept(trusted_at()) == []


def test_views_between_matching_ones_are_bridged_over_little_way_only():
    matching = np.array([True, False, True, False, True, False])
    way_m = np.array([0.0, 0.1, 0.2, 0.5, 1.0, 1.0])
    assert bridged(matching, way_m).tolist() == [True, True, True, False, True, False]


def slips(turn_deg: float, *, every_ns: int) -> list[int]:
    """Views in doubt where the odometry reports one false turn, from view 20 to 21."""
    step = STEP.copy()
    step[20, 2] += np.radians(turn_deg)
    return np.flatnonzero(slipping(np.arange(VIEWS) * every_ns, TRUE, step)).tolist()


def test_scans_in_which_the_wheels_reported_a_false_turn_are_not_trusted():
    assert slips(20.0, every_ns=100_000_000) == [20, 21]
    assert slips(20.0, every_ns=50_000_000) == [19, 20, 21, 22]


def test_a_small_or_slow_false_turn_is_drift():
    assert slips(4.0, every_ns=100_000_000) == []
    assert slips(20.0, every_ns=500_000_000) == []
