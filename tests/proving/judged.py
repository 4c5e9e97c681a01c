"""An arm's servos as a judge sees them, moved by the tests."""

from dataclasses import replace

from armctl.dynamixel import ax12a
from armctl.messages import Mode
from armctl.sim.faults import Fault
from proving.arms import arm_of, arm_text
from proving.evidence import Sent, Servo, Strain
from proving.invariants import Judge
from proving.reading import read

TEXT = arm_text("ax12-line")
ARM, JUDGED = arm_of(TEXT), read(TEXT)
PERIOD_S = 0.1
N = len(ARM.joints)
MIDDLE = 500


class Bench:
    """Servos that hold what is written to them, at the middle of their range, before a judge."""

    def __init__(self, torque: bool = True) -> None:
        self.judge = Judge(JUDGED, PERIOD_S, [joint.limits_tick for joint in ARM.joints])
        self.servos = [Servo(torque, MIDDLE, 100, 1023 if torque else 128, float(MIDDLE), MIDDLE) for _ in range(N)]
        # What the motors work and the servos feel; none: nobody has looked.
        self.strains: list[Strain] = []
        self.now_s = 1.0
        self.judge.back()
        self.judge.asked(0.0, "clear")
        self.judge.reported(0.0, Mode.HOLDING if torque else Mode.OFF, "")
        self.tick()

    def hear(self) -> None:
        for index, servo in enumerate(self.servos):
            self.judge.heard(self.now_s, index, servo.sensed_tick, servo.goal if servo.torque else None)

    def tick(self, mode: Mode | None = None, code: str = "", *, heard: bool = True, also: str = "") -> None:
        """The end of a tick, a period later; `also` is told beside the latched code."""
        self.now_s += PERIOD_S
        if heard:
            self.hear()
        self.judge.polled(self.now_s, [] if heard else [(0, 2)], N if heard else 0, N)
        self.judge.ticked(self.now_s, self.servos, self.strains)
        if mode is not None:
            codes = frozenset(filter(None, (code, also)))
            self.judge.reported(self.now_s, mode, code, codes=codes)

    def ticks(self, count: int, mode: Mode | None = None, code: str = "", *, heard: bool = True) -> None:
        for _ in range(count):
            self.tick(mode, code, heard=heard)

    def ask(self, *kinds: str) -> None:
        for kind in kinds:
            self.judge.asked(self.now_s, kind)

    def plan(
        self, kind: str, duration_s: float, servo_id: int | None = 1, *, value: float | None = None, in_s: float = 0.0
    ) -> None:
        """A fault that begins now, or so much later."""
        begin_s = self.now_s + in_s
        self.judge.plan(Fault(kind=kind, servo_id=servo_id, begin_s=begin_s, duration_s=duration_s, value=value))

    def write(self, index: int, register: ax12a.Register, value: int, **after: float | bool) -> None:
        """One write, and what the servo holds then."""
        before = [replace(servo) for servo in self.servos]
        for name, held in after.items():
            setattr(self.servos[index], name, held)
        data = value.to_bytes(register.size, "little")
        self.judge.wrote(self.now_s, [Sent(index, register.address, data)], before, self.servos)

    def goal(self, ticks: int, index: int = 0, **after: float | bool) -> None:
        self.write(index, ax12a.GOAL, ticks, goal=ticks, **after)

    def move(self, ticks: int, *, follow: bool = True, mode: Mode = Mode.MOVING, code: str = "") -> None:
        """A tick of a motion of joint 0, whose shaft is there at its end."""
        self.goal(self.servos[0].goal + ticks)
        if follow:
            self.at(self.servos[0].goal)
        self.tick(mode, code)

    def at(self, ticks: float, index: int = 0) -> None:
        self.servos[index].shaft_tick, self.servos[index].sensed_tick = ticks, round(ticks)

    def stand_off_rest(self) -> None:
        """Joint 0 holds far from its rest, which is at 512."""
        self.servos[0].goal = 400
        self.at(400.0)

    def feel(
        self, output: float = 0.0, *, gravity: float = 0.0, volts: float = 12.0, celsius: float = 30.0,
        carrying: float | None = None,
    ) -> None:  # fmt: skip
        """What joint 0 works and feels from now on; the others rest."""
        one = Strain(output, gravity, volts, celsius, carrying)
        self.strains = [one, *(Strain(0.0, 0.0, 12.0, 30.0) for _ in range(N - 1))]

    @property
    def red(self) -> set[str]:
        """Rules broken, whether they are kept yet or not."""
        return self.broken | {violation.invariant for violation in self.judge.red}

    @property
    def broken(self) -> set[str]:
        return {violation.invariant for violation in self.judge.violations}


def running() -> Bench:
    bench = Bench()
    bench.ask("run")
    bench.tick(Mode.MOVING)
    return bench


def advancing(bench: Bench, **of_move: object) -> float | None:
    """Seconds until advancing goals become a violation, at most 2."""
    begin_s = bench.now_s
    for _ in range(20):
        bench.move(5, **of_move)  # type: ignore[arg-type]  # of move
        if bench.broken & {"6", "7"}:
            return bench.now_s - begin_s
    return None
