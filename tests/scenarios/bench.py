"""The programs as a person starts them, and what the scenarios ask of them and of the simulator.

Nothing here waits for time to pass but for what it waits for, with a deadline far beyond what it should take. How
long a thing did take is judged by the stamps of ticks and of the simulator's truth, which share one monotonic clock.
"""

import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from armctl.client import Client
from armctl.clock import NS_PER_S
from armctl.errors import IllegalTransition, RequestRefused
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.inverse import solve_position
from armctl.kinematics.transform import FloatArray
from armctl.sim.control import SimulatorClient, Truth, control_path
from armctl.trajectory.plan import Plan, joint_trajectory
from armctl.trajectory.preflight import DrivenArm
from tests.control.ideal_arm import IdealArm
from tests.host.doubles import small_plan

ARM = load_arm("ax12-line")
CHAIN = robots.get(ARM.robot, ARM.lengths_m).chain
LINE_M = ((0.18, -0.10, 0.10), (0.18, 0.10, 0.10))
SPEED_M_S = 0.1
DEADLINE_S = 30.0
# What the demonstration does takes two minutes of real time; one take of a short line, and one run of it, do the same.
SHORT_DEMO: dict[str, Any] = {
    "TAKES": 1,
    "VIA": (1,),
    "DURATION_S": 2.0,
    "LINES": ((0.18, 0.05, 0.1),),
}

Snapshot = dict[str, Any]


def armctl(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """One command to its end."""
    command = [sys.executable, "-m", "armctl", *arguments]
    return subprocess.run(command, env=environment(folder), capture_output=True, text=True, timeout=DEADLINE_S)


def environment(folder: Path) -> dict[str, str]:
    """This process's environment, every place armctl reads or writes by default moved into `folder`."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("ARMCTL_", "NOTIFY_", "XDG_"))}
    places = {"HOME": "home", "XDG_RUNTIME_DIR": "run", "XDG_DATA_HOME": "data", "XDG_CONFIG_HOME": "config"}
    return kept | {name: str(folder / place) for name, place in places.items()}


@dataclass
class Program:
    """A program of ours that says `ready ...` and runs until it is told otherwise."""

    process: subprocess.Popen[str]
    stderr: Path
    # The line that said that it is ready.
    said: str = ""

    @classmethod
    def start(cls, folder: Path, name: str, *command: str) -> "Program":
        """Start `command` and wait until it is ready; its standard error goes to a file in `folder`."""
        folder.mkdir(parents=True, exist_ok=True)
        stderr = folder / f"{name}-{time.monotonic_ns()}.err"
        with stderr.open("w") as words:
            process = subprocess.Popen(
                [sys.executable, *command], env=environment(folder), stdout=subprocess.PIPE, stderr=words, text=True,
                start_new_session=True,
            )  # fmt: skip
        program = cls(process, stderr)
        assert process.stdout is not None
        if select.select([process.stdout], [], [], DEADLINE_S)[0]:
            program.said = process.stdout.readline()
        if not program.said.startswith("ready "):
            program.end()
            raise AssertionError(f"{name} did not become ready: {stderr.read_text()}")
        return program

    def end(self) -> int:
        """SIGTERM; its exit status."""
        self.process.terminate()
        return self._gone()

    def kill(self) -> int:
        """SIGKILL; when it was killed [ns]."""
        killed_ns = time.monotonic_ns()
        self.process.kill()
        self._gone()
        return killed_ns

    def _gone(self) -> int:
        try:
            return self.process.wait(DEADLINE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise
        finally:
            assert self.process.stdout is not None
            self.process.stdout.close()


@dataclass
class Simulator:
    """Simulated servos on a pseudo terminal, in real time, and the hand beside them."""

    port: Path
    client: SimulatorClient

    def truth(self, begin_ns: int, end_ns: int) -> Truth:
        """What really happened between two instants, once it has."""
        time.sleep(max(0, end_ns - time.monotonic_ns()) / NS_PER_S)
        deadline_ns = time.monotonic_ns() + round(DEADLINE_S * NS_PER_S)
        while not len(seen := self.client.truth(begin_ns, end_ns).time_ns) or seen[-1] < end_ns - 20_000_000:
            assert time.monotonic_ns() < deadline_ns, "the simulator's time stands still"
        return self.client.truth(begin_ns, end_ns)

    def motion_deg(self, begin_ns: int, end_ns: int) -> float:
        """The farthest any joint got between two instants from where it was at the first [deg]."""
        q = np.degrees(self.truth(begin_ns, end_ns).joints_rad)
        return float(np.abs(q - q[0]).max())

    def torque(self) -> list[bool]:
        """Of each servo, whether it has torque."""
        return [servo["torque_enabled"] for servo in self.client.state()["servos"]]

    def goals_rad(self) -> tuple[float, ...]:
        """Where each servo is told to be [rad]."""
        servos = self.client.state()["servos"]
        return tuple(joint.position_rad(servo["goal_tick"]) for joint, servo in zip(ARM.joints, servos, strict=True))


@contextmanager
def simulator(*arguments: str, program: tuple[str, ...] = ("-m", "armctl", "sim")) -> Iterator[Simulator]:
    """`armctl sim`, or a program like it, in a folder of its own with a name short enough for sockets."""
    with tempfile.TemporaryDirectory(prefix="armctl-") as name:
        folder = Path(name)
        port = folder / "port"
        running = Program.start(folder, "sim", *program, *arguments, "--link", str(port))
        try:
            with SimulatorClient(control_path(port)) as client:
                yield Simulator(port, client)
        finally:
            running.end()


@dataclass
class Bench:
    """Daemons, one after the other, on one port, and their clients."""

    folder: Path
    port: Path
    cleanup: ExitStack
    threads: ThreadPoolExecutor
    daemons: list[Program] = field(default_factory=list)
    # Every control process seen.
    controls: list[int] = field(default_factory=list)

    @property
    def socket(self) -> Path:
        return self.folder / "s"

    @property
    def logs(self) -> Path:
        return self.folder / "data" / "armctl" / "logs"

    @property
    def recordings(self) -> Path:
        return self.folder / "data" / "armctl" / "recordings"

    def start_daemon(self, *arguments: str) -> Program:
        """Start `armctl daemon` and wait until it is ready."""
        command = ("daemon", "--port", str(self.port), "--socket", str(self.socket), *arguments)
        program = Program.start(self.folder, "daemon", "-m", "armctl", *command)
        self.daemons.append(program)
        with Client(self.socket, timeout_s=DEADLINE_S) as client:
            self.controls.append(client.call("status")["pids"]["control"])
        return program

    def client(self) -> Client:
        """A new connection, closed with the bench."""
        return self.cleanup.enter_context(Client(self.socket, timeout_s=DEADLINE_S))

    def until(self, condition: Callable[[Snapshot], object]) -> Snapshot:
        """The first snapshot from now on that fulfils the condition."""
        deadline = time.monotonic() + DEADLINE_S
        for snapshot in self.client().subscribe():
            if condition(snapshot):
                return snapshot
            assert time.monotonic() < deadline, f"never came true; last: {snapshot}"
        raise AssertionError("unreachable: snapshots never end")

    def run(self, plan: Plan) -> Future[dict[str, Any]]:
        """The answer of a client that runs the plan."""
        return self.threads.submit(self.client().call, "run", plan=plan.model_dump(mode="json"))

    def run_to_the_middle(self, simulator: Simulator) -> Future[dict[str, Any]]:
        """A run along the line, half way and at full speed when this returns."""
        snapshot = self.until(lambda snapshot: snapshot["tool"])
        plan = line_plan(snapshot)
        trajectory = joint_trajectory(plan, DrivenArm(ARM, robots.of(ARM), snapshot["period_s"]), simulator.goals_rad())
        middle = (trajectory.begin_s + trajectory.end_s) / 2.0 / trajectory.duration_s
        answer = self.run(plan)
        self.until(lambda snapshot: answer.done() or (snapshot["progress"] or 0.0) >= middle)
        assert not answer.done(), f"the run ended early: {answer.exception() or answer.result()}"
        return answer

    def end(self) -> None:
        """End what still runs, orphans included."""
        for program in self.daemons:
            if program.process.poll() is None:
                program.end()
        for pid in self.controls:
            if alive(pid):
                os.kill(pid, signal.SIGKILL)


@contextmanager
def bench(port: Path) -> Iterator[Bench]:
    """A bench without a daemon yet, in a folder whose name is short enough for sockets."""
    with (
        tempfile.TemporaryDirectory(prefix="armctl-") as folder,
        ExitStack() as cleanup,
        ThreadPoolExecutor() as threads,
    ):
        found = Bench(Path(folder), port, cleanup, threads)
        try:
            yield found
        finally:
            found.end()


def alive(pid: int) -> bool:
    """Whether a process runs; one that only waits to be reaped does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def insist(client: Client, method: str, **params: Any) -> dict[str, Any]:
    """What a request comes to that is refused while servos answer late, on a busy machine."""
    deadline = time.monotonic() + DEADLINE_S
    while True:
        try:
            return client.call(method, **params)
        except RequestRefused as refusal:
            if refusal.code not in ("NO_REPLY", "NOT_CLEARED") or time.monotonic() > deadline:
                raise


def bring_up(bench: Bench, simulator: Simulator) -> None:
    """Let the hand carry the limp arm to the start of the line, and torque come on there; nothing if it holds.

    A machine so busy that servos seem silent is no matter of the test that begins here.
    """
    client, deadline = bench.client(), time.monotonic() + DEADLINE_S
    while client.call("status")["state"] != "holding":
        try:
            _lift(bench, client, simulator)
        except (IllegalTransition, RequestRefused):
            if client.call("status")["fault"] is None or time.monotonic() > deadline:
                raise
            client.call("release", confirm=True)
            insist(client, "clear")


def _lift(bench: Bench, client: Client, simulator: Simulator) -> None:
    client.call("teach_begin", confirm=True)
    x, y, z = LINE_M[0]
    # The hand supports the arm where a take ends, for as long as nobody lets go.
    guided = simulator.client.guide((x, y + 0.02, z + 0.01), (x, y, z), seed=1, duration_s=0.5)
    end_ns = time.monotonic_ns() + round(guided.duration_s * NS_PER_S)
    bench.until(lambda _: time.monotonic_ns() > end_ns)
    client.call("teach_end")
    assert insist(client, "torque_on") == {"state": "holding"}
    simulator.client.let_go()


def line_plan(snapshot: Snapshot) -> Plan:
    """A plan along the line from where the tool is now to the farther end, 0.1 to 0.2 m."""
    (x, low, z), (_, high, _) = LINE_M
    begin = min(max(snapshot["tool"]["position_m"][1], low), high)
    end = low if begin > 0.0 else high
    progress = (0.0, 0.25, 0.5, 0.75, 1.0)
    limits = np.array([joint.limits_rad for joint in ARM.joints[: CHAIN.n]])
    q: FloatArray = np.radians([0.0, 87.0, -65.0, -64.0, -33.0])
    waypoints = []
    for share in progress:
        q = solve_position(CHAIN, np.array((x, begin + share * (end - begin), z)), q, limits)
        waypoints.append((*q.tolist(), 0.0))
    return small_plan(
        IdealArm(),
        from_m=(x, begin, z),
        to_m=(x, end, z),
        duration_s=abs(end - begin) / SPEED_M_S,
        via=len(progress) - 2,
        interpolation="cubic",
        waypoints_rad=tuple(waypoints),
        waypoint_progress=progress,
    )
