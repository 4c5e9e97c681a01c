"""The control loop: the only caller of the bus and of the step, on any clock.

Deadlines are absolute: tick k is due at start + k * period. A tick that comes half a period too late, or 50 ms, is
skipped, never made up for in a burst. While the port is gone the loop keeps ticking (so that the fault is seen,
logged and published) and looks for the port again every half second; not before a sample has told the step that it is
gone, for a port may be lost in a tick's last write and be back before the next tick.
"""

from collections.abc import Callable, Sequence

from armctl.clock import NS_PER_S, Clock
from armctl.config import ArmConfig
from armctl.control.machine import ENERGISING, TO_REST, State
from armctl.control.step import step
from armctl.dynamixel.bus import ServoBus
from armctl.dynamixel.identify import Identification
from armctl.errors import BusError
from armctl.json_text import to_json
from armctl.kinematics.robots.robot import Robot
from armctl.messages import Clear, Command, Connected, Inputs, TickRecord

REOPEN_NS = NS_PER_S // 2
SKIP_NS = 50_000_000
KEYFRAME_TICKS = 600
# How much longer a tick may take because servos are identified, two silent ones for example; and at a long period.
IDENTIFY_NS = 46_000_000
IDENTIFY_SHARE = 0.4


class ControlLoop:
    """Owns the bus and the state; one call of `tick` is one tick."""

    def __init__(
        self, bus: ServoBus, clock: Clock, arm: ArmConfig, robot: Robot, period_s: float, *, restarted: bool = False
    ) -> None:
        self.state = State()
        self._bus, self._clock, self._arm, self._robot = bus, clock, arm, robot
        self._period_s = period_s
        self.period_ns = round(period_s * NS_PER_S)
        self._skip_ns = min(SKIP_NS, self.period_ns // 2)
        self._restarted = restarted
        # Under way until its outcome has been told, and the requests that wait for that.
        self._identification: Identification | None = None
        self._waiting: tuple[Command, ...] = ()
        self._identify_ns = max(IDENTIFY_NS, round(IDENTIFY_SHARE * self.period_ns))
        self._tick, self._deadline_ns, self._next_open_ns = 0, 0, 0
        # Whether the latest sample told of a lost port, if one is lost.
        self._loss_told = True
        self._dropped = 0
        self._keyframe_due = True

    @property
    def at_rest(self) -> bool:
        """Whether nothing moves by this program's will, and nothing is on its way to."""
        return self.state.motion is None and self.state.jog is None and self.state.phase not in TO_REST

    def tick(self, commands: Sequence[Command]) -> TickRecord:
        """Wait for the next deadline, then read, decide, write."""
        clock = self._clock
        clock.sleep_until_ns(self._due_ns())
        begin_ns = clock.now_ns()
        late_ns = begin_ns - self._deadline_ns
        commands = self._connect(commands, begin_ns)
        sample = self._bus.read_sample()
        self._loss_told = not sample.port_open
        inputs = Inputs(self._tick, clock.now_ns(), sample, commands, late_ns)
        self.state, outputs = step(self.state, inputs, self._arm, self._robot, self._period_s)
        write_begin_ns = clock.now_ns()
        # For the log alone: what failed is seen where it counts, for the next sample does not show its value.
        confirmed = tuple([self._bus.write(write) for write in outputs.writes])
        goal_sent = outputs.goal is not None and self._bus.write_goal(outputs.goal)
        keyframe = ""
        if self._keyframe_due or self._tick % KEYFRAME_TICKS == 0:
            keyframe, self._keyframe_due = to_json(self.state), False
        end_ns = clock.now_ns()
        lateness_us, write_us, dropped = late_ns // 1000, (end_ns - write_begin_ns) // 1000, self._dropped
        wire = self._bus.port.take_wire()
        record = TickRecord(inputs, outputs, lateness_us, write_us, confirmed, goal_sent, keyframe, dropped, wire)
        self._tick += 1
        self._deadline_ns += self.period_ns
        behind_ns = end_ns - self._deadline_ns
        if behind_ns > self._skip_ns:
            self._deadline_ns += -(-behind_ns // self.period_ns) * self.period_ns
        return record

    def run(
        self,
        inbox: Callable[[], Sequence[Command]],
        outbox: Callable[[TickRecord], bool],
        leave: Callable[[], bool],
        wait: Callable[[int], None] | None = None,
    ) -> None:
        """Tick until `leave` says so, nothing moves any more, and whoever asked for a limp arm is answered.

        Args:
            inbox: Commands that arrived since the last call.
            outbox: Takes a record; False if it could not, which the next record tells.
            wait: Returns at an instant [ns]; None: the clock's.
        """
        wait = wait or self._clock.sleep_until_ns
        while not (leave() and not self._owes()):
            wait(self._due_ns())  # before the inbox is emptied: what comes at the last moment is served by this tick
            if outbox(self.tick(inbox())):
                self._dropped = 0
            else:
                self._dropped += 1
                self._keyframe_due = True

    def _owes(self) -> bool:
        """Whether something is under way that has an end of its own, and that nobody else would bring there."""
        state, going = self.state, self.state.letting_go
        return state.motion is not None or state.phase in ENERGISING or bool(going and going.request_ids)

    def _due_ns(self) -> int:
        """When the next tick is due; the first one now."""
        self._deadline_ns = self._deadline_ns or self._clock.now_ns()
        return self._deadline_ns

    def _connect(self, commands: Sequence[Command], now_ns: int) -> tuple[Command, ...]:
        """Open a lost port again, and identify the servos where that is due; the commands, and what came of it.

        A `clear` of a fault waits until they are identified, which silent servos make several ticks long.
        """
        due = not self._bus.is_open and self._loss_told and now_ns >= self._next_open_ns
        if due:
            self._next_open_ns = now_ns + REOPEN_NS
            self._bus.close()
            try:
                self._bus.open()
            except BusError:
                due = False
        clears = [isinstance(command, Clear) and bool(self.state.faults) for command in commands]
        if self._bus.is_open and (due or self._tick == 0 or (any(clears) and self._identification is None)):
            self._identification = Identification(self._bus, self._arm.servos, self._arm.arm_id)
        if self._identification is None:
            return tuple(commands)
        problems = self._identification.advance(now_ns + self._identify_ns)
        if problems is None:
            self._waiting += tuple(command for command, waits in zip(commands, clears, strict=True) if waits)
            return tuple(command for command, waits in zip(commands, clears, strict=True) if not waits)
        found = Connected(problems, restarted=self._restarted, firmware=self._bus.firmware)
        commands = (found, *self._waiting, *commands)
        self._identification, self._restarted, self._waiting = None, False, ()
        return commands
