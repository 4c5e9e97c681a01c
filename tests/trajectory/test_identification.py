"""The estimator on made-up servos with known parameters: each rule by itself, and one joint as a whole."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.dynamixel.ax12a import LOAD_MAX, TICK_RAD
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.transform import FloatArray
from armctl.sim.gravity import PointMasses
from armctl.trajectory import identification
from armctl.trajectory.identification import JointFound, Trace, identify, lattice, ramp_tick

ARM = load_arm("ax12-line")
CHAIN = robots.of(ARM).chain
N = len(ARM.joints)
PERIOD_S, SENT_S = 0.1, 0.004
MARGIN, PUNCH, SLOPE = 1.0, 32.0 / LOAD_MAX, 32.0
STALL_NM = 1.5
# About the base's axis, of the masses that are usual, while all other joints stand at 512; by the simulator's sums.
STILL_RAD = [joint.position_rad(512.0) for joint in ARM.joints]
STILL_KG_M2 = PointMasses(CHAIN, (0.0, *identification.usual_kg(ARM, CHAIN.n).tolist())).loads(STILL_RAD)[0][1]


def trace(goal: FloatArray, **seen: FloatArray) -> Trace:
    """A trace in which one servo is told goals tick by tick, and the others are not heard."""
    m = len(goal)
    time_s = np.arange(m) * np.float64(PERIOD_S)
    wide = {key: np.tile(np.asarray(value, float)[:, None], (1, N)) for key, value in seen.items()}
    known = np.zeros((m, N), bool)
    known[:, 0] = True
    goals = np.tile(goal[:, None], (1, N))
    shown = np.vstack([goals[:1], goals[:-1]])
    position = np.full((m, N), 512.0)
    position[:, 0] = seen.get("position_tick", position[:, 0])
    return Trace(
        read_s=np.tile(time_s[:, None], (1, N)),
        sent_s=time_s + SENT_S,
        goal_tick=goals,
        speed_tick_s=wide.get("speed_tick_s", np.full((m, N), 200.0)),
        shown_tick=shown,
        position_tick=position,
        output=wide.get("output", np.zeros((m, N))),
        velocity_rad_s=wide.get("velocity_rad_s", np.zeros((m, N))),
        voltage_V=np.full((m, N), 12.0),
        margin_tick=np.full((m, N), MARGIN),
        slope_tick=np.full((m, N), SLOPE),
        punch=np.full((m, N), PUNCH),
        known=known,
    )


@given(
    goals=st.lists(st.integers(300, 700), min_size=3, max_size=30),
    speed=st.floats(20.0, 400.0),
    delay_ms=st.integers(0, 60),
)
def test_the_ramp_is_where_a_servo_that_steps_each_millisecond_has_it(
    goals: list[int], speed: float, delay_ms: int
) -> None:
    made = trace(np.array(goals, float))._replace(speed_tick_s=np.full((len(goals), N), speed))
    at_s = made.read_s[1:, 0] + 0.07
    found = ramp_tick(made, 0, at_s, delay_ms / 1e3, from_reference=True)
    here, steps = float(goals[0]), {}
    begins = {round(1e3 * t) + delay_ms: goal for t, goal in zip(made.sent_s, goals, strict=True)}
    goal = here
    for ms in range(round(1e3 * at_s[-1]) + 1):
        steps[ms] = here
        goal = begins.get(ms, goal)
        here += float(np.clip(goal - here, -speed / 1e3, speed / 1e3))
    assert found == pytest.approx([steps[round(1e3 * t)] for t in at_s], abs=speed / 500.0)


@given(slope=st.floats(16.0, 36.0), punch=st.floats(0.0, 0.08), highest=st.integers(4, 12))
def test_levels_of_output_tell_gain_and_punch(slope: float, punch: float, highest: int) -> None:
    gain = (1.0 - punch) / slope
    levels = np.round(LOAD_MAX * (punch + gain * np.arange(1, highest))) / LOAD_MAX
    found = lattice(np.tile(levels, 20))
    assert found is not None
    assert found[0] == pytest.approx(gain, rel=0.03)
    off = (found[1] - punch) / gain
    assert off == pytest.approx(round(off), abs=0.2)


def test_two_levels_tell_nothing() -> None:
    assert lattice(np.tile([0.08, 0.13], 50)) is None


@given(play=st.floats(0.5, 5.0), noise=st.floats(0.4, 1.5), seed=st.integers(0, 100))
@settings(max_examples=20, deadline=None)
def test_a_shaft_that_gravity_turns_over_shows_its_play(play: float, noise: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    G = np.repeat([0.05, -0.05, 0.05, -0.05], 90)
    at = np.round(500.0 + np.sign(G) * play / 2.0 + noise * rng.standard_normal(len(G)))
    found = JointFound("elbow", {"coulomb_Nm": (0.12, 0.01)})
    identification._fit_play(trace(np.full(len(G), 510.0), position_tick=at), 0, G, found)
    value, sd = found.values["play_deg"]
    assert abs(value - play * math.degrees(TICK_RAD)) < 4.0 * sd < 0.6


def test_a_goal_that_changes_shows_no_play() -> None:
    G = np.repeat([0.05, -0.05], 90)
    goal = np.where(G > 0.0, 510.0, 512.0)
    found = JointFound("elbow", {"coulomb_Nm": (0.12, 0.01)})
    identification._fit_play(trace(goal, position_tick=goal), 0, G, found)
    assert "play_deg" not in found.values
    assert "turned over" in found.unseen["play_deg"]


def turning(
    delay_s: float, friction: float, free_rad_s: float, share: float, *, from_reference: bool, seed: int
) -> Trace:
    """A joint about a vertical axis, integrated each millisecond: friction over strength, speed without load."""
    rng, inertia_s2 = np.random.default_rng(seed), 0.0015 + STILL_KG_M2 / STALL_NM
    goal, most = [512.0], 170.0  # tick/s^2: legs in which no speed lasts, so that no moment of a tick is seen for long
    for far in (58.0, 51.0, 45.0, 38.0, 31.0, 24.0, 17.0) * 3:
        for to in (512.0 + far, 512.0 - far):
            begin, end_s = goal[-1], 2.0 * math.sqrt(abs(to - goal[-1]) / most)
            u = np.minimum(PERIOD_S * np.arange(1, math.ceil(end_s / PERIOD_S) + 1) / end_s, 1.0)
            goal += (begin + (to - begin) * np.where(u < 0.5, 2.0 * u * u, 1.0 - 2.0 * (1.0 - u) ** 2)).tolist()
    goals = np.round(goal)
    way = np.abs(np.diff(goals, prepend=goals[0]))
    gain = (1.0 - PUNCH) / (share * SLOPE)
    shaft, velocity, ramp, output = 512.0, 0.0, 512.0, 0.0
    rows, told, late = [], (512.0, 200.0), []
    speed = np.maximum(way / PERIOD_S, 36.0)
    for ms in range(round(1e3 * PERIOD_S) * len(goals)):
        if ms % 100 == 0:
            rows.append((math.floor(shaft + 0.5 + 0.6 * rng.standard_normal()), output, velocity))
        if ms % 100 == round(1e3 * SENT_S):
            late.append((ms + round(1e3 * delay_s), goals[ms // 100], speed[ms // 100]))
        while late and late[0][0] <= ms:
            _, *new = late.pop(0)
            told = new[0], new[1]
            ramp = ramp if from_reference else float(math.floor(shaft + 0.5))
        ramp += float(np.clip(told[0] - ramp, -told[1] / 1e3, told[1] / 1e3))
        error = math.floor(ramp + 0.5) - math.floor(shaft + 0.5)
        output = math.copysign(PUNCH + (abs(error) - MARGIN) * gain, error) if abs(error) > MARGIN else 0.0
        torque = output - velocity / free_rad_s
        if velocity == 0.0 and abs(torque) <= 1.2 * friction:
            continue
        side = math.copysign(1.0, velocity or torque)
        after = velocity + (torque - side * friction) * 1e-3 / inertia_s2
        velocity = after if after * side > 0.0 else 0.0
        shaft += velocity * 1e-3 / TICK_RAD
    position, outputs, velocities = np.array(rows, float).T
    return trace(
        goals, speed_tick_s=speed, position_tick=position, output=np.round(outputs * LOAD_MAX) / LOAD_MAX,
        velocity_rad_s=velocities,
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(6))
def test_a_made_up_joint_is_found_within_its_intervals(seed: int) -> None:
    rng = np.random.default_rng(seed)
    delay_s, friction = rng.uniform(0.017, 0.05), rng.uniform(0.05, 0.12)
    free, share = rng.uniform(5.6, 6.8), rng.uniform(0.6, 1.0)
    made = turning(delay_s, friction, free, share, from_reference=True, seed=seed)
    found = identify(ARM, CHAIN, made)
    base = found.joints[0]
    assert found.ramp_from_reference is True
    assert base["slope_tick"] == pytest.approx(share * SLOPE, rel=0.02)
    assert base["punch"] == pytest.approx(32.0, abs=2.0)
    assert base["delay_ms"] == pytest.approx(1e3 * delay_s, abs=3.0 * base.values["delay_ms"][1])
    # Strength is seen by nothing here: friction is known as a share of it, and said to be no more.
    assert base.likely["coulomb_Nm"][0] / base["stall_Nm"] == pytest.approx(friction, rel=0.15)
    assert "coulomb_Nm" not in base.values
    assert "strength" in base.unseen["coulomb_Nm"]
    assert "play_deg" in base.unseen


@pytest.mark.parametrize("seed", range(4))
def test_a_joint_whose_ramps_begin_at_the_shaft_is_found_by_what_it_does_next(seed: int) -> None:
    rng = np.random.default_rng(seed + 10)
    delay_s, friction, free = rng.uniform(0.017, 0.05), rng.uniform(0.05, 0.12), rng.uniform(5.6, 6.8)
    found = identify(ARM, CHAIN, turning(delay_s, friction, free, 0.8, from_reference=False, seed=seed))
    base = found.joints[0]
    assert found.ramp_from_reference is False
    assert base.likely["coulomb_Nm"][0] / base["stall_Nm"] == pytest.approx(friction, rel=0.15)
    if "delay_ms" not in base.unseen:
        assert base["delay_ms"] == pytest.approx(1e3 * delay_s, abs=min(10.0, 3.0 * base.values["delay_ms"][1]))


def test_an_arm_that_only_stood_tells_nothing_and_says_so() -> None:
    found = identify(ARM, CHAIN, trace(np.full(100, 512.0)))
    assert found.ramp_from_reference is None
    for joint in found.joints:
        assert set(identification.QUANTITIES) == set(joint.unseen) | (
            set(joint.values) & set(identification.QUANTITIES)
        )
        assert not set(identification.QUANTITIES) & set(joint.values)


@pytest.mark.parametrize("name", ["ax12-line", "crane-plus-v2", "phantomx-reactor"])
def test_masses_are_as_heavy_and_as_slow_as_point_masses_on_the_chain(name: str) -> None:
    arm = load_arm(name)
    chain, rng = robots.of(arm).chain, np.random.default_rng(1)
    kg, q = rng.uniform(0.0, 0.5, chain.n + 1), rng.uniform(-2.0, 2.0, (20, len(arm.joints)))
    loads = identification.burdens(arm, chain, q) @ kg
    masses = PointMasses(chain, (9.0, *kg.tolist()))  # what sits on the first axis loads none
    true = np.array([masses.loads(row) for row in q[:, : chain.n].tolist()])
    np.testing.assert_allclose(loads[:, : chain.n].T, true, atol=1e-12)
    assert not loads[:, chain.n :].any()


def test_what_two_logs_hold_counts_once() -> None:
    made = trace(np.arange(400.0, 500.0))
    first, second = (
        Trace(**{name: column[rows] for name, column in made._asdict().items()})
        for rows in (slice(0, 60), slice(40, 100))
    )
    assert Trace.joined([first, second]).read_s.tolist() == made.read_s.tolist()
