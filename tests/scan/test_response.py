from __future__ import annotations

import numpy as np
import pytest
from plane_waves import circle, corner, heard, mic_array, scattered, sweeps

from soundmap.scan.response import steered_response_power, steered_response_power_direct
from soundmap.scan.spectrum import Framing
from soundmap.scan.steering import steering_table, steering_vectors


def random_matrices(rng, bins, microphones, rank):
    factor = rng.standard_normal((2, bins, microphones, rank))
    factor = factor[0] + 1j * factor[1]
    return factor @ factor.conj().transpose(0, 2, 1)


def table_of(positions, bearings, frequency_hz, weight, splits=()):
    return steering_table(
        mic_array(positions).positions_m,
        bearings,
        first_bin=0,
        frequency_hz=np.array(frequency_hz),
        weight=np.array(weight),
        speed_of_sound_m_s=343.0,
        splits=splits,
    )


def spectra_of(matrix, table):
    """Sums over the pairs of each baseline, bin by bin, where the table expects them."""
    spectra = np.zeros(table.spectra_shape, dtype=np.float32)
    lines = table.baselines
    for m, n, line in zip(lines.first, lines.second, lines.baseline, strict=True):
        spectra[0, :, line] += matrix[:, m, n].real
        spectra[1, :, line] += matrix[:, m, n].imag
    return spectra


def quadratic_forms(matrix, positions, table, frequency_hz, weight):
    """Weighted a^H R a of each bin, shape (K, N)."""
    forms = []
    for k, f in enumerate(frequency_hz):
        steering = steering_vectors(
            mic_array(positions).positions_m, table.bearing_rad, f, speed_of_sound_m_s=343.0
        )
        form = np.einsum("nq,qp,np->n", steering.conj(), matrix[k], steering)
        forms.append(weight[k] * form.real)
    return np.array(forms)


@pytest.mark.parametrize("bearings", [120, 45, 8])
@pytest.mark.parametrize("rank", [1, 10])
def test_the_real_product_is_the_quadratic_form(bearings, rank):
    rng = np.random.default_rng([bearings, rank])
    frequency_hz, weight = [1000.0, 2500.0, 6000.0], [1.0, 2.0, 0.3]
    for positions in (circle(16), circle(7), corner(6), scattered(5, rng), [[0.1, 0.2]]):
        table = table_of(positions, bearings, frequency_hz, weight)
        matrices = [random_matrices(rng, 3, len(positions), rank) for _ in range(4)]
        power, _ = steered_response_power(
            np.array([spectra_of(matrix, table) for matrix in matrices]), table
        )
        assert power.shape == (4, 1, bearings)
        for matrix, scan in zip(matrices, power, strict=True):
            expected = quadratic_forms(matrix, positions, table, frequency_hz, weight).sum(axis=0)
            assert np.abs(scan[0] - expected).max() < 1e-5 * expected.max()


@pytest.mark.parametrize("splits", [(), (1,), (17,), (5, 21), (16, 32)])
def test_the_power_of_groups_of_bins_is_told_apart(splits):
    rng = np.random.default_rng(3)
    frequency_hz, weight = np.linspace(1000.0, 2000.0, 40), rng.uniform(0.5, 2.0, 40)
    for positions in (circle(8), scattered(5, rng)):
        table = table_of(positions, 60, frequency_hz, weight, splits)
        matrix = random_matrices(rng, 40, len(positions), 10)
        power = steered_response_power(spectra_of(matrix, table)[None], table)[0][0]
        forms = quadratic_forms(matrix, positions, table, frequency_hz, weight)
        expected = np.add.reduceat(forms, [0, *splits])
        assert power.shape == expected.shape
        assert np.abs(power - expected).max() < 1e-5 * expected.max()


@pytest.mark.parametrize("splits", [(0,), (40,), (5, 5), (7, 3), (41,)])
def test_groups_without_bins_are_refused(splits):
    with pytest.raises(ValueError, match="do not rise inside the 40 bins"):
        table_of(circle(4), 8, np.full(40, 1000.0), np.ones(40), splits)


def test_power_is_never_negative():
    # Two waves that cancel on the bearing the array looks along: nothing is left but rounding.
    rng = np.random.default_rng(1)
    table = table_of(circle(16), 120, [2000.0], [2.0])
    positions = mic_array(circle(16)).positions_m
    steering = steering_vectors(positions, table.bearing_rad, 2000.0, speed_of_sound_m_s=343.0)
    for n in range(0, 120, 7):
        field = rng.standard_normal(16) + 1j * rng.standard_normal(16)
        field -= steering[n] * np.mean(steering[n].conj() * field)
        spectra = spectra_of(np.outer(field, field.conj())[None], table)
        power = steered_response_power(spectra[None], table)[0][0, 0]
        assert power.min() >= 0.0
        assert power[n] < 1e-5 * power.max()


def test_the_direct_sum_gives_the_mean_square_of_a_plane_wave():
    rng = np.random.default_rng(2)
    positions = scattered(5, rng)
    samples = heard(sweeps(rng, 16000.0, 1920, 0.3), 2.0, positions, 16000.0) + 5.0
    power = steered_response_power_direct(
        samples.T,
        mic_array(positions).positions_m,
        np.array([2.0, 4.0]),
        rate_hz=16000.0,
        framing=Framing(400, 160, 10),
        low_hz=1000.0,
        high_hz=6000.0,
        speed_of_sound_m_s=343.0,
    )
    assert abs(10.0 * np.log10(power[0] / 0.09)) < 0.05
    assert power[1] < 0.5 * power[0]
