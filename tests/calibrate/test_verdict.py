"""What becomes of clock and yaw."""

import numpy as np
import pytest

from soundmap.calibrate.verdict import judged
from soundmap.sensors import OffsetVerdict as Verdict

SIGMA = np.array([0.004, np.radians(0.3)])


def verdicts(clock_sigmas, yaw_sigmas, *, sigma=SIGMA, correct=True):
    found = judged(np.array([clock_sigmas, yaw_sigmas]) * sigma, sigma, 0.9, 5, correct=correct)
    return found.clock.verdict, found.yaw.verdict


@pytest.mark.parametrize("sigmas", [(0.2, 0.5), (3.4, -3.4), (-3.4, 1.5)])
def test_nothing_is_corrected_without_clear_evidence(sigmas):
    assert verdicts(*sigmas) == (Verdict.NOUGHT, Verdict.NOUGHT)


def test_where_one_is_clearly_off_the_other_is_corrected_if_it_likely_is():
    assert verdicts(-3.6, 1.2) == (Verdict.CORRECTED, Verdict.CORRECTED)
    assert verdicts(1.2, 3.6) == (Verdict.CORRECTED, Verdict.CORRECTED)
    assert verdicts(9.0, -0.8) == (Verdict.CORRECTED, Verdict.NOUGHT)


def test_what_is_known_too_badly_neither_is_corrected_nor_speaks_against_the_other():
    unsure = np.array([0.02, np.radians(0.3)])
    assert verdicts(5.0, 2.0, sigma=unsure) == (Verdict.UNKNOWN, Verdict.NOUGHT)
    assert verdicts(5.0, 4.0, sigma=unsure) == (Verdict.UNKNOWN, Verdict.CORRECTED)


def test_to_report_is_not_to_correct():
    assert verdicts(4.0, 2.0, correct=False) == (Verdict.CLEAR, Verdict.NOUGHT)
