"""The loop with the real bus and SDK on simulated servos and a virtual clock; and the link between processes."""

import socket
from dataclasses import replace
from itertools import pairwise

import pytest

from armctl import json_text, messages
from armctl.control.link import Link, LinkClosed, Ready
from armctl.control.machine import Motion, State
from armctl.dynamixel.packet import Instruction
from armctl.files import load_arm
from armctl.messages import Clear, Command, Hold, JointTrajectory, Mode, Release, Reply, Run, Teach, TickRecord
from armctl.sim.arm import SimulatedArm
from armctl.sim.loopback import LoopbackPort
from armctl.sim.virtual_arm import VirtualArm

ARM = load_arm("ax12-line")


class LosablePort(LoopbackPort):
    """A port that may be pulled out just as a goal is written to it, or lose every write to one servo."""

    lose_at_next_write = False
    unwritten_id = -1

    def _send(self, packet: bytes) -> int:
        if packet[2] == self.unwritten_id and packet[4] == Instruction.WRITE:
            return len(packet)
        if self.lose_at_next_write and packet[4] == Instruction.SYNC_WRITE:
            self.lose_at_next_write = False
            self.unplug()
        return super()._send(packet)


class Rig(VirtualArm):
    """A virtual arm that remembers what it did."""

    port: LosablePort

    def __init__(self, seed: int = 3, period_s: float = 0.1) -> None:
        super().__init__(SimulatedArm(ARM, seed=seed), period_s, make_port=LosablePort)
        self.records: list[TickRecord] = []
        self.on_tick = self.records.append
        self.start()

    def keep(self, record: TickRecord) -> bool:
        self.records.append(record)
        return True

    def mode(self) -> Mode:
        return self.loop.state.mode

    def replies(self) -> dict[int, Reply]:
        return {reply.request_id: reply for record in self.records for reply in record.outputs.replies}

    def codes(self) -> list[str]:
        return [event.code for record in self.records for event in record.outputs.events]

    def line(self, ticks: int = 30) -> JointTrajectory:
        start = self.goals_rad
        points = tuple((start[0] + 0.02 * k, *start[1:]) for k in range(ticks + 1))
        return JointTrajectory(0.1, points, 0.0, 0.1 * ticks, "line")


def holding(seed: int = 3) -> Rig:
    rig = Rig(seed)
    rig.ticks(3)
    rig.ticks(15, messages.TorqueOn(1))
    assert rig.mode() is Mode.HOLDING
    return rig


def test_a_run_moves_the_arm_and_ends_where_it_was_sent() -> None:
    rig = holding()
    rig.ticks(40, Run(2, rig.line()))
    assert rig.replies()[2].ok
    assert rig.simulated.true_positions()[0] == pytest.approx(0.6, abs=0.03)


def test_the_same_seed_gives_the_same_records() -> None:
    def story() -> list[TickRecord]:
        rig = holding()
        rig.ticks(20, Run(2, rig.line()))
        rig.ticks(10, Hold(3))
        rig.ticks(5, Release(4))
        return rig.records

    assert story() == story()


def test_ticks_keep_their_absolute_deadlines() -> None:
    rig = Rig()
    rig.ticks(20)
    begins = [record.inputs.sample.time_ns for record in rig.records[1:]]
    assert {b - a for a, b in pairwise(begins)} == {100_000_000}


def test_late_ticks_are_skipped_and_never_made_up_for_in_a_burst() -> None:
    rig = Rig()
    rig.ticks(3)
    before_ns = rig.records[-1].inputs.sample.time_ns
    rig.clock.advance_ns(730_000_000)
    rig.ticks(3)
    times = [record.inputs.sample.time_ns for record in rig.records[-3:]]
    assert rig.records[-3].inputs.late_ns > 500_000_000
    assert times[1] - before_ns == 800_000_000
    assert times[2] - times[1] == 100_000_000


def test_at_100_hz_a_tick_that_is_half_a_period_late_is_skipped_too() -> None:
    rig = Rig(period_s=0.01)
    rig.ticks(60)
    rig.clock.advance_ns(30_000_000)
    rig.ticks(5)
    times = [record.inputs.sample.time_ns for record in rig.records[-5:]]
    assert min(b - a for a, b in pairwise(times)) > 5_000_000


def test_a_new_loop_adopts_a_holding_arm_without_moving_it() -> None:
    rig = holding()
    before = rig.simulated.true_positions()
    rig.restart()
    rig.records.clear()
    rig.ticks(20)
    assert rig.mode() is Mode.HOLDING
    assert "RESTARTED" in rig.codes()
    assert not any(record.outputs.goal or record.outputs.writes for record in rig.records)
    assert rig.simulated.true_positions() == pytest.approx(before, abs=0.005)


@pytest.mark.parametrize(("at_write", "ticks"), [(False, 12), (True, 1)])
def test_a_lost_port_latches_and_a_replug_leads_back_to_holding_by_clear(at_write: bool, ticks: int) -> None:
    """Also where it is lost in a tick's last write, and the adapter is back before the next tick."""
    rig = holding()
    rig.ticks(5, Run(2, rig.line()))
    if at_write:
        rig.port.lose_at_next_write = True
    else:
        rig.port.unplug()
    rig.ticks(ticks)
    rig.port.replug()
    rig.ticks(8)
    assert rig.codes().index("PORT_GONE") < rig.codes().index("PORT_BACK")
    assert (rig.replies()[2].code, rig.mode()) == ("PORT_GONE", Mode.FAULTED)
    rig.ticks(1, Clear(3))
    assert (rig.replies()[3].ok, rig.mode()) == (True, Mode.HOLDING)


def test_a_record_tells_which_servo_confirmed_its_write() -> None:
    rig = holding()
    confirmed = [record.confirmed for record in rig.records]
    assert confirmed == [(True,) * len(record.outputs.writes) for record in rig.records]
    assert any(confirmed)
    rig.port.unwritten_id = 3
    (record,) = rig.ticks(1, Release(2))
    assert record.confirmed == tuple(write.servo_id != 3 for write in record.outputs.writes)
    assert not all(record.confirmed)


def test_a_record_tells_whether_the_goal_left() -> None:
    rig = holding()
    rig.ticks(5, Run(2, rig.line()))
    assert [record.goal_sent for record in rig.records] == [record.outputs.goal is not None for record in rig.records]
    rig.port.lose_at_next_write = True
    rig.ticks(1)
    assert rig.records[-1].outputs.goal is not None
    assert not rig.records[-1].goal_sent


def test_a_limp_arm_can_be_taught() -> None:
    rig = holding()
    rig.ticks(4, Teach(5))
    assert rig.replies()[5].ok
    assert not any(servo.torque_enabled for servo in rig.simulated.servos)


def test_leaving_waits_until_the_motion_has_come_to_rest() -> None:
    rig = holding()
    rig.ticks(5, Run(2, rig.line()))
    rig.loop.run(lambda: (messages.HostLost(),), rig.keep, lambda: True)
    assert (rig.mode(), rig.replies()[2].code) == (Mode.HOLDING, "HOST_LOST")


def test_records_the_host_did_not_take_are_counted_and_followed_by_a_keyframe() -> None:
    rig = Rig()
    answers = iter([True, False, False, True, True])

    rig.loop.run(lambda: (), lambda record: rig.keep(record) and next(answers), lambda: len(rig.records) == 5)
    assert [record.dropped for record in rig.records] == [0, 0, 1, 2, 0]
    assert [bool(record.keyframe) for record in rig.records] == [True, False, True, True, False]
    assert json_text.from_json(State, rig.records[3].keyframe).connected


def test_identification_happens_at_first_and_before_the_clear_of_a_fault_only() -> None:
    rig = Rig()
    rig.ticks(3)
    rig.ticks(1, Clear(1))
    rig.port.unplug()
    rig.ticks(2)
    rig.port.replug()
    rig.ticks(7)
    rig.ticks(1, Clear(2))
    connected = [any(isinstance(c, messages.Connected) for c in record.inputs.commands) for record in rig.records]
    assert connected[:4] == [True, False, False, False], "at first; not for a clear of nothing"
    assert sum(connected[4:-1]) == 1, "once the port is back"
    assert connected[-1], "before a latched fault is cleared"


def test_a_link_carries_messages_whole_and_in_order_and_tells_the_end() -> None:
    link, theirs = Link.pair()
    other = Link(theirs)
    assert other.receive() == []
    assert link.send(Ready(7))
    assert link.send(Hold(1))
    assert other.receive() == [Ready(7), Hold(1)]
    assert link.send(Hold(2))
    link.close()
    assert other.receive() == [Hold(2)]
    with pytest.raises(LinkClosed):
        other.receive()
    other.close()


def test_a_link_whose_other_side_does_not_read_refuses_instead_of_blocking() -> None:
    link, theirs = Link.pair()
    assert isinstance(theirs, socket.socket)
    sent = 0
    while link.send(b"x" * 10_000):
        sent += 1
    assert sent > 10
    link.close()
    theirs.close()


def test_the_largest_motion_and_its_keyframe_pass_a_link_of_an_untuned_kernel() -> None:
    joints = 6
    row = tuple(-1.2345678901234567 - index for index in range(joints))
    count = messages.most_points(joints)
    way = JointTrajectory(0.1, (row,) * count, times_s=tuple(0.1234567890123456 + 0.1 * i for i in range(count)))
    rig = Rig()
    record = rig.tick()
    keyframe = json_text.to_json(State(motion=Motion(way, 1)))
    record = replace(record, inputs=replace(record.inputs, commands=(Run(1, way),)), keyframe=keyframe)
    link, theirs = Link.pair()
    link._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 212_992)  # net.core.wmem_max as kernels have it
    other = Link(theirs)
    assert link.send(record)
    assert other.receive() == [record]
    link.close()
    other.close()


def test_a_command_that_comes_while_the_loop_sleeps_is_served_by_the_very_next_tick() -> None:
    rig = Rig()
    came_ns: list[int] = []

    def inbox() -> list[Command]:
        came_ns.append(rig.clock.now_ns())
        return [Hold(len(came_ns))]

    rig.loop.run(inbox, rig.keep, lambda: len(rig.records) == 5)
    for before_ns, record in zip(came_ns, rig.records, strict=True):
        assert record.inputs.sample.time_ns - before_ns < 1_000_000 or record.inputs.tick == 0
        assert len(record.outputs.replies) == 1
