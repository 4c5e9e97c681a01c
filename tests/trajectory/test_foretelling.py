"""What a servo does until it is read again: laws of the motion, and numbers that are found from made-up stretches."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.dynamixel.ax12a import TICK_RAD
from armctl.trajectory import foretelling
from armctl.trajectory.foretelling import Guess, Motor, Stretches, fit, foretold

MOTOR = Motor(1.5, 6.2, 0.12, 0.05, 1.2, 0.03, 0.006, 0.0)
NO_KG = np.zeros(1)


def stretches(m: int = 1, **changes: object) -> Stretches:
    """A servo that stands where it is to be, m times."""
    ones = np.ones(m)
    still = Stretches(
        length_s=0.1 * ones,
        shaft_tick=500.0 * ones,
        whole_tick=500.0 * ones,
        ramp_tick=500.0 * ones,
        velocity_rad_s=0.0 * ones,
        sent_s=math.inf * ones,
        goal_tick=np.full((2, m), 500.0),
        speed_tick_s=np.full((2, m), 100.0),
        from_reference=True,
        margin_tick=ones,
        punch=0.03,
        gain=0.04,
        volts=ones,
        gravity=np.zeros((2, m, 1)),
        inertia_m2=np.zeros((m, 1)),
        seen=np.zeros((3, m)),
    )
    return still._replace(**changes)  # type: ignore[arg-type]  # by its fields' names


@given(error=st.floats(-100.0, 100.0), whole=st.integers(-100, 100))
def test_output_is_odd_and_that_of_whole_ticks_where_the_error_is_whole(error: float, whole: int) -> None:
    one = stretches()
    at, mirrored = (foretelling.output(one, np.array([x]))[0] for x in (error, -error))
    assert at == -mirrored
    least = math.copysign(min(0.03 + (abs(whole) - 1.0) * 0.04, 1.0), whole) if abs(whole) > 1 else 0.0
    assert foretelling.output(one, np.array([float(whole)]))[0] == pytest.approx(least)


@given(kg=st.floats(0.0, 0.3), arm_m=st.floats(0.05, 0.3))
def test_masses_about_the_axis_are_as_slow_as_the_motors_own(kg: float, arm_m: float) -> None:
    goal = np.array([[500.0], [540.0]])
    told = stretches(sent_s=np.array([0.0]), goal_tick=goal, inertia_m2=np.full((1, 1), arm_m**2))
    own = MOTOR._replace(inertia_s2=MOTOR.inertia_s2 + kg * arm_m**2 / MOTOR.stall_Nm)
    assert foretold(told, np.array([kg]), MOTOR) == pytest.approx(foretold(told, NO_KG, own))


@given(share=st.floats(-0.99, 0.99))
def test_a_shaft_that_stands_bears_up_to_its_stiction(share: float) -> None:
    kg = np.array([share * 1.2 * 0.12 / (1.0 - 1.2 * 0.05 * abs(share))])
    bears = stretches(gravity=np.ones((2, 1, 1)))
    limit_Nm = 1.2 * (0.12 + 0.05 * abs(kg[0]))
    moved = foretold(bears, kg, MOTOR)[0, 0]
    assert moved == 0.0 if abs(kg[0]) <= limit_Nm else moved * kg[0] > 0.0


@given(speed=st.floats(40.0, 120.0), load_Nm=st.floats(-0.3, 0.3))
def test_a_shaft_that_slides_steadily_balances_its_torques(speed: float, load_Nm: float) -> None:
    v = speed * TICK_RAD
    torque = 0.12 + 0.05 * abs(load_Nm) - load_Nm
    wanted = torque / 1.5 + v / 6.2
    error = 1.0 + (wanted - 0.03) / 0.04
    if not 2.0 < error < 24.0:
        return
    going = stretches(
        shaft_tick=np.array([500.0 - error]), velocity_rad_s=np.array([v]), goal_tick=np.full((2, 1), 900.0),
        speed_tick_s=np.full((2, 1), speed), gravity=np.ones((2, 1, 1)),
    )  # fmt: skip
    way, after, output = foretold(going, np.array([load_Nm]), MOTOR)[:, 0]
    assert way == pytest.approx(0.1 * speed, rel=0.05)
    assert after == pytest.approx(v, rel=0.05)
    assert output == pytest.approx(wanted, abs=0.01)


@given(delay_s=st.floats(0.01, 0.06), from_reference=st.booleans())
def test_a_goal_moves_nothing_before_its_delay(delay_s: float, from_reference: bool) -> None:
    goal = np.array([[500.0], [600.0]])
    told = stretches(sent_s=np.array([0.004]), goal_tick=goal, from_reference=from_reference)
    early = told._replace(length_s=np.array([0.002 + delay_s]))
    motor = MOTOR._replace(delay_s=delay_s)
    assert foretold(early, NO_KG, motor)[0, 0] == 0.0
    late = told._replace(length_s=np.array([0.2 + delay_s]), speed_tick_s=np.full((2, 1), 400.0))
    assert foretold(late, NO_KG, motor)[0, 0] > 0.0


@given(error=st.floats(2.0, 20.0), place=st.sampled_from(foretelling.PLACES))
def test_whole_ticks_are_seen_until_the_shaft_reaches_another_one(error: float, place: float) -> None:
    """The output at the end is one of the controller's levels, and the shaft goes where it pushes."""
    pushed = stretches(ramp_tick=np.array([500.0 + error]), goal_tick=np.full((2, 1), 500.0 + error))
    way, _, output = foretold(pushed, NO_KG, MOTOR, place)[:, 0]
    left = round(500.0 + error) - round(500.0 + place + way)
    level = 0.03 + (abs(left) - 1.0) * 0.04 if abs(left) > 1 else 0.0
    assert output == pytest.approx(math.copysign(level, left))
    assert way >= 0.0


@pytest.mark.parametrize("friction_Nm", [0.15, 0.27])
@pytest.mark.parametrize("from_reference", [True, False])
def test_numbers_are_found_from_what_they_foretold(from_reference: bool, friction_Nm: float) -> None:
    """Also friction that is far from what is usual."""
    rng, m = np.random.default_rng(3), 900
    side = rng.choice([-1.0, 1.0], m)
    way, at = side * rng.uniform(3.0, 12.0, m), rng.uniform(-math.pi, math.pi, m)
    pulls, leans = np.cos(at), -np.sin(at)
    whole, place = 500.0 - side * rng.integers(3, 10, m), rng.uniform(-0.5, 0.5, m)
    made = stretches(
        m, shaft_tick=whole, whole_tick=whole, velocity_rad_s=side * rng.uniform(0.1, 0.5, m),
        sent_s=np.full(m, 0.004), goal_tick=np.array([500.0 + 0.0 * way, 500.0 + way]),
        speed_tick_s=np.tile(np.abs(way) / (0.1 if from_reference else 0.01), (2, 1)), from_reference=from_reference,
        gravity=np.stack([pulls, leans], axis=1)[None].repeat(2, axis=0), inertia_m2=np.full((m, 2), [0.03, 0.0]),
    )  # fmt: skip
    true = Motor(1.35, 6.5, friction_Nm, 0.03, 1.3, 0.041, 0.002, 0.02)
    noise = rng.normal(0.0, 1.0, (3, m)) * [[0.3], [0.01], [0.01]]
    seen = foretold(made, 0.3 * np.array([1.0, true.zero_rad]), true, place) + noise
    guess = Guess(np.array([0.3]), np.array([1.5]), np.array([6.2]), np.full((2, 1), math.nan))
    theta, cov = fit(guess, {0: made._replace(seen=seen)})
    kg, motor = guess.means(theta, 0)
    assert kg[0] / motor.stall_Nm == pytest.approx(0.3 / 1.35, rel=0.04)
    assert motor.coulomb_Nm / motor.stall_Nm == pytest.approx(friction_Nm / 1.35, rel=0.05)
    assert motor.no_load_rad_s == pytest.approx(6.5, rel=0.05)
    assert motor.delay_s == pytest.approx(0.041, abs=0.003)
    assert motor.zero_rad == pytest.approx(0.02, abs=0.01)
    assert (np.diag(cov) <= guess.prior() ** 2 * (1.0 + 1e-9)).all()
