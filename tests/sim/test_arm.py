"""Laws of the simulated arm's physics, on virtual time."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.kinematics import robots
from armctl.kinematics.inverse import solve_position
from armctl.kinematics.transform import FloatArray
from armctl.sim.arm import SimulatedArm
from armctl.sim.faults import Fault
from armctl.sim.servo import ServoVariants, SimulatedServo
from armctl.sim.spec import RANDOM_SPEC, ArmSpec
from tests.sim.conftest import WORKING_RAD, Bench, turned, write

CHAIN = robots.get("ax12-line").chain


def test_arm_starts_limp_in_its_rest_pose_and_stays(bench: Bench) -> None:
    bench.wait(1e6)  # at rest time costs nothing, or this would take hours
    assert bench.arm.true_positions() == pytest.approx([joint.rest_rad for joint in bench.arm.config.joints], abs=1e-9)
    assert not any(servo.torque_enabled for servo in bench.arm.servos)


FAULTS = (
    Fault(kind="blocked_joint", servo_id=1, begin_s=0.3, duration_s=0.4),
    Fault(kind="second_writer", servo_id=6, begin_s=0.55, value=-40),
    Fault(kind="brown_out", begin_s=1.1003, duration_s=0.7, probability=0.5),
)


@pytest.mark.parametrize(
    ("script", "guided", "longest_ns"),
    [((), True, 400_000_000), (FAULTS, False, 700_000_000), ((), False, 200_000_000_000)],
    ids=["guided", "with faults", "getting warm"],
)
@settings(max_examples=15)
@given(shares=st.lists(st.floats(1e-6, 1.0), max_size=8))
def test_result_does_not_depend_on_how_time_is_cut(
    arm: ArmConfig, script: Sequence[Fault], guided: bool, longest_ns: int, shares: list[float]
) -> None:
    in_pieces, at_once = Bench(arm, *script, seed=3), Bench(arm, *script, seed=3)
    for bench in (in_pieces, at_once):
        if guided:
            bench.arm.hand.guide(np.array([0.2, 0.0, 0.1]), np.array([0.2, 0.1, 0.1]), seed=1)
        bench.goto(WORKING_RAD)
    for share in shares:
        in_pieces.wait(share * longest_ns / 1e9)
    at_once.wait((in_pieces.now_ns - at_once.now_ns) / 1e9)
    assert in_pieces.arm.true_positions().tolist() == at_once.arm.true_positions().tolist()
    for cut, whole in zip(in_pieces.arm.servos, at_once.arm.servos, strict=True):
        assert cut.torque_enabled == whole.torque_enabled
        assert cut.temperature_degC == pytest.approx(whole.temperature_degC, abs=1e-9)


def test_same_seed_same_arm_and_other_seed_other_arm(arm: ArmConfig) -> None:
    benches = [Bench(arm, seed=seed) for seed in (1, 1, 2)]
    for bench in benches:
        bench.goto(WORKING_RAD, 100, 4.0)
    first, same, other = (bench.arm.true_positions().tolist() for bench in benches)
    assert first == same
    assert first != other


def test_an_earlier_instant_changes_nothing(bench: Bench) -> None:
    bench.goto(WORKING_RAD, 100, 0.5)
    before = bench.arm.true_positions().tolist()
    bench.arm.advance(bench.now_ns - 300_000_000)
    assert bench.arm.true_positions().tolist() == before


def test_held_arm_sags_and_comes_to_rest(held: Bench) -> None:
    off_deg = np.degrees(held.arm.true_positions() - WORKING_RAD)
    assert -6.0 < off_deg[1] < -2.0
    assert abs(off_deg[0]) < 1.0
    settled = held.arm.true_positions().tolist()
    held.wait(2e4)
    assert held.arm.true_positions().tolist() == settled
    assert held.arm.servos[1].output > 0.2
    assert held.arm.servos[1].velocity_rad_s == 0.0


def test_limp_arm_falls_to_its_stops_and_not_beyond(arm: ArmConfig) -> None:
    spec = ArmSpec()
    bench = Bench(arm, spec=spec)
    bench.hold()
    height = bench.arm.true_tool_position()[2]
    bench.limp()
    bench.wait(5.0)
    assert bench.arm.true_tool_position()[2] < height - 0.05
    margin = math.radians(spec.stop_deg) + 1e-9
    for position, joint in zip(bench.arm.true_positions(), arm.joints, strict=True):
        low, high = joint.limits_rad
        assert low - margin <= position <= high + margin


@pytest.mark.parametrize(("speed", "wait_s", "way_rad"), [(60, 1.0, 60 * ax12a.SPEED_UNIT_RAD_S), (0, 0.5, 1.0)])
def test_moving_speed_bounds_the_speed_of_the_base_and_zero_does_not(
    bench: Bench, speed: int, wait_s: float, way_rad: float
) -> None:
    bench.goto(WORKING_RAD, 60, 6.0)
    begin_rad = bench.arm.true_positions()[0]
    bench.goto(turned(1.0), speed, wait_s)
    assert bench.arm.true_positions()[0] - begin_rad == pytest.approx(way_rad, rel=0.1)


def test_gravity_decides_the_flank_of_the_play(bench: Bench) -> None:
    for approach in (0.3, -0.3):
        start = WORKING_RAD.copy()
        start[1] += approach
        bench.goto(start, 100, 5.0)
        bench.goto(WORKING_RAD, 100, 3.0)
        shoulder = bench.arm._joints[1]
        assert shoulder.servo.shaft_rad - shoulder.motor_rad == pytest.approx(-shoulder.half_play_rad)


def test_reported_position_hides_the_zero_offset(arm: ArmConfig) -> None:
    for offset_tick, least_tick, most_tick in ((5.0, 2.0, 20.0), (0.0, 0.0, 0.51)):
        bench = Bench(arm, spec=ArmSpec(noise_tick=0.0, zero_offset_tick=offset_tick))
        bench.hold()
        ticks = [servo.get(ax12a.PRESENT_POSITION) for servo in bench.arm.servos]
        reported = [joint.position_rad(tick) for joint, tick in zip(arm.joints, ticks, strict=True)]
        off_tick = np.abs(bench.arm.true_positions() - reported) / ax12a.TICK_RAD
        assert least_tick <= off_tick.max() <= most_tick


def test_length_errors_move_the_tool_and_are_off_by_default(arm: ArmConfig) -> None:
    assert SimulatedArm(arm).chain == CHAIN
    wrong = SimulatedArm(arm, spec=ArmSpec(length_error_m=0.002)).chain
    assert 0.0 < abs(wrong.rows[1].a - CHAIN.rows[1].a) < 0.01


def test_random_arms_differ_within_their_bounds(arm: ArmConfig) -> None:
    simulated = [SimulatedArm(arm, seed=seed, spec=RANDOM_SPEC) for seed in range(40)]
    joints = [joint for one in simulated for joint in one._joints]
    zeros = [joint.zero_tick * ax12a.TICK_RAD for _ in simulated for joint in arm.joints]
    nominal_kg = RANDOM_SPEC.servo_kg + RANDOM_SPEC.bracket_kg
    for values, low, high in (
        ([joint.stall_Nm for joint in joints], 1.2, 1.8),
        ([joint.coulomb_Nm for joint in joints], 0.08, 0.16),
        ([math.degrees(2.0 * joint.half_play_rad) for joint in joints], 0.25, 0.5),
        ([(j.zero_rad - zero) / ax12a.TICK_RAD for j, zero in zip(joints, zeros, strict=True)], -0.5, 0.5),
        ([kg / nominal_kg for one in simulated for kg in one.points_kg[:-1]], 0.85, 1.15),
        ([one.points_kg[-1] for one in simulated], 0.06, 0.1),
    ):
        assert low <= min(values) < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < max(values) <= high


def test_coarse_looks_at_gravity_agree_with_looking_every_millisecond(
    arm: ArmConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The integration has converged: a tick where motors hold the arm, 10 mm where it falls at metres a second."""

    def play(seed: int) -> FloatArray:
        bench = Bench(arm, seed=seed, spec=RANDOM_SPEC)
        bench.goto(WORKING_RAD, 60, 6.0)
        rng, at, positions = np.random.default_rng(seed), WORKING_RAD, []
        for _ in range(20):
            at = at + np.clip(0.05 * rng.standard_normal(6), -0.1, 0.1)
            bench.goto(at, 60, 0.1)
            positions.append(bench.arm.true_positions())
        bench.limp()
        for _ in range(10):
            bench.wait(0.1)
            positions.append(bench.arm.true_positions())
        return np.array(positions)

    seeds = range(4)
    coarse = [play(seed) for seed in seeds]
    monkeypatch.setattr("armctl.sim.body.CHUNK_STEPS", 1)
    monkeypatch.setattr("armctl.sim.body.FAST_CHUNK_STEPS", 1)
    monkeypatch.setattr("armctl.sim.body.GRAVITY_RAD", 0.0)
    for seed, rough in zip(seeds, coarse, strict=True):
        fine = play(seed)
        off_tick = np.abs(rough - fine)[:20] / ax12a.TICK_RAD
        assert off_tick.max() < 1.5
        assert np.median(off_tick) < 0.2
        tools = (SimulatedArm(arm, seed=seed, spec=RANDOM_SPEC).tool_positions(run) for run in (rough, fine))
        assert np.linalg.norm(np.subtract(*tools), axis=1)[20:].max() < 0.01


def test_arm_at_rest_stays_so_whatever_is_written_again(arm: ArmConfig) -> None:
    told, left = Bench(arm, seed=5), Bench(arm, seed=5)
    for bench in (told, left):
        bench.goto(WORKING_RAD, 60, 8.0)
    settled = left.arm.true_positions().tolist()
    for _ in range(20):
        told.goto(WORKING_RAD, 60, 0.1)
        left.wait(0.1)
        assert told.arm.true_positions().tolist() == settled == left.arm.true_positions().tolist()
    assert [servo.temperature_degC for servo in told.arm.servos] == pytest.approx(
        [servo.temperature_degC for servo in left.arm.servos], abs=1e-9
    )


def test_looking_at_one_joint_only_changes_nothing(arm: ArmConfig) -> None:
    whole, part = Bench(arm, seed=6), Bench(arm, seed=6)
    rng = np.random.default_rng(6)
    for _ in range(40):
        target = WORKING_RAD + 0.3 * rng.standard_normal(6)
        for bench in (whole, part):
            bench.goto(target)
        for _ in range(6):
            later_ns = int(rng.integers(1, 12_000_000))
            part.now_ns += later_ns
            whole.now_ns += later_ns
            joint = int(rng.integers(6))
            part.arm.advance(part.now_ns, joint)
            whole.arm.advance(whole.now_ns)
            assert part.arm.servos[joint].position_tick == whole.arm.servos[joint].position_tick
        if rng.random() < 0.3:
            assert part.arm.true_positions().tolist() == whole.arm.true_positions().tolist()
    part.wait(0.05)
    whole.wait(0.05)
    assert part.arm.true_positions().tolist() == whole.arm.true_positions().tolist()


def test_too_heavy_a_tool_trips_the_shoulder(arm: ArmConfig) -> None:
    bench = Bench(arm, spec=ArmSpec(tool_kg=(0.6, 0.6)))
    bench.goto(WORKING_RAD, 100, 3.0)
    shoulder = bench.arm.servos[1]
    watched = (ax12a.TORQUE_ENABLE, ax12a.TORQUE_LIMIT)
    assert [shoulder.get(register) for register in watched] == [1, 1023]
    bench.wait(6.0)
    assert shoulder.overloaded
    assert [shoulder.get(register) for register in watched] == [0, 0]


def test_direction_minus_one_mirrors_the_servo(arm: ArmConfig) -> None:
    mirrored = arm.model_copy(
        update={
            "joints": tuple(j.model_copy(update={"direction": -1, "zero_tick": 1023 - j.zero_tick}) for j in arm.joints)
        }
    )
    spec = ArmSpec(zero_offset_tick=0.0)
    benches = [Bench(arm, spec=spec), Bench(mirrored, spec=spec)]
    for bench in benches:
        bench.hold()
    plain, mirror = (bench.arm.true_positions() for bench in benches)
    assert mirror == pytest.approx(plain, abs=2.0 * ax12a.TICK_RAD)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_uncorrected_streamed_line_misses_by_15_to_25_mm(arm: ArmConfig, seed: int) -> None:
    """The simulator is not kind: 5 s at 10 Hz through the bus, as a straightforward program would do it."""
    begin, end = np.array([0.18, -0.125, 0.10]), np.array([0.18, 0.125, 0.10])
    limits = np.array([joint.limits_rad for joint in arm.joints])[:5]
    path, q = [], WORKING_RAD[:5]
    for share in np.linspace(0.0, 1.0, 51):
        q = solve_position(CHAIN, begin + share * (end - begin), q, limits)
        path.append(np.append(q, 0.0))
    bench = Bench(arm, seed=seed)
    bench.goto(path[0], 60, 8.0)
    tool = []
    for before, goal in zip([path[0], *path], path, strict=False):
        speeds = [ax12a.moving_speed_units(way / 0.1) for way in goal - before]
        bench.goto(goal, speeds, 0.1)
        tool.append(bench.arm.true_tool_position())
    along = (end - begin) / np.linalg.norm(end - begin)
    miss_mm = 1e3 * np.linalg.norm(np.cross(np.array(tool) - begin, along), axis=1)
    assert 15.0 < miss_mm.mean() < 25.0
    assert miss_mm.max() < 40.0


def test_ramp_that_restarts_at_the_position_sags_more_when_streamed(arm: ArmConfig) -> None:
    heights = []
    for continues in (True, False):
        bench = Bench(arm, spec=ArmSpec(variants=ServoVariants(ramp_from_reference=continues)))
        bench.goto(WORKING_RAD, 60, 8.0)
        target = WORKING_RAD
        for _ in range(30):
            target = target + np.radians([1.0, 0.3, 0.0, 0.0, 0.0, 0.0])
            bench.goto(target, [ax12a.moving_speed_units(math.radians(10.0))] * 6, 0.1)
        heights.append(bench.arm.true_positions()[1])
    assert heights[1] < heights[0] - math.radians(1.0)


def test_voltage_falls_under_load_and_comes_back(bench: Bench) -> None:
    assert {servo.get(ax12a.PRESENT_VOLTAGE) for servo in bench.arm.servos} == {120}
    bench.hold()
    held_V = bench.arm.servos[0].voltage_V
    assert 11.8 < held_V < 12.0
    bench.begin("blocked_joint", 1)
    bench.goto(turned(1.0), 0, 1.0)
    stall_V = bench.arm.spec.supply_ohm * bench.arm.spec.stall_current_A
    assert bench.arm.servos[5].voltage_V == pytest.approx(held_V - stall_V, abs=0.02)
    bench.limp()
    bench.wait(5.0)
    assert bench.arm.servos[0].voltage_V == 12.0


def test_servo_heats_with_effort_and_cools_without(bench: Bench) -> None:
    spec = bench.arm.spec
    bench.hold()
    shoulder = bench.arm.servos[1]
    settled = spec.idle_degC + spec.stall_heating_degC * shoulder.output**2
    begin = shoulder.temperature_degC
    bench.wait(spec.heating_s)
    assert shoulder.temperature_degC == pytest.approx(settled - (settled - begin) * math.exp(-1.0), abs=1e-6)
    bench.wait(20.0 * spec.heating_s)
    assert shoulder.temperature_degC == pytest.approx(settled, abs=1e-3)
    assert 40.0 < settled < 70.0
    assert bench.arm.servos[5].temperature_degC == pytest.approx(spec.idle_degC, abs=0.1)
    bench.limp()
    bench.wait(20.0 * spec.heating_s)
    assert shoulder.temperature_degC == pytest.approx(spec.idle_degC, abs=1e-3)


@pytest.mark.parametrize("masked", [False, True])
def test_arm_left_holding_too_much_overheats_when_its_time_has_come(arm: ArmConfig, masked: bool) -> None:
    bench = Bench(arm, spec=ArmSpec(stall_heating_degC=600.0))
    shoulder = bench.arm.servos[1]
    shoulder.set(ax12a.SHUTDOWN, ax12a.ErrorBit.OVERHEAT if masked else 0)
    bench.hold()
    settled = 30.0 + 600.0 * shoulder.output**2
    wait_s = 400.0 * math.log((settled - shoulder.temperature_degC) / (settled - 70.5))
    bench.wait(wait_s - 1.0)
    assert shoulder.torque_enabled
    bench.wait(2.0)
    assert shoulder.torque_enabled is not masked
    assert round(shoulder.temperature_degC) in ((70, 71) if masked else (71,))  # without torque it cools


def wheel(bench: Bench, index: int, speed: int) -> SimulatedServo:
    """Servo `index` in wheel mode at a moving speed, written as bytes."""
    servo = bench.arm.servos[index]
    for register, value in ((ax12a.CW_LIMIT, 0), (ax12a.CCW_LIMIT, 0), (ax12a.MOVING_SPEED, speed)):
        bench.bus.receive(write(servo.servo_id, register, value), bench.now_ns)
    return servo


@pytest.mark.parametrize(("speed", "sign"), [(400, 1.0), (1024 + 400, -1.0)])
def test_wheel_turns_through_the_dead_zone_where_readings_are_erratic(arm: ArmConfig, speed: int, sign: float) -> None:
    bench = Bench(arm, spec=ArmSpec(stop_deg=4000.0, noise_tick=0.0))
    servo = wheel(bench, 5, speed)
    shaft, seen = [], []
    for _ in range(400):
        bench.wait(0.01)
        shaft.append(servo.position_tick)
        seen.append(servo.get(ax12a.PRESENT_POSITION))
    assert sign * (shaft[-1] - shaft[0]) > 1200.0
    turned = np.array(shaft) % (2.0 * math.pi / ax12a.TICK_RAD)
    well = (turned > 5.0) & (turned < 1018.0)
    assert np.abs(np.array(seen)[well] - turned[well]).max() <= 0.51
    assert np.std(np.array(seen)[turned > 1040.0]) > 100.0
    assert servo.get(ax12a.MOVING) == 1
    assert bench.arm.servos[5].torque_enabled


def test_wheel_at_speed_zero_stands_still(bench: Bench) -> None:
    servo = wheel(bench, 5, 0)
    before = servo.position_tick
    bench.wait(2.0)
    assert servo.position_tick == before
    assert servo.get(ax12a.MOVING) == 0
