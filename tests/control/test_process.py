"""What the control process does with its host's commands between two ticks."""

import contextlib
import os
import select
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from armctl.clock import NS_PER_S, VirtualClock
from armctl.control.link import Link, StopAsked
from armctl.control.loop import ControlLoop
from armctl.control.machine import TO_REST, Jogging, Motion, State
from armctl.control.process import SILENT_NS, Inbox
from armctl.control.stop_lane import ACCEPTED, PLACES, REQUEST_ID, StopLane
from armctl.messages import (
    Command,
    Hold,
    HostLost,
    HostSilent,
    Inputs,
    JointTrajectory,
    Mode,
    Outputs,
    Park,
    Reply,
    Run,
    Sample,
    SetRate,
    TickRecord,
)
from tests.control.test_loop import Rig, holding
from tests.stalled import Machine

SOON_NS = 1_000_000
NOTHING = Inputs(0, 1, Sample(1, ()))
WAY = JointTrajectory(0.1, ((0.0,) * 6, (0.1,) * 6))
MOVING = (
    State(motion=Motion(WAY, 1)),
    State(jog=Jogging((0.0,) * 6, (0.1,) * 6, (0.1,) * 6, (), heard_ns=1)),
    *(State(phase) for phase in sorted(TO_REST)),
)


class Bench:
    """An inbox, the host's end of its link, and the loop it belongs to."""

    def __init__(self, loop: ControlLoop) -> None:
        self.host, theirs = Link.pair()
        self.ours = Link(theirs)
        self.clock = VirtualClock()
        self.loop = loop
        self.lane = socket.socket(socket.AF_UNIX)
        self.lane.bind("")  # any free abstract address
        self.lane.listen()
        self.stop_lane = StopLane(self.lane, self.clock)
        self.heart = memoryview(bytearray(8)).cast("q")
        self.inbox = Inbox(self.ours, self.stop_lane, loop, self.clock, self.heart)

    def close(self) -> None:
        for end in (self.host, self.ours, self.stop_lane):
            end.close()

    def beat(self) -> None:
        """The host is there."""
        self.heart[0] = self.clock.now_ns()

    def caller(self, line: bytes = b"stop\n") -> socket.socket:
        """Somebody at the stop lane who has said that much."""
        caller = socket.socket(socket.AF_UNIX)
        caller.connect(self.lane.getsockname())
        caller.sendall(line)
        caller.settimeout(5.0)
        return caller

    def tell(self, *commands: Command) -> list[object]:
        """What is answered at once."""
        for command in commands:
            assert self.host.send(command)
        self.inbox.wait(self.clock.now_ns() + SOON_NS)
        return self.host.receive()


@pytest.fixture
def bench() -> Iterator[Bench]:
    found = Bench(Rig().loop)
    yield found
    found.close()


def test_a_hold_of_an_arm_at_rest_is_answered_at_once_and_still_comes_to_the_tick(bench: Bench) -> None:
    assert bench.tell(Hold(1), Hold(2)) == [Reply(1, True), Reply(2, True)]
    assert bench.inbox.take() == [Hold(1), Hold(2)]
    assert bench.inbox.take() == []
    assert bench.tell(Hold(3)) == [Reply(3, True)]


@pytest.mark.parametrize("state", MOVING)
def test_a_hold_of_a_moving_arm_is_the_ticks_to_answer(bench: Bench, state: State) -> None:
    bench.loop.state = state
    assert not bench.loop.at_rest
    assert bench.tell(Hold(1)) == []
    assert bench.inbox.take() == [Hold(1)]


@pytest.mark.parametrize("before", [Run(1, WAY), Park(1), SetRate(1, 0.5)])
def test_a_hold_behind_another_command_is_the_ticks_to_answer(bench: Bench, before: Command) -> None:
    assert bench.tell(before, Hold(2)) == []
    assert bench.inbox.take() == [before, Hold(2)]


def test_a_command_behind_an_answered_hold_is_carried_out_after_it(bench: Bench) -> None:
    assert bench.tell(Hold(1), Park(2)) == [Reply(1, True)]
    assert bench.tell(Hold(3)) == []
    assert bench.inbox.take() == [Hold(1), Park(2), Hold(3)]


def test_what_comes_at_the_last_moment_is_in_the_next_tick(bench: Bench) -> None:
    assert bench.host.send(Park(1))
    assert bench.inbox.take() == [Park(1)]


def test_waiting_ends_at_the_deadline(bench: Bench) -> None:
    deadline_ns = bench.clock.now_ns() + SOON_NS
    bench.inbox.wait(deadline_ns)
    assert bench.clock.now_ns() == deadline_ns
    bench.inbox.wait(deadline_ns - SOON_NS)
    assert bench.clock.now_ns() == deadline_ns


def test_a_host_that_is_gone_is_the_only_thing_heard_of_it(bench: Bench) -> None:
    assert bench.host.send(Park(1))
    bench.host.close()
    bench.inbox.wait(bench.clock.now_ns() + SOON_NS)
    assert bench.inbox.leaving
    assert bench.inbox.take() == (HostLost(),)


@pytest.mark.parametrize("stopped", [True, False])
def test_nothing_moves_after_a_hold_that_was_answered_at_once(stopped: bool) -> None:
    """Also where, in the tick that it comes to, heat sends the arm to rest."""
    rig = holding()
    rig.ticks(40, Run(2, rig.line()))
    rig.records.clear()
    for servo in rig.simulated.servos:
        servo.temperature_degC = 70.0
    bench = Bench(rig.loop)
    rig.ticks(20)
    rig.records.clear()
    assert not stopped or bench.tell(Hold(3)) == [Reply(3, True)]
    rig.ticks(60, *bench.inbox.take())
    assert "HOT" in rig.codes()
    assert any(record.outputs.goal for record in rig.records) != stopped
    bench.close()


def test_a_host_that_has_fallen_silent_is_told_to_one_tick(bench: Bench) -> None:
    bench.clock.sleep_until_ns(bench.clock.now_ns() + 10 * SILENT_NS)
    assert bench.inbox.take() == []  # it has never said anything: it is still starting
    for _ in range(2):
        bench.beat()
        bench.inbox.take()
        bench.clock.sleep_until_ns(bench.clock.now_ns() + SILENT_NS)
        assert bench.inbox.take() == []
        bench.clock.sleep_until_ns(bench.clock.now_ns() + SOON_NS)
        assert bench.inbox.take() == (HostSilent(),)
        assert bench.inbox.take() == []


def test_a_host_on_a_machine_that_stood_still_is_no_more_silent_than_that(bench: Bench, tmp_path: Path) -> None:
    machine = Machine(tmp_path, bench.clock)
    bench.inbox._stalls = machine.stalls
    told = []
    for stalled in (35, 5, 1000):
        bench.beat()
        bench.inbox.take()
        machine.run(stalled, (1,))
        told.append(bench.inbox.take())
        machine.run(29)
        told.append(bench.inbox.take())
        machine.run(2)
        told.append(bench.inbox.take())
    silent = (HostSilent(),)
    assert told == [[], [], silent, [], [], silent, silent, [], []], "at most a second is made up for"


def test_a_silence_is_counted_from_the_last_word_not_from_the_tick_that_saw_it(bench: Bench) -> None:
    bench.inbox.take()
    bench.beat()
    bench.clock.sleep_until_ns(bench.clock.now_ns() + SILENT_NS)
    assert bench.inbox.take() == []
    bench.clock.sleep_until_ns(bench.clock.now_ns() + SOON_NS)
    assert bench.inbox.take() == (HostSilent(),)


def test_what_was_said_while_this_process_hung_counts_as_said_now(bench: Bench) -> None:
    bench.beat()
    bench.inbox.take()
    bench.clock.sleep_until_ns(bench.clock.now_ns() + SOON_NS)
    bench.beat()
    bench.clock.sleep_until_ns(bench.clock.now_ns() + 10 * SILENT_NS)
    assert bench.inbox.take() == []


# ----------------------------------------------------------------------------------------------- the stop lane


def test_a_stop_on_its_lane_is_answered_at_once_where_nothing_moves_and_still_comes_to_the_tick(bench: Bench) -> None:
    with bench.caller() as caller:
        assert bench.tell() == [StopAsked(f"uid {os.getuid()}, pid {os.getpid()}")]
        assert caller.recv(99) == b"ok starting\n"
        assert caller.recv(99) == b""
    assert bench.inbox.take() == [Hold(REQUEST_ID)]


def test_a_stop_of_a_moving_arm_is_answered_by_the_tick_in_which_it_lies_still(bench: Bench) -> None:
    bench.loop.state = MOVING[0]
    with bench.caller() as one, bench.caller() as two:
        bench.tell()
        assert bench.inbox.take() == [Hold(REQUEST_ID)], "two who ask at once are one command"
        still = Outputs(Mode.HOLDING, (), (), None, replies=(Reply(REQUEST_ID, True),))
        assert bench.inbox.told(TickRecord(NOTHING, still))
        assert one.recv(99) == two.recv(99) == b"ok starting\n"


@pytest.mark.parametrize("before", [0, 1, 500])
def test_nobody_fills_the_lane_of_a_user(bench: Bench, before: int) -> None:
    idle = []
    for _ in range(before):
        idle.append(bench.caller(b"st"))
        bench.inbox.wait(bench.clock.now_ns() + SOON_NS)
    with bench.caller() as caller:
        bench.inbox.wait(bench.clock.now_ns() + SOON_NS)
        assert caller.recv(99) == b"ok starting\n"
    gone = [one for one in idle if select.select([one], [], [], 0.0)[0]]
    assert len(gone) == max(0, before - PLACES + 1)
    for one in idle:
        one.close()


def test_a_crowd_behind_a_caller_does_not_take_its_place(bench: Bench) -> None:
    bench.loop.state = MOVING[0]
    with contextlib.ExitStack() as crowd:
        caller = crowd.enter_context(bench.caller())
        for _ in range(2 * ACCEPTED):
            crowd.enter_context(bench.caller(b""))
        bench.inbox.take()
        still = Outputs(Mode.HOLDING, (), (), None, replies=(Reply(REQUEST_ID, True),))
        assert bench.inbox.told(TickRecord(NOTHING, still))
        assert caller.recv(99) == b"ok starting\n"


@pytest.mark.parametrize("line", [b"go\n", b"x" * 257, b"\n", b"stop now\n"])
def test_who_says_anything_else_is_sent_away(bench: Bench, line: bytes) -> None:
    with bench.caller(line) as caller:
        assert bench.tell() == []
        assert caller.recv(99) == b""
    assert bench.inbox.take() == []


def test_who_says_nothing_is_sent_away_in_time(bench: Bench) -> None:
    with bench.caller(b"sto") as caller:
        bench.inbox.wait(bench.clock.now_ns() + SOON_NS)
        bench.clock.sleep_until_ns(bench.clock.now_ns() + 2 * NS_PER_S)
        bench.inbox.take()
        assert caller.recv(99) == b""


def test_a_signal_asks_for_a_stop(bench: Bench) -> None:
    bench.stop_lane.signal()
    assert bench.tell() == [StopAsked("a signal")]
    assert bench.inbox.take() == [Hold(REQUEST_ID)]
