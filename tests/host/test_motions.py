"""Runs, moves and jogs: checked before they begin, recorded, measured, stopped, paused."""

import asyncio
import contextlib
import math
from collections.abc import Callable, Coroutine
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armctl.config import validate
from armctl.dynamixel import ax12a
from armctl.errors import ConfigError, IllegalTransition, LogError
from armctl.files import load_arm
from armctl.host import host as host_module
from armctl.host.motions import move, move_trajectory, play, run
from armctl.host.watch import refuse_at_limit
from armctl.kinematics import robots
from armctl.kinematics.chain import forward_kinematics, tool_position
from armctl.kinematics.inverse import refine_poses
from armctl.kinematics.target import point_target
from armctl.kinematics.transform import FloatArray, rpy_from_matrix
from armctl.messages import Hold, Mode, Run
from armctl.trajectory.approach import approach_trajectory
from armctl.trajectory.playback import PlayRequest, TaughtMotion
from armctl.trajectory.preflight import DrivenArm, preflight_motion
from armctl.trajectory.target import MoveRequest, postures_at
from tests.control.ideal_arm import PERIOD_S
from tests.host.bench import Bench
from tests.host.doubles import NamedClient, refused

# ------------------------------------------------------------------------------------------------- run


async def test_a_run_is_recorded_and_compared_with_its_line(bench: Bench) -> None:
    plan = bench.plan()
    chain = bench.arm.robot.chain
    start, end = tool_position(chain, np.array(plan.waypoints_rad)[:, : chain.n])
    plan = bench.plan(from_m=tuple(start.tolist()), to_m=tuple(end.tolist()))
    result = await bench.served(run(bench.host, bench.anna, plan))
    assert result["recording"].startswith("run-line-via-0-")
    assert list(bench.recorder.takes) == [result["recording"]]
    # A servo resolves 0.29 deg, 1 to 2 mm at the tool; straight in joint space is not straight in space.
    assert 0.0 < result["mean_error_mm"] < result["max_error_mm"] < 10.0
    assert result["duration_s"] == pytest.approx(plan.duration_s, abs=2 * PERIOD_S)
    assert result["end_ns"] - result["begin_ns"] == pytest.approx(result["duration_s"] * 1e9)
    assert (result["predicted_mean_error_mm"], result["predicted_max_error_mm"]) == (1.5, 2.5)
    ended_ns = bench.recorder.records[-1].inputs.sample.time_ns
    assert ended_ns - result["end_ns"] >= host_module.TAIL_NS, "the recording goes on a little after the motion"


async def test_who_asked_for_a_run_hears_of_lost_replies_while_it_lasts(bench: Bench) -> None:
    running = asyncio.ensure_future(run(bench.host, bench.anna, bench.plan(duration_s=4.0)))
    await bench.until(lambda: bench.arm.mode() is Mode.MOVING)
    while not bench.anna.told:
        bench.arm.silent = set() if bench.arm.silent else {3}
        bench.tick()
    assert not running.done()
    [(method, params)] = bench.anna.told
    assert (method, params["warning"]) == ("progress", "SLOWED")
    assert "replies were lost" in str(params["text"])
    bench.arm.silent = set()
    await bench.served(running)
    assert len(bench.anna.told) == 1


@pytest.mark.parametrize("duration_s", [401.0, 600.0])
async def test_long_motions_reach_the_control_step_that_accepts_them(bench: Bench, duration_s: float) -> None:
    there = (bench.arm.positions_rad()[0] + 0.2, *bench.arm.positions_rad()[1:])
    for asked in (
        move(bench.host, bench.anna, MoveRequest(joints_rad=there, duration_s=duration_s)),
        run(bench.host, bench.anna, bench.plan(duration_s=duration_s, via=0)),
    ):
        running = asyncio.ensure_future(asked)
        await bench.until(lambda: bench.arm.mode() is Mode.MOVING)
        assert isinstance(command := bench.control.commands[-1], Run)
        assert command.trajectory.duration_s >= duration_s
        await bench.served(bench.host.stop())
        with refused("STOPPED"):
            await bench.served(running)


async def test_a_refused_preflight_tells_every_reason_and_moves_nothing(bench: Bench) -> None:
    error = await bench.refused(run(bench.host, bench.anna, bench.plan(arm_id="other", duration_s=0.05)), "PREFLIGHT")
    assert len(error.reasons) > 1
    assert "other" in error.reasons[0]
    assert not any(isinstance(command, Run) for command in bench.control.commands)
    assert not bench.recorder.takes


async def test_a_plan_outside_the_limits_is_refused_as_such(bench: Bench) -> None:
    start = bench.arm.positions_rad()
    far = (math.radians(149.0), *start[1:])
    await bench.refused(run(bench.host, bench.anna, bench.plan(waypoints_rad=(start, far), duration_s=20.0)), "LIMIT")


@pytest.mark.parametrize("mode", [Mode.OFF, Mode.TEACHING, Mode.FAULTED, Mode.ENERGISING, Mode.MOVING])
async def test_a_run_needs_a_holding_arm_and_says_how_to_get_there(limp: Bench, mode: Mode) -> None:
    record = limp.control.tick()
    limp.host.receive(replace(record, outputs=replace(record.outputs, mode=mode)))
    with pytest.raises(IllegalTransition, match=mode.value):
        await run(limp.host, limp.anna, limp.plan())
    assert not limp.recorder.takes


async def test_a_run_that_cannot_be_recorded_does_not_start(bench: Bench) -> None:
    def full() -> None:
        raise LogError("the disk is full")

    bench.recorder.on_begin = full
    with pytest.raises(LogError):
        await bench.served(run(bench.host, bench.anna, bench.plan()))
    assert not any(isinstance(command, Run) for command in bench.control.commands)
    assert bench.host.status()["recording"] is None


async def run_it(bench: Bench) -> dict[str, Any]:
    return await run(bench.host, bench.anna, bench.plan())


async def move_it(bench: Bench) -> dict[str, Any]:
    return await move(bench.host, bench.anna, lowered(bench))


async def run_and_park_it(bench: Bench) -> dict[str, Any]:
    await run_it(bench)  # away from the rest pose
    return await bench.host.command(bench.anna, "park")


@pytest.mark.parametrize(
    ("work", "mode"), [(run_it, Mode.MOVING), (move_it, Mode.MOVING), (run_and_park_it, Mode.PARKING)]
)
async def test_a_client_that_leaves_during_its_motion_stops_the_arm(
    bench: Bench, work: Callable[[Bench], Coroutine[Any, Any, dict[str, Any]]], mode: Mode
) -> None:
    task = asyncio.create_task(work(bench))
    await bench.until(lambda: bench.arm.mode() is mode)
    bench.host.client_gone(bench.ben)
    assert not any(isinstance(command, Hold) for command in bench.control.commands)
    bench.host.client_gone(bench.anna)
    await bench.refused(task, "STOPPED")
    await bench.until(lambda: bench.arm.mode() is Mode.HOLDING)
    assert any("LEASE_LOST" in note for note in bench.recorder.notes)


async def test_a_client_that_leaves_before_its_run_begins_moves_nothing(bench: Bench) -> None:
    bench.recorder.on_begin = lambda: bench.host.client_gone(bench.anna)
    await bench.refused(run(bench.host, bench.anna, bench.plan()), "LEASE_LOST")
    assert not any(isinstance(command, Run) for command in bench.control.commands)


async def test_a_run_whose_marks_were_lost_is_not_given_a_figure(bench: Bench) -> None:
    task = await bench.running()
    while not task.done():
        await asyncio.sleep(0)
        record = bench.control.tick()
        kept = tuple(event for event in record.outputs.events if event.code != "PLAN_BEGIN")
        bench.host.receive(replace(record, outputs=replace(record.outputs, events=kept)))
    with refused("RECORDS_LOST"):
        task.result()


async def test_a_run_that_does_not_end_is_stopped(bench: Bench) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(host_module, "STUCK_S", -1e6)
        with refused("NO_ANSWER"):
            await run(bench.host, bench.anna, bench.plan())
    await bench.until(lambda: any(isinstance(command, Hold) for command in bench.control.commands))


# ------------------------------------------------------------------------------------------------ move


def lowered(bench: Bench) -> MoveRequest:
    """From where the arm is, one joint turned."""
    return MoveRequest(joints_rad=tuple(q - 0.3 * (i == 1) for i, q in enumerate(bench.arm.positions_rad())))


async def test_a_move_to_joints_is_recorded_and_measured(bench: Bench) -> None:
    goal = lowered(bench).joints_rad
    result = await bench.served(move(bench.host, bench.anna, lowered(bench)))
    assert list(bench.recorder.takes) == [result["recording"]]
    assert result["recording"].startswith("run-move-")
    assert 0.0 <= result["position_error_mm"] < 2.0
    assert bench.arm.positions_rad() == pytest.approx(goal, abs=ax12a.TICK_RAD)
    assert result["target_rad"] == pytest.approx(goal)
    assert result["position_m"] == pytest.approx(
        tool_position(bench.arm.robot.chain, np.array(bench.arm.positions_rad()[:5])).tolist()
    )


async def test_a_move_to_a_point_takes_the_tool_there(bench: Bench) -> None:
    point = (0.15, 0.05, 0.2)
    result = await bench.served(move(bench.host, bench.anna, MoveRequest(point_m=point)))
    assert result["position_m"] == pytest.approx(point, abs=0.004)
    assert math.dist(result["position_m"], point) == pytest.approx(result["position_error_mm"] / 1e3, abs=1e-5)


async def test_a_point_out_of_reach_is_refused_with_the_nearest_distance(bench: Bench) -> None:
    error = await bench.refused(move(bench.host, bench.anna, MoveRequest(point_m=(0.9, 0.0, 0.2))), "UNREACHABLE")
    assert "no nearer than" in str(error)
    assert not bench.recorder.takes


async def test_a_move_is_refused_with_every_reason_before_it_starts(bench: Bench) -> None:
    here = bench.arm.positions_rad()
    fast = MoveRequest(joints_rad=(here[0] + 1.0, here[1] - 1.0, *here[2:]), duration_s=0.3)
    error = await bench.refused(move(bench.host, bench.anna, fast), "PREFLIGHT")
    assert len(error.reasons) > 2
    await bench.refused(move(bench.host, bench.anna, MoveRequest(joints_rad=(2.6, *here[1:]))), "LIMIT")
    await bench.refused(move(bench.host, bench.anna, MoveRequest(joints_rad=here[:5])), "LIMIT")
    assert not any(isinstance(command, Run) for command in bench.control.commands)


async def test_a_stop_while_what_is_to_be_played_is_loaded_begins_nothing(bench: Bench) -> None:
    """Before, nobody commanded meanwhile, so that a stop stopped nothing, and the whole motion followed."""
    here = bench.arm.positions_rad()
    rows = [tuple(q + 0.1 * k * (joint == 0) for joint, q in enumerate(here)) for k in range(4)]
    taught = TaughtMotion(joints=bench.host.arm.joint_names, time_s=(0.0, 1.0, 2.0, 3.0), positions_rad=tuple(rows))
    stops: list[asyncio.Future[dict[str, Any]]] = []

    def loaded() -> TaughtMotion:
        stops.append(asyncio.ensure_future(bench.host.stop()))
        return taught

    await bench.refused(play(bench.host, bench.anna, loaded, PlayRequest(name="taught")), "STOPPED")
    assert await bench.served(stops[0]) == {"state": "holding"}
    assert not any(isinstance(command, Run) for command in bench.control.commands)


# --------------------------------------------------------------------------------- pause, resume, rate


async def test_anyone_may_pause_a_run_and_its_own_user_goes_on(bench: Bench) -> None:
    task = await bench.running()
    host = bench.host
    other, same = NamedClient("carl", uid=1001), NamedClient("anna's other terminal")
    assert await bench.served(host.pause()) == {"state": "moving"}
    bench.ticks(20)
    before = host.status()
    assert before["rate"] == 0.0
    bench.tick()
    assert host.status()["progress"] == before["progress"]
    await bench.refused(host.resume(other), "BUSY")
    await bench.refused(host.rate(other, 0.5), "BUSY")
    assert await bench.served(host.rate(same, 0.5)) == {"state": "moving", "rate": 0.5}
    assert await bench.served(host.resume(same)) == {"state": "moving"}
    assert host.status()["rate"] == 0.5
    assert (await bench.served(task))["recording"]


async def test_a_paused_run_waits_as_long_as_it_takes(bench: Bench) -> None:
    task = await bench.running()
    await bench.served(bench.host.pause())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(host_module, "STUCK_S", 0.0)
        for _ in range(50):
            bench.tick()
            await asyncio.sleep(0)
        assert not task.done()
    await bench.served(bench.host.resume(bench.anna))
    assert (await bench.served(task))["recording"]


# ------------------------------------------------------------------------------------------------- jog


UP = (0.0, 0.0, 0.05)
TURN = (0.2, 0.0, 0.0, 0.0, 0.0, 0.0)


async def test_a_jog_is_one_client_s_until_it_ends(bench: Bench) -> None:
    host, anna, ben = bench.host, bench.anna, bench.ben
    assert await bench.beat(anna, turn=TURN, begin=True) == {"state": "jogging"}
    assert host.status()["commander"] == "anna: jogging"
    for work in (bench.beat(ben, turn=TURN), run(host, ben, bench.plan()), run(host, anna, bench.plan())):
        with refused("BUSY"):
            await work
    assert await bench.beat(anna, turn=TURN) == {"state": "jogging"}
    bench.ticks(7)
    assert (host.status()["state"], host.status()["commander"]) == ("holding", None)
    with pytest.raises(IllegalTransition, match="begin another"):
        await bench.beat(anna, turn=TURN)
    assert await bench.beat(ben, turn=TURN, begin=True) == {"state": "jogging"}


async def test_anyone_may_stop_a_jog_and_it_does_not_go_on(bench: Bench) -> None:
    await bench.beat(bench.anna, lead=UP, begin=True)
    assert await bench.served(bench.host.stop()) == {"state": "holding"}
    with pytest.raises(IllegalTransition, match="begin another"):
        await bench.beat(bench.anna, lead=UP)


def goes_no_farther(bench: Bench, goals: int) -> None:
    """After so many goals the arm was called back once, and no joint went on."""
    [called_back] = bench.arm.goals[goals:]
    before, last = bench.arm.goals[goals - 2 : goals]
    for a, b, back in zip(before, last, called_back, strict=True):
        assert (back - b) * (b - a) <= 0
        assert abs(back - b) <= abs(b - a)


async def test_a_client_that_leaves_during_its_jog_leaves_a_holding_arm(bench: Bench) -> None:
    await bench.beat(bench.anna, lead=UP, begin=True)
    bench.host.client_gone(bench.anna)
    assert bench.host.status()["commander"] is None
    goals = len(bench.arm.goals)
    await bench.until(lambda: bench.arm.mode() is Mode.HOLDING)
    goes_no_farther(bench, goals)


async def test_a_heartbeat_that_is_under_way_when_its_client_leaves_moves_nothing(bench: Bench) -> None:
    await bench.beat(bench.anna, lead=UP, begin=True)
    goals = len(bench.arm.goals)
    under_way = asyncio.ensure_future(bench.host.jog(bench.anna, (), UP, False))
    await asyncio.sleep(0)
    bench.host.client_gone(bench.anna)
    assert bench.host.status()["commander"] is None
    await bench.until(lambda: bench.arm.mode() is Mode.HOLDING)
    await under_way
    goes_no_farther(bench, goals)


async def beats(bench: Bench, count: int, turn: tuple[float, ...]) -> None:
    """A jog of the joints, so many heartbeats long."""
    for k in range(count):
        await bench.beat(bench.anna, turn=turn, begin=k == 0)


async def test_a_jog_that_leads_links_into_each_other_is_refused(bench: Bench) -> None:
    with refused("PREFLIGHT", "would touch"):
        await beats(bench, 100, (0.0, 0.0, 0.0, 0.35, 0.35, 0.0))
    goals = len(bench.arm.goals)
    bench.ticks(7)
    goes_no_farther(bench, goals)  # the arm stops, as where heartbeats cease
    assert bench.arm.mode() is Mode.HOLDING


async def test_a_jog_that_is_led_to_the_floor_says_why_it_goes_no_farther(bench: Bench) -> None:
    """Before, it was accepted for as long as somebody asked, and the arm stood still."""
    down, up = (0.0, -0.35, 0.0, 0.0, 0.0, 0.0), (0.0, 0.35, 0.0, 0.0, 0.0, 0.0)
    await beats(bench, 40, (0.0, 0.0, 0.35, 0.0, 0.0, 0.0))
    await bench.until(lambda: bench.arm.mode() is Mode.HOLDING)
    with refused("PREFLIGHT", "the arm is at the floor, and would go below it; jog another way"):
        await beats(bench, 400, down)
    await bench.until(lambda: bench.arm.mode() is Mode.HOLDING)
    await bench.beat(bench.anna, turn=up, begin=True)
    assert bench.arm.mode() is Mode.JOGGING


async def test_a_jog_that_comes_to_a_limit_or_would_begin_there_names_the_joint(bench: Bench) -> None:
    """Before, it was accepted, and the arm stood still."""

    with refused("LIMIT", r"base stands at its limit, 145\.0 deg, and would have to turn past it; jog another way"):
        await beats(bench, 120, (0.35, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert bench.arm.mode() is Mode.JOGGING, "it comes to rest as where heartbeats cease"
    await bench.until(lambda: bench.arm.mode() is Mode.HOLDING)
    goals = len(bench.arm.goals)
    with refused("LIMIT", r"base stands at its limit, 145\.0 deg, and would have to turn past it; jog another way"):
        await bench.beat(bench.anna, turn=TURN, begin=True)
    bench.ticks(3)
    assert bench.arm.mode() is Mode.HOLDING
    assert len(bench.arm.goals) == goals
    # Another joint goes on, and this one goes back.
    for turn in ((0.2, 0.0, 0.0, 0.0, 0.0, 0.2), (-0.2, 0.0, 0.0, 0.0, 0.0, 0.0)):
        assert await bench.beat(bench.anna, turn=turn, begin=True) == {"state": "jogging"}
        await bench.until(lambda: bench.arm.mode() is Mode.HOLDING)


@pytest.mark.parametrize(("q_deg", "v_rad_s", "stands"), [
    (144.9, 0.2, True), (144.9, -0.2, False), (143.0, 0.2, False), (-147.0, -0.2, True),
    (147.0, 0.2, True),  # limp, it was led beyond
    (147.0, 0.0, False), (144.9, 0.01, True), (144.4, 0.01, False),
])  # fmt: skip
def test_a_joint_stands_at_its_limit_also_beyond_it(q_deg: float, v_rad_s: float, stands: bool) -> None:
    arm = load_arm("ax12-line")
    q, v = [math.radians(q_deg), *REST_RAD[1:]], [v_rad_s, *[0.0] * (len(REST_RAD) - 1)]
    with refused("LIMIT", "base stands at its limit") if stands else contextlib.nullcontext():
        refuse_at_limit(q, v, arm)
    refuse_at_limit(q, [v_rad_s, *[0.0] * (len(v) - 2), 0.2], arm)  # the other joint goes on


async def test_a_tool_is_led_on_by_the_others_where_a_joint_stands_at_its_limit(bench: Bench) -> None:
    """Before, all of them waited for that one, and a third of all places were dead ends."""
    with refused("LIMIT", r"shoulder stands at its limit, 160\.0 deg"):
        await beats(bench, 20, (0.0, 0.2, 0.0, 0.0, 0.0, 0.0))
    await bench.until(lambda: bench.arm.mode() is Mode.HOLDING)
    begin = np.array(bench.host.status()["tool"]["position_m"])
    for k in range(20):
        await bench.beat(bench.anna, lead=(-0.03, 0.0, 0.0), begin=k == 0)
    status = bench.host.status()
    moved = np.array(status["tool"]["position_m"]) - begin
    assert moved[0] < -0.04
    assert np.abs(moved[1:]).max() < 0.006  # a tick of each of five joints
    assert status["joints"][1]["position_rad"] == pytest.approx(math.radians(160.0), abs=ax12a.TICK_RAD)


async def test_a_tool_that_is_led_to_the_edge_of_its_reach_is_told_where_and_what_to_do(bench: Bench) -> None:
    """Before, it was accepted for as long as somebody asked, and the tool slid aside."""
    off = []
    where = r"from \(0\.\d+, -?0\.000, 0\.\d+\) m"
    with refused("UNREACHABLE", f"{where} the tool can go no farther that way .* jog another way, or turn a joint"):
        for k in range(400):
            await bench.beat(bench.anna, lead=(0.05, 0.0, 0.0), begin=k == 0)
            off.append(bench.host.status()["tool"]["position_m"])
    x, y, z = np.array(off).T
    assert x[-1] - x[0] > 0.1
    assert max(abs(y).max(), abs(z - z[0]).max()) < 0.012  # a tick of each of five joints is 6 mm
    await bench.until(lambda: bench.arm.mode() is Mode.HOLDING)
    assert await bench.beat(bench.anna, lead=(-0.05, 0.0, 0.0), begin=True) == {"state": "jogging"}


def way(request: MoveRequest, q_now: list[float]) -> list[float]:
    """Where a move of the paper's arm ends."""
    arm = load_arm("ax12-line")
    made = move_trajectory(request, q_now, DrivenArm(arm, robots.of(arm), PERIOD_S))
    return list(made.positions_rad[-1])


REST_RAD = [joint.rest_rad for joint in load_arm("ax12-line").joints]


def test_a_point_whose_nearest_posture_must_not_be_gone_to_is_reached_in_another() -> None:
    """Of 40 points over the table, each from a pose of its own; once a nearest posture that touches was refused."""
    arm, rng = load_arm("ax12-line"), np.random.default_rng(2)
    on, others = DrivenArm(arm, robots.of(arm), PERIOD_S), 0
    low, high = np.array([joint.limits_rad for joint in arm.joints]).T
    for point in rng.uniform((0.05, -0.2, 0.03), (0.25, 0.2, 0.3), (40, 3)):
        here = rng.uniform(low, high).tolist()
        postures = postures_at(point_target(point), here, on, nearest=True)
        allowed = []
        for goal in postures:
            motion = approach_trajectory(here, goal, on, "move")
            if not preflight_motion(np.array(motion.positions_rad), on, start_rad=here):
                allowed.append(goal)
        request = MoveRequest(point_m=tuple(point.tolist()))
        if not allowed:
            with refused("PREFLIGHT"):
                way(request, here)
            continue
        assert way(request, here) == pytest.approx(allowed[0])
        others += allowed[0] != postures[0]
    assert others > 0


@pytest.mark.parametrize("name", ["crane-plus-v2", "ax12-line", "crustcrawler"])
def test_no_free_posture_found_anywhere_is_nearer_than_the_one_that_is_moved_to(name: str) -> None:
    """An arm with a joint to spare reaches a point in a family of postures; any of them was taken before."""
    arm, rng = load_arm(name), np.random.default_rng(8)
    robot, n = robots.of(arm), robots.of(arm).chain.n
    on, rest = DrivenArm(arm, robot, PERIOD_S), np.array([joint.rest_rad for joint in arm.joints])
    limits = np.array([joint.limits_rad for joint in arm.joints[:n]])

    def motion(here: FloatArray, goal: FloatArray) -> FloatArray:
        return np.array(approach_trajectory(here.tolist(), [*goal, *rest[n:]], on, "move").positions_rad)

    judged = 0
    while judged < 8:
        here, goal = np.tile(rest, (2, 1))
        here[:n], goal[:n] = rng.uniform(limits[:, 0], limits[:, 1], (2, n))
        if preflight_motion(motion(here, goal[:n]), on):
            continue
        judged += 1
        point = tool_position(robot.chain, goal[:n])
        end = np.array(move_trajectory(MoveRequest(point_m=tuple(point.tolist())), here.tolist(), on).positions_rad[-1])
        far = np.abs(end - here).max()
        starts = here[:n] + np.outer(np.linspace(0.0, 1.0, 100), np.ones(n)) * rng.uniform(-far, far, (100, n))
        T = np.broadcast_to(point_target(point).T, (len(starts) + 1, 4, 4))
        q = refine_poses(robot.chain, T, np.vstack([goal[:n], starts]), limits, turned=False)
        ways = np.abs(q - here[:n]).max(axis=1) + 10.0 * (
            np.abs(tool_position(robot.chain, q) - point).max(axis=1) > 1e-6
        )
        for k in np.flatnonzero(ways < far - 0.03):
            assert preflight_motion(motion(here, q[k]), on), f"{name}: {np.degrees([far, ways[k]])} deg"


@pytest.mark.parametrize("name", ["crane-plus-v2", "ax12-line", "crustcrawler", "transfer-6dof"])
def test_an_arm_that_is_where_it_is_to_move_stays_as_it_is(name: str) -> None:
    arm, rng = load_arm(name), np.random.default_rng(9)
    robot, limits = robots.of(arm), np.array([joint.limits_rad for joint in arm.joints])
    for here in rng.uniform(limits[:, 0], limits[:, 1], (20, len(limits))):
        on = DrivenArm(arm, robot, PERIOD_S)
        if not preflight_motion(np.array([here, here]), on):
            T = forward_kinematics(robot.chain, here[: robot.chain.n])
            pose = (*T[:3, 3].tolist(), *rpy_from_matrix(T[:3, :3]))
            for request in (MoveRequest(point_m=pose[:3]), MoveRequest(pose=pose)):
                made = move_trajectory(request, here.tolist(), on)
                assert np.abs(made.positions_rad[-1] - here).max() < 1e-5


def test_a_point_is_moved_to_with_the_tool_pointing_where_it_is_wanted() -> None:
    arm = load_arm("ax12-line")
    chain, here = robots.of(arm).chain, np.radians((0.0, 87.0, -65.0, -64.0, -33.0, 20.0)).tolist()
    for direction in ((0.0, 0.0, -2.0), (1.0, 0.0, -1.0)):
        end = way(MoveRequest(point_m=(0.18, 0.0, 0.08), direction=direction), here)
        T = forward_kinematics(chain, np.array(end[: chain.n]))
        np.testing.assert_allclose(T[:3, 3], (0.18, 0.0, 0.08), atol=2e-6)
        np.testing.assert_allclose(T[:3, 0], np.array(direction) / np.linalg.norm(direction), atol=2e-5)
    with refused("UNREACHABLE", "deg within the joint limits"):
        way(MoveRequest(point_m=(0.18, 0.0, 0.08), direction=(0.0, 1.0, 0.0)), here)


@pytest.mark.parametrize(("asked", "says"), [
    ({"pose": (0.1, 0.0, 0.1, 0.0, 0.0, 0.0), "direction": (0, 0, -1)}, "direction: it goes with point_m alone"),
    ({"point_m": (0.1, 0.0, 0.1), "direction": (0, 0, 0)}, "0,0,0 points nowhere; give x,y,z in the base frame"),
])  # fmt: skip
def test_a_direction_that_is_none_or_of_no_point_is_refused(asked: dict[str, object], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        validate(MoveRequest, asked, "move")


def test_another_posture_can_be_asked_for_and_one_too_many_lists_them() -> None:
    here = np.radians((0.0, 87.0, -65.0, -64.0, -33.0, 20.0)).tolist()
    first, second = (way(MoveRequest(point_m=(0.18, 0.0, 0.15), posture=k), here) for k in (1, 2))
    assert first == way(MoveRequest(point_m=(0.18, 0.0, 0.15)), here)
    away = [float(np.abs(np.subtract(end, here)).max()) for end in (first, second)]
    assert away[0] < away[1]
    with refused("POSTURE") as caught:
        way(MoveRequest(point_m=(0.18, 0.0, 0.15), posture=13), here)
    told = caught.value.reasons
    assert told[0] == "of posture 13 there is none; these can be gone to"
    assert told[1].startswith("posture 1: ")
    assert len(told) > 2
