"""Limits of time are seconds at every period: torque on, a stop, the way to rest and teaching on simulated servos."""

import numpy as np
import pytest

from armctl.control.enforce import LIMP_NS
from armctl.control.motion import STOP_S
from armctl.control.sequences import RAMP_S, VERIFY_S
from armctl.dynamixel import ax12a
from armctl.messages import (
    NS_PER_S,
    Answered,
    Command,
    Hold,
    JointTrajectory,
    Mode,
    Park,
    Run,
    Teach,
    TickRecord,
    TorqueOn,
)
from armctl.trajectory.approach import approach_duration_s
from tests.control.test_loop import ARM, Rig

PERIODS_S = (0.01, 0.1, 1.0)


def answered(rig: Rig, command: Command, within_s: float) -> float:
    """How long it takes until a request is answered, well [s]."""
    assert isinstance(command, Answered)
    begin_ns = rig.tick(command).inputs.now_ns
    while command.request_id not in rig.replies():
        assert rig.records[-1].inputs.now_ns - begin_ns < within_s * NS_PER_S
        rig.tick()
    reply = rig.replies()[command.request_id]
    assert reply.ok, reply
    return (rig.records[-1].inputs.now_ns - begin_ns) / NS_PER_S


def written_s(records: list[TickRecord], register: ax12a.Register, value: int) -> list[float]:
    """When so much was written to a register of the first servo."""
    return [
        record.inputs.now_ns / NS_PER_S
        for record in records
        for write in record.outputs.writes
        if (write.servo_id, write.address, write.value) == (1, register.address, value)
    ]


@pytest.mark.parametrize("period_s", PERIODS_S)
def test_every_limit_of_time_is_in_seconds_at_every_period(period_s: float) -> None:
    rig = Rig(period_s=period_s)
    rig.ticks(4)
    ticks_s = 2.0 * period_s + 0.06  # lost replies and the bus are not a matter of the limit
    answered(rig, TorqueOn(1), RAMP_S + 8.0 * period_s)
    (enabled_s,) = written_s(rig.records, ax12a.TORQUE_ENABLE, 1)
    full_s = written_s(rig.records, ax12a.TORQUE_LIMIT, 1023)[0]
    assert RAMP_S <= full_s - enabled_s <= max(RAMP_S, period_s) + 3.0 * period_s

    start = rig.goals_rad
    there = (start[0] + 0.4, *start[1:])
    rig.tick(Run(2, JointTrajectory(1.0, (start, there), times_s=(0.0, 8.0))))
    rig.ticks(round(3.0 / period_s))
    assert rig.mode() is Mode.MOVING
    assert answered(rig, Hold(3), 5.0) <= STOP_S + ticks_s
    assert (rig.mode(), rig.replies()[2].code) == (Mode.HOLDING, "STOPPED")
    goal = rig.goals_rad
    rig.ticks(round(1.0 / period_s))
    assert rig.goals_rad == goal

    way_s = approach_duration_s(np.array(goal), np.array([joint.rest_rad for joint in ARM.joints]), rig)
    took_s = answered(rig, Park(4), way_s + VERIFY_S + 6.0 * period_s)
    assert took_s >= way_s
    assert not any(servo.torque_enabled for servo in rig.simulated.servos)

    rig.ticks(3)
    answered(rig, TorqueOn(5), RAMP_S + 8.0 * period_s)
    answered(rig, Teach(6), max(LIMP_NS / NS_PER_S, 2.0 * period_s) + ticks_s)
    assert rig.mode() is Mode.TEACHING
    assert not any(servo.torque_enabled for servo in rig.simulated.servos)
