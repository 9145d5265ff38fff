import numpy as np
import pytest

from soundmap.localize.particles import (
    Particles,
    equally_weighted,
    estimated_pose,
    resampled,
    reweighted,
)


def test_mean_heading_does_not_average_across_180_degrees():
    rng = np.random.default_rng(0)
    heading = np.pi + rng.normal(scale=0.05, size=500)
    heading = (heading + np.pi) % (2 * np.pi) - np.pi
    pose = np.column_stack([rng.normal(size=(500, 2)) * 0.02, heading])
    estimate = estimated_pose(equally_weighted(pose))
    assert abs(abs(estimate.pose[2]) - np.pi) < 0.01
    assert estimate.spread_rad == pytest.approx(0.05, rel=0.1)
    assert estimate.share == pytest.approx(1.0)


def test_two_modes_are_never_averaged():
    rng = np.random.default_rng(1)
    near = np.array([0.0, 0.0, 0.0]) + rng.normal(size=(400, 3)) * 0.03
    far = np.array([4.0, 2.0, np.pi / 2]) + rng.normal(size=(600, 3)) * 0.03
    estimate = estimated_pose(equally_weighted(np.vstack([near, far])))
    assert np.allclose(estimate.pose, [4.0, 2.0, np.pi / 2], atol=0.02)
    assert estimate.share == pytest.approx(0.6)
    assert estimate.spread_m < 0.1


def test_weights_follow_the_likelihood():
    particles = reweighted(equally_weighted(np.zeros((3, 3))), np.log([1.0, 2.0, 5.0]) - 4000.0)
    assert particles.weight == pytest.approx([0.125, 0.25, 0.625])
    assert particles.effective_size == pytest.approx(1 / (0.125**2 + 0.25**2 + 0.625**2))


def test_systematic_resampling_keeps_each_particle_about_its_weight_times():
    rng = np.random.default_rng(2)
    weight = rng.random(100)
    weight /= weight.sum()
    pose = np.zeros((100, 3))
    pose[:, 0] = np.arange(100)
    drawn = resampled(Particles(pose, weight), 1000, rng)
    counts = np.bincount(np.rint(drawn.pose[:, 0]).astype(int), minlength=100)
    assert np.all(np.abs(counts - 1000 * weight) < 1.0)
    assert 0 < np.abs(drawn.pose - np.rint(drawn.pose)).max() < 0.03, "copies are set apart"
    assert drawn.weight == pytest.approx(np.full(1000, 1e-3))


def test_order_of_the_particles_does_not_matter():
    rng = np.random.default_rng(3)
    pose = rng.normal(size=(300, 3)) * [0.1, 0.1, 0.05]
    weight = rng.random(300)
    weight /= weight.sum()
    shuffle = rng.permutation(300)
    first = estimated_pose(Particles(pose, weight))
    second = estimated_pose(Particles(pose[shuffle], weight[shuffle]))
    assert first.pose == pytest.approx(second.pose)
