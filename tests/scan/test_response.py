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
    return (factor @ factor.conj().transpose(0, 2, 1)).astype(np.complex64)


@pytest.mark.parametrize("bearings", [120, 45, 8])
@pytest.mark.parametrize("rank", [1, 10])
def test_the_real_product_is_the_quadratic_form(bearings, rank):
    rng = np.random.default_rng([bearings, rank])
    frequency_hz, weight = np.array([1000.0, 2500.0, 6000.0]), np.array([1.0, 2.0, 0.3])
    for positions in (circle(16), circle(7), corner(6), scattered(5, rng), [[0.1, 0.2]]):
        positions = mic_array(positions).positions_m
        table = steering_table(
            positions,
            bearings,
            frequency_hz=frequency_hz,
            weight=weight,
            speed_of_sound_m_s=343.0,
        )
        matrix = random_matrices(rng, 3, len(positions), rank)
        expected = np.zeros(bearings)
        for k in range(3):
            steering = steering_vectors(
                positions, table.bearing_rad, frequency_hz[k], speed_of_sound_m_s=343.0
            )
            form = np.einsum("nq,qp,np->n", steering.conj(), matrix[k], steering)
            expected += weight[k] * form.real
        power = steered_response_power(matrix, table)
        assert np.abs(power - expected).max() < 1e-5 * expected.max()


def test_power_is_never_negative():
    # Two waves that cancel on the bearing the array looks along: nothing is left but rounding.
    rng = np.random.default_rng(1)
    positions = mic_array(circle(16)).positions_m
    table = steering_table(
        positions,
        120,
        frequency_hz=np.array([2000.0]),
        weight=np.array([2.0]),
        speed_of_sound_m_s=343.0,
    )
    steering = steering_vectors(positions, table.bearing_rad, 2000.0, speed_of_sound_m_s=343.0)
    for n in range(0, 120, 7):
        field = rng.standard_normal(16) + 1j * rng.standard_normal(16)
        field -= steering[n] * np.mean(steering[n].conj() * field)
        power = steered_response_power(
            np.outer(field, field.conj())[None].astype(np.complex64), table
        )
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
