import numpy as np
import pytest
import worlds

from soundmap.config import FuseConfig
from soundmap.fuse.accumulate import PowerAccumulator
from soundmap.fuse.power_map import fused_scans, power_map_frame
from soundmap.geometry import Mount, Trajectory, transformed
from soundmap.grid import GridFrame
from soundmap.losses import LossLedger
from soundmap.sound import AudioScans, LevelReference
from tests.fuse.gathered import gathered_surroundings

TRUTH = worlds.driven([(1.0, 1.0), (5.0, 1.0), (5.0, 2.2)])
SCANS = worlds.laser_scans(TRUTH, [worlds.FRONT, worlds.BACK], beams=721)
FRAME = power_map_frame(worlds.room(), 0.05)
BEARING = np.arange(120) * 2 * np.pi / 120
ARRAY = Mount.planar(0.1, -0.05, 0.6, np.radians(30.0))


def heard(source, truth, mount, *, step_ns=100_000_000):
    """Audio scans of a single source: one lobe toward it, falling with the square of distance."""
    times, powers = [], []
    for time_ns in range(int(truth.time_ns[0]) + step_ns, int(truth.time_ns[-1]), step_ns):
        pose = truth.at(time_ns)
        centre = transformed(pose, mount.translation_m[:2])
        toward = np.arctan2(source[1] - centre[1], source[0] - centre[0]) - pose[2]
        own = mount.handedness * (toward - mount.yaw_rad)
        power = np.exp(10 * (np.cos(BEARING - own) - 1)) / np.sum((source - centre) ** 2)
        times.append(time_ns)
        powers.append(power)
    return AudioScans(
        np.array(times), BEARING, np.array(powers, np.float32), LevelReference.FULL_SCALE, mount
    )


def fused(scans, *, lasers=SCANS, truth=TRUTH, mount=ARRAY, losses=None, **options):
    accumulator = PowerAccumulator(FRAME, LevelReference.FULL_SCALE)
    losses = LossLedger() if losses is None else losses
    around = gathered_surroundings(lasers, TRUTH)
    events = list(
        fused_scans(scans, around, truth, accumulator, mount, FuseConfig(**options), losses=losses)
    )
    return accumulator.power_map(), events


SOURCE = np.array([4.0, 0.025])  # on the lower wall


@pytest.mark.parametrize("candidates", ["bearings", "peaks"])
@pytest.mark.parametrize(
    "mount",
    [
        ARRAY,
        Mount.planar(-0.3, 0.2, 0.5, np.pi),
        Mount.from_quaternion([0.1, 0.0, 0.6], [np.cos(0.4), np.sin(0.4), 0.0, 0.0]),
    ],
    ids=["turned", "behind", "upside down"],
)
def test_a_source_on_a_wall_is_put_where_it_is(candidates, mount):
    power_map, events = fused(heard(SOURCE, TRUTH, mount), mount=mount, candidates=candidates)
    points = np.array([event.point_m for event in events if event.point_m is not None])
    assert len(points) > 40
    # Bearings 3 deg apart are 0.16 m apart at 3 m, and more along a wall seen at an angle.
    limit = 0.03 if candidates == "peaks" else 0.16
    assert np.median(np.hypot(*(points - SOURCE).T)) < limit
    best = np.unravel_index(power_map.visits.argmax(), FRAME.shape)
    assert np.hypot(*(FRAME.centres(best) - SOURCE)) < limit + 0.05


def test_emitted_power_is_what_the_source_emits():
    _, events = fused(heard(SOURCE, TRUTH, ARRAY), alpha=2.0)
    power = np.array([event.power for event in events if event.point_m is not None])
    assert np.median(power) == pytest.approx(1 / 0.3**2, rel=0.05)


def test_turning_the_world_turns_the_map():
    turned = Trajectory(
        TRUTH.time_ns,
        np.column_stack([-TRUTH.pose[:, 1], TRUTH.pose[:, 0], TRUTH.pose[:, 2] + np.pi / 2]),
        TRUTH.usable,
    )
    _, events = fused(heard(SOURCE, TRUTH, ARRAY))
    accumulator = PowerAccumulator(GridFrame(0.05, (-6.0, -3.0), (220, 160)), "x")
    turned_events = fused_scans(
        heard(SOURCE, TRUTH, ARRAY),
        gathered_surroundings(SCANS, TRUTH),
        turned,
        accumulator,
        ARRAY,
        FuseConfig(),
        losses=LossLedger(),
    )
    for event, other in zip(events, turned_events, strict=True):
        if event.point_m is not None:
            x, y = event.point_m
            assert other.point_m == pytest.approx(np.array([-y, x]), abs=1e-6)
            assert other.power == pytest.approx(event.power)


def test_the_map_grows_with_every_scan():
    accumulator = PowerAccumulator(FRAME, LevelReference.FULL_SCALE)
    visits = []
    for event in fused_scans(
        heard(SOURCE, TRUTH, ARRAY),
        gathered_surroundings(SCANS, TRUTH),
        TRUTH,
        accumulator,
        ARRAY,
        FuseConfig(),
        losses=LossLedger(),
    ):
        visits.append(accumulator.power_map().visits.sum())
        assert (np.diff([0, *visits])[-1] > 0) == (event.point_m is not None)
    assert visits[-1] > 40


def test_scans_at_untrusted_poses_are_not_fused_but_counted():
    usable = np.ones(len(TRUTH), dtype=bool)
    usable[100:200] = False
    losses = LossLedger()
    doubtful = Trajectory(TRUTH.time_ns, TRUTH.pose, usable)
    _, events = fused(heard(SOURCE, TRUTH, ARRAY), truth=doubtful, losses=losses)
    dropped = [event for event in events if not doubtful.usable_at(event.time_ns)]
    assert all(event.point_m is None for event in dropped)
    counted = {loss.what: loss.count for loss in losses}
    assert counted["audio scan without a trusted pose"] == len(dropped) > 15


def test_audio_after_the_last_laser_scan_is_not_fused_but_counted():
    half = SCANS[: len(SCANS) // 2]
    losses = LossLedger()
    _, events = fused(heard(SOURCE, TRUTH, ARRAY), lasers=half, losses=losses)
    late = [event for event in events if event.time_ns > half[-1].middle_ns + 200_000_000]
    assert len(late) > 20
    assert all(event.point_m is None for event in late)
    counted = {loss.what: loss.count for loss in losses}
    assert counted["audio scan without a laser scan at its time"] == len(late)


def test_both_scanners_contribute():
    """A source straight behind the robot is out of the front scanner's sight."""
    behind = np.array([0.025, 1.0])
    front_only = [scan for scan in SCANS if scan.scanner == 0]
    still = Trajectory(
        TRUTH.time_ns[:25], TRUTH.pose[:25], np.ones(25, dtype=bool)
    )  # at rest, looking away from it
    mount = Mount.planar(0.0, 0.0, 0.5, 0.0)
    _, blind = fused(heard(behind, still, mount), lasers=front_only, truth=still, mount=mount)
    _, seeing = fused(heard(behind, still, mount), truth=still, mount=mount)
    assert all(event.point_m is None for event in blind)
    assert all(event.point_m is not None for event in seeing)
    assert seeing[0].point_m == pytest.approx(behind, abs=0.03)


def test_frame_of_the_power_map_covers_the_geometric_map():
    room = worlds.room()
    frame = power_map_frame(room, 0.07)
    left, right, bottom, top = room.frame.extent_m
    assert frame.origin_m == (left, bottom)
    assert frame.extent_m[1] >= right - 1e-9
    assert frame.extent_m[3] >= top - 1e-9
    assert power_map_frame(room, 0.05).shape == room.frame.shape
