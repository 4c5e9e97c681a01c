from dataclasses import replace

from armctl.trajectory.expectation import expected_mm
from armctl.trajectory.lag import nominal
from tests.genetic import hand
from tests.trajectory.test_refinement import Scripted, first

ARM, CHAIN = hand.arm(), hand.robot().chain
PLAN = first(Scripted(0.0), via=2).plan
KNOWN = replace(nominal(ARM, CHAIN), residual_tick=(0.7,) * 5, lines=8)


def test_more_is_expected_of_an_arm_whose_lag_is_known_the_better_the_more() -> None:
    unknown, known = expected_mm(ARM, CHAIN, PLAN, None), expected_mm(ARM, CHAIN, PLAN, KNOWN)
    poorly = expected_mm(ARM, CHAIN, PLAN, replace(KNOWN, residual_tick=(3.0,) * 5))
    assert known < unknown < poorly
    assert known[1] < unknown[1] < poorly[1]


def test_less_is_promised_than_perfect_servos_would_reach() -> None:
    mean_mm, max_mm = expected_mm(ARM, CHAIN, PLAN, KNOWN)
    assert PLAN.predicted_mean_error_mm < 0.5 < mean_mm < 1.2 < max_mm < 3.0


def test_an_arm_without_correction_is_expected_to_sag() -> None:
    plain = ARM.model_copy(update={"correction": False})
    assert expected_mm(plain, CHAIN, PLAN, None)[0] > 5.0
    assert expected_mm(plain, CHAIN, PLAN, KNOWN)[0] > 5.0


def test_the_same_is_expected_of_the_same_plan() -> None:
    assert expected_mm(ARM, CHAIN, PLAN, KNOWN) == expected_mm(ARM, CHAIN, PLAN, KNOWN)
