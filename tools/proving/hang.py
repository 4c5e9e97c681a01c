"""SIGSTOP of a process at random instants, judged by where the simulated arm really goes and what the status says.

The arm moves, is jogged, goes to rest or is taught. Then the host, its control process, the dashboard or the simulator
is stopped, and goes on after `HANG_S` (a control process that hangs is killed before that). Judged in every run:

1. Host: every joint stands within `REST_S` (0.3 s of silence, a tick, 0.2 s to slow down, the last goal), and stays. A
   STOP on its own lane is answered within `STOP_S` once the arm stands.
2. Control process: the arm stands within `REST_S`, another process adopts it within `ADOPT_S`. The status never tells
   of a motion from a tick that is older than its period and `STALE_S`.
3. Dashboard: nothing changes for the arm; the motion ends as asked.
4. Simulator: it stands for an arm without supply. The silence latches; `clear` leads back.
5. Within `TRUE_S` of coming back the status says what the servos do. No torque changes.

What the kernel kept back over the pseudo terminal meanwhile is measured and added to the time in which the arm stands.

Afterwards a busy machine is watched, on which nothing hangs (`busy_machine.py`): no false alarm.
"""

import contextlib
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np

from armctl.client import Client
from armctl.clock import NS_PER_S
from armctl.errors import ArmctlError
from armctl.kinematics.transform import FloatArray
from proving.busy_machine import HOURS, watch
from proving.rig import Rig, hold, rig

RUNS = 200
REST_S = 0.7
STOP_S = 0.15
ADOPT_S = 2.0
STALE_S = 0.3
TRUE_S = 0.3
HANG_S = 1.5
SETTLED_RAD = math.radians(0.5)
PATIENCE_S = 20.0
# The base turns at 50 deg/s in the middle of it.
SWING_S = 2.5
SWING_RAD = math.radians(60.0)
HANGS_AFTER_S = (0.2, 1.8)
# Where every run begins: no way from here comes near the table.
CENTRE_DEG = (0.0, 130.0, -115.0, 60.0, 0.0, 0.0)
TO_CENTRE_S = 4.0
JOG_RAD_S = math.radians(15.0)
MOVING = ("moving", "jogging", "parking")

Victim = Literal["host", "control", "web", "simulator"]
VICTIMS: tuple[Victim, ...] = get_args(Victim)
STATES = (*MOVING, "teaching")


@dataclass
class Run:
    """What one hang showed; times count from it."""

    victim: Victim
    state: str
    # Until every joint stood where it stays.
    rest_s: float = 0.0
    # Until a STOP on its lane was answered.
    stop_s: float = 0.0
    adopt_s: float = 0.0
    kept_back_s: float = 0.0
    violations: list[str] = field(default_factory=list)


def prove(
    seed: int, runs: int = RUNS, hours: float = HOURS, tell: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Stop each kind of process so often, then watch a busy machine for so long."""
    rng = np.random.default_rng(seed)
    order = [(victim, STATES[number % len(STATES)]) for number in range(runs) for victim in VICTIMS]
    done: list[Run] = []
    while len(done) < len(order):
        before = len(done)
        try:
            with rig(seed=seed) as running, _dashboard(running) as web:
                _hang_on(running, web, order, done, rng, tell)
        except ArmctlError as error:
            if len(done) == before:
                raise
            done[-1].violations.append(f"the programs did not end: {error}")
    watched = watch(seed, hours, tell) if hours else {"violations": []}
    return {
        "runs": len(done),
        "violations": sum(len(run.violations) for run in done) + len(watched["violations"]),
        **{
            f"worst_{name}": round(max((getattr(run, name) for run in done), default=0.0), 3)
            for name in ("rest_s", "stop_s", "adopt_s")
        },
        "by_victim": [
            {"victim": victim, "runs": len(own), "violations": sum(len(run.violations) for run in own)}
            for victim in VICTIMS
            if (own := [run for run in done if run.victim == victim])
        ],
        "busy_machine": {key: value for key, value in watched.items() if key != "violations"},
        "examples": [
            *[f"{run.victim} {run.state}: {text}" for run in done for text in run.violations][:10],
            *watched["violations"][:10],
        ],
        "seed": seed,
    }


def _hang_on(
    running: Rig,
    web: int,
    order: Sequence[tuple[Victim, str]],
    done: list[Run],
    rng: np.random.Generator,
    tell: Callable[[str], None],
) -> None:
    """One hang after another, up to one that shows a violation: behind it a fresh rig is wanted."""
    while len(done) < len(order):
        run = Run(*order[len(done)])
        begin_ns = time.monotonic_ns()
        try:
            _hang_once(running, web, run, rng)
        except (ArmctlError, AssertionError, OSError) as error:
            run.violations.append(f"{type(error).__name__}: {error}")
        run.kept_back_s = running.kernel.worst_s(begin_ns, time.monotonic_ns())
        done.append(run)
        tell(f"{len(done)}/{len(order)} {run.victim} {run.state}: {_told(run)}")
        if run.violations:
            return


def _told(run: Run) -> str:
    figures = f"stood in {run.rest_s:.2f} s, STOP {1e3 * run.stop_s:.0f} ms, adopted in {run.adopt_s:.2f} s"
    return f"{figures} (kernel {1e3 * run.kept_back_s:.0f} ms); {'; '.join(run.violations) or 'ok'}"


@contextlib.contextmanager
def _dashboard(running: Rig) -> Iterator[int]:
    """`armctl web` on this daemon; its process."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    command = [sys.executable, "-m", "armctl", "web", "--port", str(port), "--socket", str(running.socket)]
    config = running.socket.with_name("armctl.yaml")
    web = subprocess.Popen([*command, "--config", str(config)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert web.stdout is not None
    with web, web.stdout:
        try:
            assert web.stdout.readline().startswith(b"ready ")
            yield web.pid
        finally:
            web.kill()


# ---------------------------------------------------------------------------------------------------- one run


def _hang_once(running: Rig, web: int, run: Run, rng: np.random.Generator) -> None:
    _to_centre(running)
    with _in_state(running, run.state) as asked:
        time.sleep(rng.uniform(*HANGS_AFTER_S))
        status = running.client.call("status")
        assert status["state"] == run.state, f"the arm is {status['state']}, not {run.state}"
        pids = {**status["pids"], "host": running.daemon_pid, "web": web, "simulator": running.simulator_pid}
        torque = _torque(running)
        seen_from = len(running.seen.snapshots)
        hung_ns = time.monotonic_ns()
        os.kill(pids[run.victim], signal.SIGSTOP)
        try:
            _while_it_hangs(running, run, pids["control"], hung_ns)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pids[run.victim], signal.SIGCONT)
        _when_it_is_back(running, run)
        if run.victim == "web" and run.state in MOVING:
            assert asked.answer(), f"the {run.state} was not done: {asked.error}"
    _judge(running, run, hung_ns, seen_from)
    if (now := _torque(running)) != torque and run.state != "parking":
        run.violations.append(f"torque changed: {torque} became {now}")


def _while_it_hangs(running: Rig, run: Run, control_pid: int, hung_ns: int) -> None:
    if run.victim == "control":
        deadline_s = time.monotonic() + PATIENCE_S
        while (status := running.client.call("status"))["pids"]["control"] in (None, control_pid):
            if status["state"] in MOVING and (status["age_s"] or 0.0) > status["period_s"] + STALE_S:
                run.violations.append(f"{status['state']} told from a tick {status['age_s']:.2f} s old")
            assert time.monotonic() < deadline_s, "nobody replaced it"
            time.sleep(0.02)
        while (status := running.client.call("status"))["state"] not in ("holding", "off", "faulted"):
            assert time.monotonic() < deadline_s, f"nobody adopted the arm: {status['state']}"
            time.sleep(0.02)
        run.adopt_s = (time.monotonic_ns() - hung_ns) / NS_PER_S
    elif run.victim == "host":
        time.sleep(REST_S + 0.1)
        begin_s = time.monotonic()
        with socket.socket(socket.AF_UNIX) as lane:
            lane.settimeout(PATIENCE_S)
            lane.connect(f"{running.socket}.stop")
            lane.sendall(b"stop\n")
            answer = lane.recv(99)
        run.stop_s = time.monotonic() - begin_s
        if not answer.startswith(b"ok "):
            run.violations.append(f"STOP was answered {answer!r}")
    time.sleep(max(0.0, HANG_S - (time.monotonic_ns() - hung_ns) / NS_PER_S))


def _when_it_is_back(running: Rig, run: Run) -> None:
    time.sleep(TRUE_S)
    status = running.client.call("status")
    truth = running.simulator.state()
    # A way to rest may end just now: the status tells of the tick before.
    lately_ns = time.monotonic_ns() - round(2.0 * status["period_s"] * NS_PER_S)
    seen = [servos for at_ns, servos in running.seen.servos if at_ns > lately_ns] + [truth["servos"]]
    wanted = {all(servo["torque_enabled"] for servo in servos) for servos in seen}
    if run.victim == "simulator":
        # Its servos were silent: that is told, and acknowledged.
        if status["state"] != "faulted":
            run.violations.append(f"silent servos, and the arm is {status['state']}")
        hold(running.client, PATIENCE_S) if True in wanted else _cleared(running)
        return
    told = all(joint["torque_enabled"] for joint in status["joints"])
    away = max(abs(joint["position_rad"] - q) for joint, q in zip(status["joints"], truth["joints_rad"], strict=True))
    if told not in wanted or (run.victim != "web" and run.state != "teaching" and away > 2.0 * SETTLED_RAD):
        run.violations.append(
            f"{TRUE_S} s after it came back: torque told {told}, is {wanted}, away {math.degrees(away):.1f} deg"
        )
    if run.victim == "host" and status["state"] in MOVING:
        run.violations.append(f"{TRUE_S} s after it came back the arm is said to be {status['state']}")


def _judge(running: Rig, run: Run, hung_ns: int, seen_from: int) -> None:
    # A limp arm goes where gravity and the hand lead it.
    if run.victim in ("host", "control") and run.state != "teaching":
        truth = running.simulator.truth(hung_ns, hung_ns + round(HANG_S * NS_PER_S))
        run.rest_s = stood_after_s(truth.joints_rad, (truth.time_ns - hung_ns) / NS_PER_S)
        bound_s = REST_S + running.kernel.worst_s(hung_ns, hung_ns + NS_PER_S)
        if run.rest_s > bound_s:
            run.violations.append(f"moved for {run.rest_s:.2f} s")
    if run.stop_s > STOP_S:
        run.violations.append(f"STOP was answered after {1e3 * run.stop_s:.0f} ms")
    if run.adopt_s > ADOPT_S:
        run.violations.append(f"adopted after {run.adopt_s:.2f} s")
    codes = {snapshot["fault"]["code"] for _, snapshot in running.seen.snapshots[seen_from:] if snapshot["fault"]}
    allowed = {"host": set[str](), "web": set[str](), "control": {"RESTARTED"}}
    if run.victim != "simulator" and codes - allowed[run.victim]:
        run.violations.append(f"faults: {', '.join(sorted(codes - allowed[run.victim]))}")


def stood_after_s(q: FloatArray, time_s: FloatArray) -> float:
    """From when on every joint stays where it is in the end.

    Args:
        q: True joint positions [rad], shape (m, joints).
        time_s: When, shape (m,).
    """
    away = np.flatnonzero((np.abs(q - q[-1]) > SETTLED_RAD).any(axis=1))
    return float(time_s[away[-1]]) if len(away) else 0.0


def _torque(running: Rig) -> list[bool]:
    return [servo["torque_enabled"] for servo in running.simulator.state()["servos"]]


def _cleared(running: Rig) -> None:
    assert running.wait(lambda s: s["fault"] is not None, PATIENCE_S)
    deadline_s = time.monotonic() + PATIENCE_S
    while running.client.call("status")["fault"] is not None and time.monotonic() < deadline_s:
        with contextlib.suppress(ArmctlError):
            running.client.call("clear")
        time.sleep(0.1)


# --------------------------------------------------------------------------------------- what the arm does


def _to_centre(running: Rig) -> None:
    hold(running.client, PATIENCE_S)
    running.simulator.let_go()
    centre = np.radians(CENTRE_DEG)
    q = np.array([joint["position_rad"] for joint in running.client.call("status")["joints"]])
    if np.abs(q - centre).max() > math.radians(3.0):
        running.client.call("move", joints_rad=centre.tolist(), duration_s=TO_CENTRE_S)


class _Asked:
    """A client that asks for what the arm does, in a thread of its own."""

    def __init__(self, work: Callable[[], object]) -> None:
        self.error: Exception | None = None
        self._work = work
        self._thread = threading.Thread(target=self._ask, daemon=True)
        self._thread.start()

    def answer(self) -> bool:
        """Whether it was done, once that is known."""
        self._thread.join(PATIENCE_S + SWING_S)
        return not self._thread.is_alive() and self.error is None

    def _ask(self) -> None:
        try:
            self._work()
        except (ArmctlError, OSError) as error:
            self.error = error


@contextlib.contextmanager
def _in_state(running: Rig, state: str) -> Iterator[_Asked]:
    """The arm in a state, reached from holding; held again afterwards by whoever comes next."""
    ending = threading.Event()
    with Client(running.socket, timeout_s=PATIENCE_S) as client:

        def jog() -> None:
            velocity, begin, until_s = [JOG_RAD_S] + [0.0] * 5, True, time.monotonic() + SWING_S
            while not ending.is_set() and time.monotonic() < until_s:
                client.call("jog", joints_rad_s=velocity, begin=begin)
                begin = False

        def teach() -> None:
            # The hand holds the arm where it comes limp.
            x, y, z = running.client.call("status")["tool"]["position_m"]
            running.simulator.guide((x, y, z), (x, y, z + 0.01), seed=1, duration_s=0.5)
            client.call("teach_begin", confirm=True)

        swung = [math.radians(CENTRE_DEG[0]) + SWING_RAD, *np.radians(CENTRE_DEG[1:]).tolist()]
        works: dict[str, Callable[[], object]] = {
            "moving": lambda: client.call("move", joints_rad=swung, duration_s=SWING_S),
            "jogging": jog,
            "parking": lambda: client.call("park"),
            "teaching": teach,
        }
        asked = _Asked(works[state])
        try:
            assert running.wait(lambda s: s["state"] == state, PATIENCE_S), f"never {state}: {asked.error}"
            yield asked
        finally:
            ending.set()
            asked.answer()
