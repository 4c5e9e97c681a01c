"""The rows of the fault matrix that are tried on the wire: what strikes in which state, and what must come of it."""

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from armctl.clock import MonotonicClock
from armctl.dynamixel import ax12a
from armctl.dynamixel.bus import ServoBus
from armctl.dynamixel.serial_port import SerialPort
from armctl.messages import Write
from armctl.sim.control import SimulatorClient
from proving.rig import Rig

TICK_S = 0.1
RESTART_S = 2.0
# How long the motion of a moving arm takes.
SWING_S = 5.0

Before = Literal["connect", "off", "holding", "moving", "teaching"]
Act = Callable[[Rig], None]


@dataclass(frozen=True)
class Scenario:
    """One row: what strikes in which state, and what must come of it."""

    state: Before
    kind: str
    # Acceptable codes, the matrix's first; empty: nothing latches.
    codes: tuple[str, ...]
    within_s: float = 0.0
    servo_id: int | None = None
    probability: float = 1.0
    count: int | None = None
    value: float | None = None
    # Servos whose motion the fault itself causes.
    free: tuple[int, ...] = ()
    # Whether the fault takes torque away, so that `release` comes before `clear`.
    limp: bool = False
    settles: bool = False
    # How long to watch beyond the bound.
    watch_s: float = 1.0
    # Whether a swing begins where something bears the arm, as it does at rest.
    borne: bool = False
    # What happens instead of a simulator's fault.
    act: Act | None = None

    @property
    def name(self) -> str:
        where = "" if self.servo_id is None else f" servo {self.servo_id}"
        often = "" if self.probability == 1.0 else f" {self.probability:.0%}"
        times = "" if self.count is None else f" x{self.count}"
        much = "" if self.value is None else f" {self.value:g}"
        begin = " from the rest pose" if self.borne else ""
        return f"{self.state}{begin}: {self.kind}{where}{often}{times}{much}"


# Heat latches once it has lasted. The way to rest is announced 3 s ahead, and takes some.
HEAT_S, TO_REST_S = 2.0, 12.0
# A servo or bus without an answer latches after this long; goals stop at 0.2 s.
SILENT = 0.5
NOISE = 10.0
ALL_SILENT = ("BUS_DEAD",)
ALL_NOISE = ("BUS_DEAD", "BUS_NOISE")
# Nothing but noise from a servo is no answer of it: what comes first counts.
ONE_NOISE = ("SERVO_SILENT", "BUS_NOISE")


def _stall_control(running: Rig) -> None:
    pid = running.snapshot["pids"]["control"]
    os.kill(pid, signal.SIGSTOP)
    time.sleep(0.45)
    os.kill(pid, signal.SIGCONT)


def _kill_control(running: Rig) -> None:
    """Kill it, and see the loss told and another one in its place within 2 s."""
    old_pid = running.snapshot["pids"]["control"]
    begin_s = time.monotonic()
    os.kill(old_pid, signal.SIGKILL)
    told = False
    while (status := running.client.call("status"))["pids"]["control"] in (None, old_pid):
        told |= status["fault"] is not None and status["fault"]["code"] == "RESTARTED"
        assert time.monotonic() - begin_s < RESTART_S, "no other control process in time"
        time.sleep(0.01)
    back = running.wait(lambda s: s["pids"]["control"] != old_pid and s["state"] == "holding", RESTART_S)
    assert told, "no snapshot told RESTARTED"
    assert back, "the new control process does not hold"
    assert time.monotonic() - begin_s < RESTART_S + TICK_S, "restarted too late"


SCENARIOS: tuple[Scenario, ...] = (
    Scenario("off", "lost", ("SERVO_SILENT",), SILENT, 3),
    Scenario("off", "lost", ALL_SILENT, SILENT),
    Scenario("off", "corrupted", (), 2.0, probability=0.05),
    Scenario("off", "mute", ("SERVO_SILENT",), SILENT, 5),
    Scenario("off", "dead_bus", ALL_SILENT, SILENT),
    Scenario("off", "unplug", ("PORT_GONE",), TICK_S),
    Scenario("holding", "lost", ("SERVO_SILENT",), SILENT, 3),
    Scenario("holding", "lost", ALL_SILENT, SILENT),
    Scenario("holding", "lost", (), 2.0, probability=0.1),
    Scenario("holding", "lost", (), 1.0, 2, count=1),
    # Where the kernel is late too, one such reply may be waited for long enough; then the time counts from that.
    Scenario("holding", "late", ("SERVO_SILENT",), SILENT + TICK_S, 3, value=20.0),
    Scenario("holding", "late", (), 2.0, value=1.0),
    Scenario("holding", "duplicated", ("", "BUS_NOISE"), 3.0),
    Scenario("holding", "corrupted", ONE_NOISE, SILENT, 4),
    Scenario("holding", "corrupted", ALL_NOISE, SILENT),
    Scenario("holding", "corrupted", ("BUS_NOISE", "SERVO_SILENT"), NOISE, probability=0.4),
    Scenario("holding", "truncated", ONE_NOISE, SILENT, 2),
    Scenario("holding", "garbage", ("", "BUS_NOISE"), 3.0),
    # On a busy machine the reply to a request may come as late as if it were one to its repetition, and be believed.
    Scenario("holding", "echo", (*ALL_NOISE, "SERVO_SILENT"), SILENT),
    Scenario("holding", "wrong_id", ONE_NOISE, SILENT, 3),
    Scenario("holding", "mute", ("SERVO_SILENT",), SILENT, 1),
    Scenario("holding", "dead_bus", ALL_SILENT, SILENT),
    Scenario("holding", "unplug", ("PORT_GONE",), TICK_S),
    Scenario("holding", "brown_out", ("LOST_TORQUE",), TICK_S + 0.3, 2, count=1, value=11.0, free=(2,), limp=True),
    Scenario("holding", "trip", ("TRIPPED",), TICK_S, 4, free=(4,), limp=True),
    Scenario("holding", "trip", ("TRIPPED",), TICK_S, free=(1, 2, 3, 4, 5, 6), limp=True),
    Scenario("holding", "frozen_sensor", (), 1.0, 3),
    Scenario("holding", "blocked_joint", (), 1.0, 2),
    Scenario("holding", "second_writer", ("OTHER_WRITER",), TICK_S + TICK_S, 6, value=30, free=(6,)),
    # A 16 ms timer fires in time for the odd reply: then some servo was heard, and the bus is not all silent.
    Scenario("holding", "latency", (*ALL_SILENT, "SERVO_SILENT"), SILENT, value=16.0),
    Scenario("holding", "hot", ("HOT",), HEAT_S + TICK_S, 5, value=67.0, settles=True, watch_s=TO_REST_S),
    Scenario("moving", "lost", ("SERVO_SILENT",), SILENT, 3),
    Scenario("moving", "lost", ("SERVO_SILENT",), SILENT, 1),
    Scenario("moving", "lost", ALL_SILENT, SILENT),
    Scenario("moving", "lost", (), SWING_S, probability=0.1),
    Scenario("moving", "lost", (), SWING_S, 3, count=1, borne=True),
    Scenario("moving", "late", ("SERVO_SILENT",), SILENT + TICK_S, 1, value=20.0),
    Scenario("moving", "corrupted", (), SWING_S, probability=0.02),
    Scenario("moving", "corrupted", ONE_NOISE, SILENT, 1),
    Scenario("moving", "truncated", (), SWING_S, probability=0.02),
    Scenario("moving", "garbage", ("", "BUS_NOISE"), SWING_S),
    Scenario("moving", "duplicated", ("", "BUS_NOISE"), SWING_S),
    Scenario("moving", "wrong_id", ONE_NOISE, SILENT, 1),
    Scenario("moving", "echo", (*ALL_NOISE, "SERVO_SILENT"), SILENT),
    Scenario("moving", "mute", ("SERVO_SILENT",), SILENT, 1),
    Scenario("moving", "dead_bus", ALL_SILENT, SILENT),
    Scenario("moving", "unplug", ("PORT_GONE",), TICK_S),
    Scenario("moving", "brown_out", ("LOST_TORQUE",), TICK_S + 0.3, 1, count=1, value=11.0, free=(1,), limp=True),
    Scenario("moving", "trip", ("TRIPPED",), TICK_S, 1, free=(1,), limp=True),
    Scenario("moving", "trip", ("TRIPPED",), TICK_S, 4, free=(4,), limp=True),
    Scenario("moving", "blocked_joint", ("BLOCKED",), 2.0, 1, free=(1,)),
    Scenario("moving", "stuck_joint", ("BLOCKED",), 2.0, 1, free=(1,)),
    Scenario("moving", "frozen_sensor", ("BLOCKED",), 2.0, 1, free=(1,)),
    Scenario("moving", "second_writer", ("OTHER_WRITER",), TICK_S + TICK_S, 6, value=60, free=(6,)),
    Scenario("moving", "latency", (*ALL_SILENT, "SERVO_SILENT"), SILENT, value=16.0),
    Scenario("moving", "hot", ("HOT",), HEAT_S + TICK_S, 5, value=67.0, settles=True, watch_s=TO_REST_S),
    Scenario("moving", "control process stalls", (), 1.0, act=_stall_control),
    Scenario("moving", "control process killed", (), 2.0, act=_kill_control),
    Scenario("holding", "control process killed", (), 2.0, act=_kill_control),
    Scenario("teaching", "lost", ("SERVO_SILENT",), SILENT, 3),
    Scenario("teaching", "mute", ("SERVO_SILENT",), SILENT, 2),
    Scenario("teaching", "dead_bus", ALL_SILENT, SILENT),
    Scenario("teaching", "unplug", ("PORT_GONE",), TICK_S),
    Scenario("teaching", "corrupted", (), 2.0, probability=0.05),
    Scenario("teaching", "second_writer", ("NOT_LIMP",), TICK_S + TICK_S, 6, value=10, free=(6,), limp=True),
    Scenario("connect", "same_id", ("DUPLICATE_ID",), 0.0, 3),
    Scenario("connect", "latency", ("SLOW_ADAPTER",), 0.0, value=16.0),
    Scenario("connect", "mute", ("SERVO_SILENT",), 0.0, 4),
    Scenario("connect", "dead_bus", ALL_SILENT, 0.0),
    Scenario("connect", "echo", ALL_NOISE, 0.0),
    Scenario("connect", "wheel mode", ("EEPROM_MISMATCH",), 0.0, 5),
)

# What the test suite runs.
SHORT: tuple[str, ...] = (
    "off: unplug",
    "holding: lost servo 3",
    "holding: trip servo 4",
    "moving: lost servo 3",
)

LATER: tuple[tuple[str, str], ...] = (
    (
        "JUMP_REFUSED, NOT_TAKEN, NO_REPLY at 200 ms as a code of its own",
        "no snapshot tells them; the step's own tests hold them",
    ),
    ("NO_SPACE, power cut, FOREIGN_LOG", "not on the wire: tools/prove powercut"),
    ("SIGKILL of the host, SIGTERM, ORPHAN_TAKE", "not on the wire: tools/prove kill"),
    ("slow subscriber, flood, deep JSON, BUSY", "not on the wire: tools/prove fuzz and load"),
    ("VOLTAGE and OVERLOAD settle, park", "their settling is judged where it is built, on the virtual clock"),
    ("LATE as a code in a snapshot", "an event of the log; here only that the arm stops and nothing latches"),
)


def spoil(scenario: Scenario) -> Callable[[SimulatorClient, Path], None]:
    """What spoils the arm before the daemon meets it, in a scenario of state `connect`."""

    def strike(simulator: SimulatorClient, port: Path) -> None:
        if scenario.kind == "wheel mode":
            assert scenario.servo_id is not None
            _wheel_mode(port, scenario.servo_id)
        else:
            simulator.fault_begin(scenario.kind, servo_id=scenario.servo_id, value=scenario.value)

    return strike


def _wheel_mode(path: Path, servo_id: int) -> None:
    clock = MonotonicClock()
    bus = ServoBus(SerialPort(str(path), 1_000_000, clock), (servo_id,))
    bus.open()
    for register in (ax12a.CW_LIMIT, ax12a.CCW_LIMIT):
        assert bus.write(Write(servo_id, register.address, register.size, 0))
    bus.close()
