"""A whole arm in one process: simulated servos, the real bus and the real control loop, in virtual time.

Experiments, rehearsals, proofs and tests all build their arm here. Nothing in it knows the machine's clock, a port of
the system's or the daemon, so the same seeds and the same commands give the same bytes.
"""

from collections.abc import Callable
from dataclasses import replace

from armctl.clock import VirtualClock
from armctl.config import ArmConfig
from armctl.control.loop import ControlLoop
from armctl.dynamixel.bus import ServoBus
from armctl.errors import RequestRefused
from armctl.kinematics import robots
from armctl.messages import Command, Mode, Reply, Run, TickRecord, TorqueOn
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.loopback import LoopbackPort
from armctl.trajectory.thinning import thinned

# So long an arm is looked at before it is known to stand still.
FIRST_TICKS = 3
# How long a command may take, beside the duration of its own trajectory.
PATIENCE_S = 10.0


class VirtualArm:
    """Simulated servos, line, port, bus and control loop; the port is closed until `start`."""

    def __init__(
        self,
        simulated: SimulatedArm,
        period_s: float = 0.1,
        *,
        arm: ArmConfig | None = None,
        clock: VirtualClock | None = None,
        wire: SimulatedBus | None = None,
        make_port: Callable[[SimulatedBus, VirtualClock], LoopbackPort] = LoopbackPort,
    ) -> None:
        """
        Args:
            arm: What the loop takes the simulated arm for; None: what it is.
            clock: None: one of its own.
            wire: To the servos; None: with an adapter that loses no time.
            make_port: Makes the port of every new control process, for those who want to see what passes.
        """
        self.simulated, self.period_s = simulated, period_s
        self.arm = arm or simulated.config
        self.robot = robots.get(self.arm.robot, self.arm.lengths_m)
        self.clock = clock or VirtualClock()
        self.wire = wire or SimulatedBus(simulated)
        self._make_port, self._request_id = make_port, 0
        # Sees every record.
        self.on_tick: Callable[[TickRecord], None] = lambda record: None
        self._connect(restarted=False)

    def _connect(self, restarted: bool) -> None:
        self.port = self._make_port(self.wire, self.clock)
        self.bus = ServoBus(self.port, self.arm.servo_ids)
        self.loop = ControlLoop(self.bus, self.clock, self.arm, self.robot, self.period_s, restarted=restarted)
        # Where the arm is commanded to be; empty: armctl has no say in it.
        self.goals_rad: tuple[float, ...] = ()

    def start(self) -> None:
        """Open the port.

        Raises:
            PortMissing: the adapter is unplugged.
        """
        self.bus.open()

    def restart(self, *, restarted: bool = True) -> None:
        """A new control process instead of the old one, which may have been killed; the arm knows nothing of it.

        Args:
            restarted: Whether the new process is told that there was one before.
        Raises:
            PortMissing: the adapter is unplugged.
        """
        self.port.closePort()  # the kernel does it, however a process ends
        self._connect(restarted)
        self.start()

    def next_id(self) -> int:
        """A number that no request has had yet."""
        self._request_id += 1
        return self._request_id

    def tick(self, *commands: Command) -> TickRecord:
        """One tick of the control loop; the clock goes on to its begin."""
        record = self.loop.tick(commands)
        self.goals_rad = record.outputs.wanted_rad
        self.on_tick(record)
        return record

    def ticks(self, count: int, *commands: Command) -> list[TickRecord]:
        """So many ticks, the first of them with the commands."""
        return [self.tick(*(() if index else commands)) for index in range(count)]

    def carry_out(self, command: Command) -> list[TickRecord]:
        """Tick until the command is answered, and its motion over.

        Raises:
            RequestRefused: it was refused, or a fault or a stop ended it.
        """
        patience_s = PATIENCE_S
        if isinstance(command, Run):
            command = replace(command, trajectory=thinned(command.trajectory))
            patience_s += command.trajectory.duration_s
        records: list[TickRecord] = []
        reply: Reply | None = None
        while reply is None or self.loop.state.mode is Mode.MOVING:
            if len(records) * self.period_s > patience_s:
                raise RequestRefused("NO_ANSWER", "the arm did not finish in time")
            records.append(self.tick(*(() if records else (command,))))
            reply = next(iter(records[-1].outputs.replies), reply)
        if not reply.ok:
            raise RequestRefused(reply.code, reply.message)
        return records

    def energise(self, first_ticks: int = FIRST_TICKS) -> list[TickRecord]:
        """Start, wait until the arm is known to stand still, and switch its torque on.

        Raises:
            RequestRefused: the arm does not take torque.
        """
        self.start()
        return [*self.ticks(first_ticks), *self.carry_out(TorqueOn(self.next_id()))]
