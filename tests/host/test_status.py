"""The snapshot every client sees."""

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armctl.clock import NS_PER_S
from armctl.dynamixel import ax12a
from armctl.host.host import STALE_NS
from armctl.kinematics.chain import forward_kinematics
from armctl.kinematics.transform import rpy_from_matrix
from armctl.messages import Mode
from tests.guard.kept import load
from tests.host.bench import Bench

# Keys of the snapshot, as the guard keeps them.
CONTRACT = load("commands.json")["on an arm"]["status"]["answer"]
JOINT_KEYS = CONTRACT["joints"][0].keys()
FAULT_KEYS = {"code", "servo_id", "since_s", "arm", "next", "text", "follows"}


async def test_the_snapshot_has_the_keys_of_the_contract_before_and_after_the_first_tick(fresh: Bench) -> None:
    for state in ("starting", "off"):
        status = fresh.host.status()
        json.dumps(status, allow_nan=False)
        assert status.keys() == CONTRACT.keys()
        assert status["state"] == state
        assert status["fault"] is None
        assert all(joint.keys() == JOINT_KEYS for joint in status["joints"])
        assert status["cycle"].keys() == CONTRACT["cycle"].keys()
        fresh.tick()
    assert status["arm_id"] == "ax12-line"
    assert status["pids"]["control"] == 4242
    assert status["tool"].keys() == CONTRACT["tool"].keys()
    assert status["joints"][1]["position_rad"] == pytest.approx(math.radians(158.0), abs=ax12a.TICK_RAD)
    assert status["cycle"]["bus_us_p50"] == status["cycle"]["bus_us_p99"] == 2500


async def test_the_tool_is_given_in_roll_pitch_yaw(limp: Bench) -> None:
    tool = limp.host.status()["tool"]
    T = forward_kinematics(limp.arm.robot.chain, _positions(limp))
    assert tool["position_m"] == pytest.approx(T[:3, 3].tolist())
    assert tool["rpy_rad"] == pytest.approx(rpy_from_matrix(T[:3, :3]), abs=1e-9)


def _positions(bench: Bench) -> Any:
    return np.array(bench.arm.positions_rad()[: bench.arm.robot.chain.n])


async def test_where_joints_are_commanded_to_be_is_told_once_armctl_has_a_say_in_it(fresh: Bench) -> None:
    assert [joint["wanted_rad"] for joint in fresh.host.status()["joints"]] == [None] * 6
    fresh.tick()
    assert [joint["wanted_rad"] for joint in fresh.host.status()["joints"]] == [None] * 6
    bench = await fresh.holding()
    wanted_rad = [joint["wanted_rad"] for joint in bench.host.status()["joints"]]
    assert wanted_rad == pytest.approx(bench.arm.positions_rad(), abs=2 * ax12a.TICK_RAD)


async def test_ages_grow_when_no_tick_comes(limp: Bench) -> None:
    before = limp.host.status()
    limp.clock.advance_ns(700_000_000)
    after = limp.host.status()
    assert after["age_s"] - before["age_s"] == pytest.approx(0.7)
    for old, new in zip(before["joints"], after["joints"], strict=True):
        assert new["age_s"] - old["age_s"] == pytest.approx(0.7)


async def test_a_joint_that_never_answered_has_no_values(fresh: Bench) -> None:
    fresh.arm.silent = {2}
    fresh.tick()
    joint = fresh.host.status()["joints"][2]
    assert joint["name"] == "elbow"
    assert all(joint[key] is None for key in JOINT_KEYS - {"name", "servo_id", "limits_rad"})
    assert fresh.host.status()["tool"] is None


async def test_a_fault_tells_code_servo_time_what_the_arm_does_and_what_to_type(limp: Bench) -> None:
    limp.arm.silent = {1}
    await limp.until(lambda: limp.arm.mode() is Mode.FAULTED)
    limp.clock.advance_ns(2_000_000_000)
    fault = limp.host.status()["fault"]
    assert fault.keys() == FAULT_KEYS
    assert (fault["code"], fault["servo_id"]) == ("SERVO_SILENT", 2)
    assert fault["since_s"] == pytest.approx(2.0, abs=0.01)
    assert "armctl clear" in fault["next"]


async def test_once_a_port_is_back_its_fault_tells_what_the_arm_does(limp: Bench) -> None:
    def doing() -> tuple[str, str]:
        limp.tick()
        fault = limp.host.status()["fault"]
        assert "armctl clear" in fault["next"]
        return fault["code"], fault["arm"]

    out_of_reach = "out of reach; every servo keeps the last goal it was given, with the torque it had"
    limp.arm.port_open = False
    assert doing() == ("PORT_GONE", out_of_reach)
    limp.arm.port_open, limp.arm.silent = True, set(range(6))
    assert doing() == ("PORT_GONE", out_of_reach)
    limp.control.connect_again()
    limp.arm.silent = set()
    assert doing() == ("PORT_GONE", "limp")


async def test_what_an_arm_does_is_not_told_from_a_tick_long_ago(limp: Bench) -> None:
    limp.clock.advance_ns(round(limp.host.period_s * NS_PER_S) + STALE_NS - 1_000_000)
    assert limp.host.status()["state"] == "off"
    limp.clock.advance_ns(2_000_000)
    assert limp.host.status()["state"] == "stalled"
    limp.tick()
    assert limp.host.status()["state"] == "off"


async def test_a_dead_control_process_is_a_fault_until_the_next_one_ticks(limp: Bench) -> None:
    limp.host.control_lost()
    status = limp.host.status()
    assert (status["state"], status["fault"]["code"]) == ("restarting", "RESTARTED")
    assert status["fault"].keys() == FAULT_KEYS
    assert status["pids"]["control"] is None
    limp.attach()
    limp.tick()
    assert limp.host.status()["fault"] is None
    assert limp.host.status()["state"] == "off"


async def test_the_cycle_figures_cover_the_last_600_ticks(fresh: Bench) -> None:
    record = fresh.tick(lateness_us=90_000)
    assert fresh.host.status()["cycle"]["bus_us"] == record.inputs.sample.bus_us
    assert fresh.host.status()["cycle"]["overruns"] == 1
    assert fresh.host.status()["cycle"]["lateness_us_p99"] == 90_000
    for _ in range(600):
        fresh.host.receive(record := replace(record, lateness_us=5))
    assert fresh.host.status()["cycle"]["overruns"] == 0
    assert fresh.host.status()["cycle"]["lateness_us_p99"] == 5


async def test_ticks_the_host_was_too_slow_for_are_counted(limp: Bench) -> None:
    limp.tick(dropped=3)
    limp.tick(dropped=2)
    limp.recorder.dropped_records = 2
    told = {"path": "/logs/log.mcap.part", "problem": "", "dropped": 5, "recorder_dropped": 2}
    assert limp.host.status()["log"] == told
    limp.recorder.log_path = None
    assert limp.host.log()["path"] is None
