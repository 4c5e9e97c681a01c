"""Reaching and gripping through the host, on simulated servos in virtual time; judged by the simulator's truth."""

import asyncio
import math
from contextlib import AbstractAsyncContextManager
from pathlib import Path

import numpy as np
import pytest

from armctl.host.motions import move
from armctl.host.reach import grip, reach
from armctl.kinematics.chain import tool_position
from armctl.messages import Mode, TickRecord
from armctl.trajectory.grasp import GripRequest, Method, ReachRequest
from armctl.trajectory.target import MoveRequest
from tests.host.doubles import refused
from tests.host.simulated import SimulatedBench, on_arm

POINT = (0.20, 0.05, 0.06)
AWAY_DEG = {
    "ax12-line": (20.0, 120.0, -100.0, 40.0, 10.0, 30.0),
    "xiang-6dof": (20.0, 120.0, -100.0, -40.0, 10.0, 30.0),
    "lanzhou-4dof": (20.0, 60.0, 20.0, 10.0),
    "transfer-6dof": (20.0, -70.0, 20.0, 10.0, 10.0, 10.0),
}
SAG_DEG = 6.0


@pytest.fixture
def bench() -> AbstractAsyncContextManager[SimulatedBench]:
    """The arm with a gripper."""
    return on_arm("xiang-6dof")


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", AWAY_DEG)
async def test_every_paper_s_arm_takes_torque_moves_out_and_back_and_parks(name: str, seed: int) -> None:
    async with on_arm(name, seed) as bench:
        rest_deg = [joint.rest_deg for joint in bench.arm.joints]
        assert len(bench.simulated.servos) == len(bench.arm.joints) == len(AWAY_DEG[name])
        for goal_deg in (AWAY_DEG[name], rest_deg):
            there = MoveRequest(joints_rad=tuple(np.radians(goal_deg).tolist()))
            await bench.served(move(bench.host, bench.anna, there))
            assert bench.true_deg() == pytest.approx(goal_deg, abs=SAG_DEG)
        assert await bench.served(bench.host.command(bench.anna, "park")) == {"state": "off"}
        assert bench.true_deg() == pytest.approx(rest_deg, abs=4.0)
        assert not any(servo.torque_enabled for servo in bench.simulated.servos)
        assert Mode.FAULTED not in bench.modes


@pytest.mark.parametrize(
    ("name", "point"),
    [("xiang-6dof", POINT), ("ax12-line", POINT), ("lanzhou-4dof", (0.15, 0.1, -0.2)), ("transfer-6dof", POINT)],
)
async def test_the_tool_comes_to_the_point_and_stays_there(name: str, point: tuple[float, float, float]) -> None:
    async with on_arm(name) as bench:
        result = await bench.served(reach(bench.host, bench.anna, ReachRequest(point_m=point)))
        assert result["position_error_mm"] < 4.0
        assert bench.off_mm(point) < 4.0
        n = bench.robot.chain.n
        assert tool_position(bench.robot.chain, np.array(result["target_rad"][:n])) == pytest.approx(point, abs=1e-6)
        assert result["position_m"] == pytest.approx(
            tool_position(bench.robot.chain, np.array(result["joints_rad"][:n])).tolist()
        )
        assert result["gripped"] is None
        assert list(bench.recorder.takes) == [result["recording"]]
        assert Mode.FAULTED not in bench.modes


@pytest.mark.parametrize("method", ["numeric", "ga", "ga-improved"])
async def test_other_inverse_kinematics_get_there_too(bench: SimulatedBench, method: Method) -> None:
    result = await bench.served(reach(bench.host, bench.anna, ReachRequest(point_m=POINT, ik=method, seed=1)))
    assert result["method"] == method
    assert bench.off_mm(POINT) < 4.0


async def test_what_is_gripped_is_told_by_the_load_held_through_the_lift_and_the_log_replays(
    bench: SimulatedBench, tmp_path: Path
) -> None:
    bench.place_object(math.radians(40.0))
    result = await bench.served(reach(bench.host, bench.anna, ReachRequest(point_m=POINT, gripper="grip")))
    assert result["gripped"] is True
    assert result["gripper"]["load_ratio"] == pytest.approx(0.3, abs=0.07)
    assert result["gripper"]["position_rad"] == pytest.approx(math.radians(40.0), abs=math.radians(2.0))
    assert result["position_error_mm"] < 4.0
    assert bench.off_mm(POINT) > 25.0  # it has backed off, as a sagging arm does
    assert Mode.FAULTED not in bench.modes
    replayed = bench.replayed(tmp_path / "grip.mcap")
    assert (replayed.mismatches, replayed.first_mismatch) == (0, "")
    assert replayed.ticks > 200


async def test_a_gripper_that_closes_on_nothing_says_so(bench: SimulatedBench) -> None:
    result = await bench.served(reach(bench.host, bench.anna, ReachRequest(point_m=POINT, gripper="grip")))
    assert result["gripped"] is False
    assert result["gripper"]["position_rad"] == pytest.approx(math.radians(90.0), abs=math.radians(3.0))


async def test_what_is_lost_on_the_way_up_is_not_gripped(bench: SimulatedBench) -> None:
    take_away = bench.place_object(math.radians(40.0))
    met = bench.on_tick

    def lose(record: TickRecord) -> None:
        met(record)
        if any(event.code == "GRIPPED" for event in record.outputs.events):
            take_away()

    bench.on_tick = lose
    result = await bench.served(reach(bench.host, bench.anna, ReachRequest(point_m=POINT, gripper="grip")))
    assert result["gripped"] is False


async def test_what_was_gripped_is_let_go_elsewhere(bench: SimulatedBench) -> None:
    take_away = bench.place_object(math.radians(40.0))
    assert (await bench.served(reach(bench.host, bench.anna, ReachRequest(point_m=POINT, gripper="grip"))))["gripped"]
    there = (0.20, -0.05, 0.06)
    held = await bench.served(reach(bench.host, bench.anna, ReachRequest(point_m=there)))
    assert held["position_error_mm"] < 4.0
    assert bench.true_deg()[5] == pytest.approx(40.0, abs=2.0)
    take_away()
    result = await bench.served(reach(bench.host, bench.anna, ReachRequest(point_m=there, gripper="let_go")))
    assert result["gripped"] is False
    assert bench.true_deg()[5] == pytest.approx(0.0, abs=3.0)


@pytest.mark.parametrize(
    ("name", "asked", "code", "says"),
    [
        ("ax12-line", ReachRequest(point_m=POINT, gripper="grip"), "NO_GRIPPER", "roll.*`armctl arms` says"),
        ("xiang-6dof", ReachRequest(point_m=(0.9, 0.0, 0.1)), "UNREACHABLE", "no nearer than 484.0 mm"),
        ("xiang-6dof", ReachRequest(point_m=(0.2, 0.0, -0.05)), "PREFLIGHT", "below the floor"),
    ],
)
async def test_what_cannot_be_done_is_refused_and_nothing_moves(
    name: str, asked: ReachRequest, code: str, says: str
) -> None:
    async with on_arm(name) as bench:
        before = bench.true_deg()
        with refused(code, says):
            await bench.served(reach(bench.host, bench.anna, asked))
        assert bench.true_deg() == before
        assert not bench.recorder.takes


async def test_a_stop_ends_the_whole_reach_and_not_only_the_leg_under_way(bench: SimulatedBench) -> None:
    work = asyncio.ensure_future(bench.served(reach(bench.host, bench.anna, ReachRequest(point_m=POINT))))
    while Mode.MOVING not in bench.modes:
        await asyncio.sleep(0)
    await bench.host.stop()
    with refused("STOPPED"):
        await work
    assert bench.loop.state.mode is Mode.HOLDING
    assert len(bench.recorder.takes) == 1
    assert sum(command.kind == "run" for record in bench.recorder.records for command in record.inputs.commands) == 1


async def test_the_gripper_alone_grips_what_is_there_and_opens_again(bench: SimulatedBench) -> None:
    before = bench.true_deg()[:5]
    take_away = bench.place_object(math.radians(40.0))
    closed = await bench.served(grip(bench.host, bench.anna, GripRequest()))
    assert closed["gripped"] is True
    assert bench.true_deg()[5] == pytest.approx(40.0, abs=2.0)
    take_away()
    opened = await bench.served(grip(bench.host, bench.anna, GripRequest(grip="open")))
    assert opened["gripped"] is False
    assert bench.true_deg() == pytest.approx([*before, 0.0], abs=3.0)
    assert list(bench.recorder.takes) == [closed["recording"], opened["recording"]]
    assert (await bench.served(grip(bench.host, bench.anna, GripRequest())))["gripped"] is False
