"""Jogging: heartbeats, speeds, limits and floor, judged by the goals that go out."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from armctl.config import ArmConfig
from armctl.control.jog import SPEED_RAD_S, led
from armctl.control.motion import LEAD_TICKS
from armctl.dynamixel import ax12a
from armctl.files import load_arm
from armctl.kinematics.chain import jacobian, tool_position
from armctl.lab.rig import ObservingClock
from armctl.messages import Clear, Hold, HostLost, Jog, Mode, Park, Release, Run, UseModel
from armctl.sim.arm import SimulatedArm
from armctl.sim.virtual_arm import VirtualArm
from armctl.trajectory.collision import floor_clearance, link_points
from armctl.trajectory.lag import nominal
from tests.control.ideal_arm import PERIOD_S, IdealArm, holding, line

BASE = (0.2, 0.0, 0.0, 0.0, 0.0, 0.0)
# Of one goal step at full speed, rounding included.
MOST_TICKS = math.ceil(SPEED_RAD_S * PERIOD_S / ax12a.TICK_RAD) + 1


def bent(at_deg: Sequence[float] = (0.0, 87.0, -65.0, -64.0, -33.0, 0.0), config: ArmConfig | None = None) -> IdealArm:
    """Holding, by itself where the tool is free to move any way."""
    arm = IdealArm() if config is None else IdealArm(config)
    for index, degrees in enumerate(at_deg):
        tick = round(arm.arm.joints[index].tick(math.radians(degrees)))
        arm.put(index, ax12a.PRESENT_POSITION, tick)
        arm.put(index, ax12a.GOAL, tick)
    arm.power().connect().run_tick()
    assert arm.mode() is Mode.HOLDING
    return arm


def jog(arm: IdealArm, ticks: int, joints_rad_s: tuple[float, ...] = (), tool_m_s: tuple[float, ...] = ()) -> None:
    """A jog with a heartbeat every tick."""
    for tick in range(ticks):
        request_id = 100 + arm.tick
        arm.run_tick(Jog(request_id, joints_rad_s, tool_m_s, tick == 0))
        assert arm.replies[request_id].ok, arm.replies[request_id]


def tool(arm: IdealArm) -> np.ndarray:
    return tool_position(arm.robot.chain, np.array(arm.positions_rad()[: arm.robot.chain.n]))


def test_a_joint_goes_as_fast_as_asked_and_the_others_stay() -> None:
    arm = holding()
    before = arm.positions_rad()
    jog(arm, 11, joints_rad_s=BASE)
    assert arm.mode() is Mode.JOGGING
    moved = np.subtract(arm.positions_rad(), before)
    assert moved[0] == pytest.approx(0.2 * 11 * PERIOD_S, abs=2 * ax12a.TICK_RAD)
    assert not moved[1:].any()


def test_a_jog_stops_within_one_tick_of_its_last_heartbeat_and_holds() -> None:
    arm = holding()
    jog(arm, 5, joints_rad_s=BASE)
    [last] = arm.goals[-1:]
    arm.goals.clear()
    arm.run_ticks(4)
    [called_back] = arm.goals
    assert called_back[1:] == last[1:], "only what moves is called back"
    assert 1 <= last[0] - called_back[0] <= 2, "just behind where the joint is"
    assert arm.mode() is Mode.JOGGING, "until it is clear that none was only late"
    arm.goals.clear()
    arm.run_ticks(3)
    assert not arm.goals
    assert arm.mode() is Mode.HOLDING
    assert "JOG_END" in arm.events


def stands_after_s(virtual: VirtualArm, clock: ObservingClock, tool_m_s: tuple[float, ...], ticks: int) -> float:
    """How long the true tool goes on after the last heartbeat, by over 0.2 mm in 12 samples of 4 ms [s]."""
    for count in range(ticks):
        last = virtual.tick(Jog(virtual.next_id(), (), tool_m_s, count == 0))
        assert all(reply.ok for reply in last.outputs.replies)
    clock.seen.clear()
    virtual.ticks(10)
    tool_m = virtual.simulated.tool_positions(np.array([q for _, q in clock.seen]))
    moving = np.flatnonzero(np.linalg.norm(tool_m[12:] - tool_m[:-12], axis=1) > 0.0002)
    assert len(moving), "it was led"
    return float(clock.seen[moving[-1] + 12][0] - last.inputs.now_ns) / 1e9


def test_the_true_tool_stands_within_200_ms_of_the_last_heartbeat() -> None:
    slowest_s = []
    for seed in range(6):
        simulated = SimulatedArm(load_arm("ax12-line"), seed=seed)
        virtual = VirtualArm(simulated, clock=(clock := ObservingClock(simulated)))
        clock.observe_from_ns = 0
        virtual.energise()
        bent_rad = np.radians((0.0, 87.0, -65.0, -64.0, -33.0, 0.0))
        for count in range(80):
            left = np.clip((bent_rad - virtual.goals_rad) / PERIOD_S, -SPEED_RAD_S, SPEED_RAD_S)
            virtual.tick(Jog(virtual.next_id(), tuple(left), (), count == 0))
        virtual.ticks(8)
        ways = [tuple(0.03 * way) for axis in np.eye(3) for way in (axis, -axis)]
        slowest_s += [stands_after_s(virtual, clock, way, 4 + seed) for way in ways]
    assert max(slowest_s) <= 0.2, sorted(slowest_s)[-5:]


def test_a_joint_that_lags_behind_is_waited_for() -> None:
    arm = holding()
    arm.stuck.add(0)
    there = arm.get(0, ax12a.PRESENT_POSITION)
    for tick in range(20):
        arm.run_tick(Jog(100 + tick, (SPEED_RAD_S, 0.0, 0.0, 0.0, 0.0, 0.0), (), tick == 0))
        assert abs(arm.get(0, ax12a.GOAL) - there) <= LEAD_TICKS
    assert arm.code() == "BLOCKED"


def test_a_heartbeat_that_was_only_late_starts_the_arm_again_from_rest() -> None:
    arm = holding()
    jog(arm, 5, joints_rad_s=(SPEED_RAD_S, 0.0, 0.0, 0.0, 0.0, 0.0))
    arm.run_ticks(2)
    arm.goals.clear()
    assert arm.ask(Jog(7, BASE)).ok
    assert len(arm.goals) == 1


def test_at_100_hz_a_jog_is_still_within_200_ms_of_its_last_heartbeat() -> None:
    arm = holding()
    arm.period_s = 0.01
    for tick in range(40):
        arm.run_tick(Jog(100 + tick, (SPEED_RAD_S, 0.0, 0.0, 0.0, 0.0, 0.0), begin=tick == 0))
    fastest = max(abs(b[0] - a[0]) for a, b in pairwise(arm.goals[-10:]))
    arm.goals.clear()
    arm.run_ticks(60)
    moving = [tick for tick, (a, b) in enumerate(pairwise(arm.goals)) if a != b]
    assert moving[-1] * 0.01 < 0.19
    assert max(abs(b[0] - a[0]) for a, b in pairwise(arm.goals)) <= fastest
    assert arm.mode() is Mode.HOLDING


def test_a_jog_that_has_ended_does_not_go_on_by_itself() -> None:
    arm = holding()
    jog(arm, 5, joints_rad_s=BASE)
    assert (arm.ask(Hold(6)).ok, arm.mode()) == (True, Mode.HOLDING)
    arm.goals.clear()
    assert arm.ask(Jog(7, BASE)).code == "ILLEGAL_TRANSITION"
    assert not arm.goals
    jog(arm, 1, joints_rad_s=BASE)


@pytest.mark.parametrize("end", [HostLost(), "late", "fault"])
def test_whatever_stops_a_motion_stops_a_jog(end: object) -> None:
    arm = holding()
    jog(arm, 5, joints_rad_s=BASE)
    arm.goals.clear()
    if end == "late":
        arm.late_ns = 300_000_000
        arm.now_ns += arm.late_ns
        arm.run_tick(Jog(7, BASE))
        arm.late_ns = 0
    elif end == "fault":
        arm.put(3, ax12a.TORQUE_LIMIT, 0)
        arm.run_tick(Jog(7, BASE))
    else:
        arm.run_tick(end)  # type: ignore[arg-type]
    arm.run_ticks(7)
    assert not arm.goals
    assert arm.state.jog is None
    assert arm.mode() is (Mode.FAULTED if end == "fault" else Mode.HOLDING)


def test_a_jog_waits_while_a_servo_is_unheard() -> None:
    arm = holding()
    jog(arm, 5, joints_rad_s=BASE)
    arm.silent = {2}
    arm.goals.clear()
    for _ in range(2):
        arm.run_tick(Jog(7, BASE))
    assert not arm.goals
    arm.silent = set()
    arm.run_tick(Jog(8, BASE))
    assert len(arm.goals) == 1


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_joint_slows_down_before_its_limit_and_never_passes_it(direction: float) -> None:
    arm = holding()
    low, high = arm.arm.joints[0].limits_tick
    jog(arm, 120, joints_rad_s=(direction, 0.0, 0.0, 0.0, 0.0, 0.0))
    base = [goal[0] for goal in arm.goals]
    assert base[-1] == (high if direction > 0.0 else low)
    steps = [abs(b - a) for a, b in pairwise(base)]
    assert max(steps) <= MOST_TICKS
    moving = [step for step in steps if step]
    assert moving[-1] < max(steps) / 2


@given(st.lists(st.tuples(st.sampled_from("xyz"), st.floats(-1.0, 1.0), st.integers(1, 8)), min_size=1, max_size=8))
@settings(max_examples=30)
def test_no_tool_jog_breaks_limits_speeds_or_floor(story: list[tuple[str, float, int]]) -> None:
    arm = bent()
    chain, n = arm.robot.chain, arm.robot.chain.n
    places, heights = [tool(arm)], []
    begin = True
    for axis, speed, ticks in story:
        for _ in range(ticks):
            velocity = tuple(speed * (axis == one) for one in "xyz")
            arm.run_tick(Jog(arm.tick + 100, tool_m_s=velocity, begin=begin))
            begin = False
            places.append(tool(arm))
            points = link_points(chain, np.array(arm.positions_rad()[:n]))
            heights.append(float(floor_clearance(points, arm.arm.floor_m, arm.arm.link_radius_m).min()))
    for goal in arm.goals:
        for tick, joint in zip(goal, arm.arm.joints, strict=True):
            assert joint.limits_tick[0] <= tick <= joint.limits_tick[1]
    for a, b in pairwise(arm.goals):
        assert max(abs(x - y) for x, y in zip(a, b, strict=True)) <= MOST_TICKS
    # A tick of each of five joints is 6 mm at the tool.
    rounding_m = 0.006
    for before, after in pairwise(places):
        assert np.linalg.norm(after - before) <= arm.arm.tool_speed_limit_m_s * PERIOD_S + 2 * rounding_m
    assert min(heights) > -rounding_m


@pytest.mark.parametrize(("axis", "direction"), [(0, (1.0, 0.0, 0.0)), (1, (0.0, 1.0, 0.0)), (2, (0.0, 0.0, 1.0))])
def test_a_tool_is_led_along_the_axis(axis: int, direction: tuple[float, float, float]) -> None:
    arm = bent()
    before = tool(arm)
    jog(arm, 15, tool_m_s=tuple(0.03 * part for part in direction))
    moved = tool(arm) - before
    assert moved[axis] == pytest.approx(0.045, abs=0.006)
    assert np.abs(np.delete(moved, axis)).max() < 0.006


# How high the shoulder is, and how long the stretched arm from there on.
SHOULDER_M, STRETCHED_M = 0.1, 0.38
# The arm as it is bent, and how its tool is led to the edge of its reach.
EDGES = [
    ((20.0, 40.0, -8.0, -6.0, -5.0, 0.0), (1.0, 0.0, 0.0)),
    ((20.0, 40.0, -8.0, -6.0, -5.0, 0.0), (0.0, 0.0, 1.0)),
    ((0.0, 45.0, -25.0, -15.0, -10.0, 0.0), (1.0, 0.0, 0.0)),
    ((0.0, 45.0, -25.0, -15.0, -10.0, 0.0), (0.0, 1.0, 0.0)),
    ((0.0, 45.0, -25.0, -15.0, -10.0, 0.0), (0.0, 0.6, 0.8)),
    ((30.0, 85.0, -10.0, -10.0, -5.0, 0.0), (0.0, 0.0, 1.0)),
]


def wanted_tool(arm: IdealArm) -> np.ndarray:
    """Where the tool is told to be, which is not rounded to ticks."""
    assert arm.outputs is not None
    return tool_position(arm.robot.chain, np.array(arm.outputs.wanted_rad[: arm.robot.chain.n]))


@pytest.mark.parametrize("speed_m_s", [0.002, 0.03, 0.2])
@pytest.mark.parametrize(("at_deg", "way"), EDGES)
def test_at_the_edge_of_the_reach_the_tool_goes_straight_on_and_stops(
    at_deg: Sequence[float], way: Sequence[float], speed_m_s: float
) -> None:
    arm = bent(at_deg)
    begin, velocity = tool(arm), tuple(speed_m_s * part for part in way)
    places = [begin]
    while (reply := arm.ask(Jog(arm.tick + 100, (), velocity, begin=len(places) == 1))).ok:
        places.append(wanted_tool(arm))
        assert len(places) < 3000, "it neither arrives nor is it told why"
    x, y, z = places[-1].round(3)
    assert reply.code == "UNREACHABLE"
    assert reply.message.startswith(
        f"the arm is stretched out, or its tool over its base: from ({x:.3f}, {y:.3f}, {z:.3f}) m"
    )
    moved = np.array(places) - begin
    along = moved @ way
    assert np.linalg.norm(moved - along[:, None] * way, axis=1).max() < 0.006  # of up to 0.14 m
    assert (np.diff(along) > 0.0).all(), "it never goes back"
    far_m = math.dist(places[-1], (0.0, 0.0, SHOULDER_M))
    assert STRETCHED_M - 0.002 < far_m < STRETCHED_M + 1e-9
    arm.run_ticks(8)
    assert arm.mode() is Mode.HOLDING
    # Called back a hair, it goes on by no more than that.
    codes = [arm.ask(Jog(arm.tick + 5000, (), velocity, begin=k == 0)).code for k in range(8)]
    assert "UNREACHABLE" in codes
    assert np.linalg.norm(wanted_tool(arm) - places[-1]) < 0.001
    arm.run_ticks(8)
    # And the same way back.
    jog(arm, 20, tool_m_s=tuple(-part for part in velocity))
    returned = wanted_tool(arm) - places[-1]
    assert returned @ way < -min(0.01, 0.5 * speed_m_s)
    assert np.linalg.norm(returned - (returned @ way) * np.array(way)) < 0.006


# Stretched out as far as whole ticks go, and how it is led in.
INWARD = [
    ((0.0, 45.0, 0.0, 0.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
    ((0.0, 45.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    ((0.0, 90.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
]


@pytest.mark.parametrize(("at_deg", "way"), INWARD)
def test_a_stretched_arm_is_led_in_and_not_out(at_deg: Sequence[float], way: Sequence[float]) -> None:
    arm = bent(at_deg)
    outward = tuple(-0.03 * part for part in way)
    assert arm.ask(Jog(5, (), outward, begin=True)).code == "UNREACHABLE"
    begin = tool(arm)
    jog(arm, 20, tool_m_s=tuple(0.03 * part for part in way))
    moved = wanted_tool(arm) - begin
    assert moved @ way > 0.03
    assert np.linalg.norm(moved - (moved @ way) * np.array(way)) < 0.002


JOINTS = load_arm("ax12-line").joints
# Anywhere, and often at a limit.
POSTURES = st.tuples(
    *[st.one_of(st.floats(*joint.limits_deg), st.sampled_from(joint.limits_deg)) for joint in JOINTS[:5]]
)


@given(at_deg=POSTURES, way=st.tuples(*[st.floats(-1.0, 1.0)] * 3), speed_m_s=st.floats(0.005, 0.1))
# Its base at its limit, it was led in by half a millimetre a second, at 45 deg to the way, and nobody was told.
@example(at_deg=(145.0, 79.8, -60.4, -52.8, -47.5), way=(0.0, -1.0, 0.0), speed_m_s=0.03)
@settings(max_examples=60)
def test_a_tool_is_led_straight_on_or_told_why_not_and_never_left_standing(
    at_deg: tuple[float, ...], way: tuple[float, float, float], speed_m_s: float
) -> None:
    assume(np.linalg.norm(way) > 0.1)
    arm = bent((*at_deg, 0.0))
    unit = np.array(way) / np.linalg.norm(way)
    velocity, places = tuple((speed_m_s * unit).tolist()), [tool(arm)]
    for beat in range(30):
        reply = arm.ask(Jog(arm.tick + 100, (), velocity, begin=beat == 0))
        if not reply.ok:
            assert reply.code == "UNREACHABLE", reply
            break
        points = link_points(arm.robot.chain, np.array(arm.positions_rad()[: arm.robot.chain.n]))
        if floor_clearance(points, arm.arm.floor_m, arm.arm.link_radius_m).min() < 0.03:
            break  # what it may stand still for
        places.append(wanted_tool(arm))
    moved = np.array(places) - places[0]
    along = moved @ unit
    assert (np.diff(along) > -1e-9).all()
    assert (np.linalg.norm(moved - along[:, None] * unit, axis=1) < 0.1 * along + 0.0005).all()
    assert len(places) < 30 or along[-1] > 0.0005


def test_the_tool_is_led_no_farther_out_than_the_arm_can_lift_it_back() -> None:
    plain = IdealArm().arm
    model = nominal(plain, IdealArm().robot.chain)
    ends_m = {}
    for weight, corrected in ((0.8, True), (1.2, True), (1.2, False)):
        arm = bent((0.0, 70.0, -80.0, -20.0, 0.0, 0.0), plain.model_copy(update={"correction": corrected}))
        rows = tuple((*(weight * gravity for gravity in row[:-3]), *row[-3:]) for row in model.rows)
        assert arm.ask(UseModel(5, replace(model, rows=rows))).ok
        begin, out, beat = tool(arm), (0.03, 0.0, 0.0), 0
        while (reply := arm.ask(Jog(arm.tick + 100, (), out, begin=beat == 0))).ok and beat < 200:
            beat += 1
        assert reply.code == "UNREACHABLE"
        too_heavy = "shoulder would lift the arm more than 6.5 deg behind its goal" in reply.message
        assert too_heavy == (weight > 1.0 and corrected)
        ends_m[weight, corrected] = tool(arm)[0] - begin[0]
        arm.run_ticks(8)
        jog(arm, 10, tool_m_s=(-0.03, 0.0, 0.0))
    assert 0.005 < ends_m[1.2, True] < 0.07
    assert min(ends_m[0.8, True], ends_m[1.2, False]) > 0.09, "stretched out; without correction no sag is promised"


def test_joint_velocities_give_the_tool_velocity_away_from_singular_poses() -> None:
    arm = bent()
    q = arm.positions_rad()
    wanted = np.array([0.01, -0.02, 0.03])
    found = led(arm.arm, arm.robot, q, Jog(1, tool_m_s=tuple(wanted.tolist())))
    J = jacobian(arm.robot.chain, np.array(q[:5]))[:3]
    assert found == pytest.approx([*np.linalg.solve(J.T @ J + 1e-4 * np.eye(5), J.T @ wanted), 0.0], rel=1e-6)
    assert J @ np.array(found[:5]) == pytest.approx(wanted, rel=0.1)


@pytest.mark.parametrize(
    "command",
    [
        Jog(5, begin=True),
        Jog(5, joints_rad_s=(0.1,) * 5, begin=True),
        Jog(5, tool_m_s=(0.1, 0.0), begin=True),
        Jog(5, joints_rad_s=BASE, tool_m_s=(0.1, 0.0, 0.0), begin=True),
        Jog(5, tool_m_s=(math.nan, 0.0, 0.0), begin=True),
        Jog(5, joints_rad_s=(math.inf, 0.0, 0.0, 0.0, 0.0, 0.0), begin=True),
    ],
)
def test_a_jog_that_means_nothing_is_refused(command: Jog) -> None:
    arm = holding()
    arm.run_tick(command)
    assert (arm.mode(), arm.replies[5].code) == (Mode.HOLDING, "LIMIT")


def test_nothing_else_begins_while_jogging() -> None:
    arm = holding()
    jog(arm, 3, joints_rad_s=BASE)
    beat = Jog(50, BASE)
    arm.run_tick(beat, Run(5, line(arm)), Park(6), Release(7), Jog(8, BASE, begin=True))
    for request_id in (5, 6, 7, 8):
        assert arm.replies[request_id].code == "ILLEGAL_TRANSITION"
    assert "jogged" in arm.replies[5].message
    assert arm.mode() is Mode.JOGGING
    assert arm.ask(Clear(9)).ok
