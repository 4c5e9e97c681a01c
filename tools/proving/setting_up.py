"""`armctl setup --answers` on simulated arms with 0 to 3 defects each, with a person made of the truth beside it.

The command is typed, and the servos are on a pseudo terminal in real time. A short form, for tests, asks the wizard
itself in virtual time.

The person turns the limp joints by hand, holds the arm as the words of a question say, looks which way the true tool
went, and unplugs servos. Of each arm: either its file is right, or the wizard ends with a sentence that names a defect
which was planted and that it cannot mend. Whatever the outcome: no joint with torque comes to a stop, nothing has
torque unless the person said that the arm is free, and at the end the arm is limp.

| defect | what it is | may end the set-up |
|-|-|-|
| swapped | two servos have each other's id | no |
| strange | a servo has an id that nobody expects | no |
| shared | two servos have one id | no |
| baud | a servo has another baud | no |
| reversed | a servo is mounted the other way round | no |
| horn | a horn is mounted up to 40 deg off: beyond what the servo sees it has to be turned | only then |
| missing | a servo is silent | yes |
"""

import contextlib
import math
import os
import re
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from armctl.clock import VirtualClock, ask_for_real_time
from armctl.commissioning.wizard import Progress, Wizard
from armctl.config import ArmConfig
from armctl.errors import ArmctlError
from armctl.files import load_arm
from armctl.sim.control import TruthRing
from armctl.sim.pty import PseudoTerminal, RealTime
from proving.put_together import ID_AT, PERIOD_S, Arm, Person, assembled, opened_of, prepared
from proving.reading import TICK_DEG
from proving.workers import carry_out

ARMS = 30
KINDS = ("ax12-line", "phantomx-pincher", "crane-plus-v2", "xiang-6dof", "lanzhou-4dof")
DEFECTS = ("swapped", "strange", "shared", "baud", "reversed", "horn", "missing")
# How near a hand and an eye get, and what a file may leave unused of a joint's range.
ZERO_DEG, REST_DEG, UNUSED_DEG = 1.5, 3.0, 8.0
# A question as it is shown: its words, and its key.
QUESTION = re.compile(r"\n((?:.|\n)*)\n(\S+) \[.*\], Enter:\n$")
TURN_S = 0.02
SAYS = {"missing": r"\d of \d servos answer", "horn": r"the 300 deg that its servo sees"}


@dataclass(frozen=True)
class Trial:
    """One arm to be set up."""

    seed: int
    defects: tuple[str, ...]
    kind: str


def drawn(seed: int, number: int) -> Trial:
    """The arm of a number: 0, 1, 2 and 3 defects in their turn."""
    rng = np.random.default_rng((seed, number, 37))
    defects = rng.choice(DEFECTS, number % 4, replace=False).tolist()
    return Trial(seed * 1000 + number, tuple(defects), KINDS[number % len(KINDS)])


def run(trial: Trial, *, typed: bool = False) -> dict[str, Any]:
    """How the set-up of one arm ended, and what must not have been.

    Args:
        typed: Whether the command is typed, in real time.
    """
    arm = assembled(trial.seed, trial.defects, trial.kind, VirtualClock(time.monotonic_ns()) if typed else None)
    with tempfile.TemporaryDirectory(prefix="armctl-") as folder:
        file = Path(folder) / "answers.yaml"
        file.write_text(yaml.safe_dump(prepared(arm) | {"name": "mine"}), encoding="utf-8")
        path = Path(folder) / ("armctl/calibration" if typed else "") / "mine.yaml"
        outcome = commanded(arm, file, Path(folder)) if typed else attempted(arm, Person(arm, file), path)
        broken = list(dict.fromkeys(arm.wire.broken))
        servos = zip(arm.kind.joint_names, arm.simulated.servos, strict=True)
        broken += [f"{name} is left with torque" for name, servo in servos if servo.torque_enabled]
        if outcome == "set up":
            broken += wrong(arm, load_arm(str(path)))
            if "missing" in arm.defects:
                broken.append("set up, though a servo is missing")
        elif not any(re.search(SAYS[what], outcome) for what in named(arm)):
            broken.append(f"ended by {outcome!r}")
    return {
        "defects": list(trial.defects),
        "kind": trial.kind,
        "outcome": outcome,
        "broken": broken,
        "seed": trial.seed,
    }


def attempted(arm: Arm, person: Person, path: Path) -> str:
    """How it ended: `set up`, or with which sentence."""
    found = Progress(kind=arm.kind.arm_id, arm_id="mine")
    try:
        for _ in Wizard(arm.kind, path, found, opened_of(arm), person, PERIOD_S).run():
            pass
    except ArmctlError as error:
        return str(error)
    return "set up"


class World:
    """The arm on a pseudo terminal, in real time, for as long as somebody lets it run."""

    def __init__(self, arm: Arm, link: Path) -> None:
        self._wire, self._time = arm.wire, RealTime(arm.simulated, arm.wire, TruthRing())
        self.terminal = PseudoTerminal(link)
        self.terminal.replug()

    def run(self, seconds: float) -> None:
        """Let so many seconds pass."""
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0.0:
            heard = b""
            if select.select([self.terminal], [], [], min(left_s, self._time.patience_s()))[0]:
                self._wire.baud = self.terminal.baud() or self._wire.baud
                heard = self.terminal.read()
            if replies := self._time.pass_on(heard):
                self.terminal.write(replies)


def commanded(arm: Arm, answers: Path, folder: Path) -> str:
    """How the command ended that was typed; the person does what each question asks, and presses Enter."""
    world = World(arm, folder / "servos")
    person, said = Person(arm, answers, world.run), ""
    words = ("setup", arm.kind.arm_id, "--answers", str(answers), "--port", str(folder / "servos"))
    here = {**os.environ, "XDG_CONFIG_HOME": str(folder)}
    with subprocess.Popen(
        (sys.executable, "-m", "armctl", *words),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=here,
    ) as command:
        ask_for_real_time()  # servos do not wait for whatever else the machine does; what was started before has none
        assert command.stdin is not None
        assert command.stdout is not None
        os.set_blocking(command.stdout.fileno(), False)
        while command.poll() is None:
            world.run(TURN_S)
            said += (command.stdout.read() or b"").decode()
            if (asked := QUESTION.search(said)) is not None:
                person.ask(asked[2], asked[1])
                said = ""
                command.stdin.write(b"\n")
                command.stdin.flush()
        said += (command.stdout.read() or b"").decode()
    world.terminal.unplug()
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return "set up" if command.returncode == 0 else said


def named(arm: Arm) -> list[str]:
    """The defects that may end a set-up."""
    return [what for what in arm.defects if what == "missing" or (what == "horn" and arm.blind)]


def wrong(arm: Arm, found: ArmConfig) -> list[str]:
    """What an arm's file says that is not so."""
    broken = []
    for true, joint, servo in zip(arm.true.joints, found.joints, arm.simulated.servos, strict=True):
        grips = arm.kind.gripper is not None and arm.kind.gripper.joint == joint.name
        if joint.servo_id != servo.table[ID_AT]:
            broken.append(f"{joint.name}: servo {joint.servo_id}, and it has {servo.table[ID_AT]}")
            continue
        # A gripper's own angle has no sense but from open to closed.
        if not grips and joint.direction != true.direction:
            broken.append(f"{joint.name}: direction {joint.direction}, and it is {true.direction}")
        elif not grips and abs(joint.zero_tick - true.zero_tick) * TICK_DEG > ZERO_DEG:
            broken.append(f"{joint.name}: zero at {joint.zero_tick:.1f}, and it is at {true.zero_tick:.1f}")
        stops = [
            true.tick(math.radians(limit + way * 2.0)) for limit, way in zip(true.limits_deg, (-1.0, 1.0), strict=True)
        ]
        ends = [joint.tick(math.radians(limit)) for limit in joint.limits_deg]
        if min(ends) <= min(stops) or max(ends) >= max(stops):
            broken.append(
                f"{joint.name}: limits {sorted(map(round, ends))} beyond its stops {sorted(map(round, stops))}"
            )
        unused_deg = (abs(stops[1] - stops[0]) - abs(ends[1] - ends[0])) * TICK_DEG
        if not grips and joint.name not in arm.blind and unused_deg > 2.0 * UNUSED_DEG:
            broken.append(f"{joint.name}: {unused_deg:.0f} deg of its range are not used")
        if grips and (mine := found.gripper) and (its := arm.kind.gripper):
            ends = [joint.tick(math.radians(deg)) for deg in (mine.open_deg, mine.closed_deg)]
            ends_true = [true.tick(math.radians(deg)) for deg in (its.open_deg, its.closed_deg)]
            if np.abs(np.subtract(ends, ends_true)).max() * TICK_DEG > REST_DEG:
                broken.append(f"{joint.name}: open and closed at {ends}, and it is so at {ends_true}")
        if not grips and abs(joint.rest_deg - true.rest_deg) > REST_DEG:
            broken.append(f"{joint.name}: rests at {joint.rest_deg:.1f} deg, and not at {true.rest_deg:.1f}")
    return broken


def prove(seed: int, tell: Callable[[str], None], *, arms: int = ARMS, workers: int = 1) -> dict[str, Any]:
    """A row for each arm, and everything that was broken.

    Args:
        workers: With several, and on a busy machine, Linux hands on the bytes of pseudo terminals too late for servos.
    """
    began_s = time.monotonic()
    done = carry_out(partial(run, typed=True), [drawn(seed, number) for number in range(arms)], tell, workers)
    return {
        "rows": [{key: one[key] for key in ("kind", "defects", "outcome")} for one in done],
        "runs": len(done),
        "set_up": sum(one["outcome"] == "set up" for one in done),
        "violations": [f"arm {one['seed']} ({one['kind']}, {', '.join(one['defects']) or 'no defect'}): {text}"
                       for one in done for text in one["broken"]],
        "seconds": round(time.monotonic() - began_s, 1),
        "seed": seed,
    }  # fmt: skip
