"""SIGKILL of either process at random moments of a motion, judged by where the simulated arm really went.

One simulator lives through all runs; daemons die and are started again, as a service manager would at once. In each run
the arm moves between random poses near rest, joints up to their speed limit, and the control process or the host is
killed somewhere between the motion's begin and its end. Then:

1. Every joint comes to within `SETTLED_RAD` of where it stays within 250 ms, and turns by 10 deg at most on the way.
2. Another control process holds the arm within 2 s of the kill.
3. It takes the arm as it finds it: from 250 ms on no goal changes, no torque, and no joint by more than `SETTLED_RAD`.
4. Whoever asked for the motion is told that it was not done.

A shaft trails behind its goal and creeps the last tenths of a degree as stiction lets go of it: hence `SETTLED_RAD`.

A run in which servos fell silent while the kernel kept bytes back for a tick or more says nothing about a kill: it is
told, not judged, and repeated, a tenth of the runs at most.

Three delays are the machine's, are measured in the same moments, and are allowed for: how long the killed process took
to be gone (it needs a processor for that too, and only then does the other one learn of it), how long the kernel kept
back what one program had told another over a pseudo terminal (a goal that was sent before the kill may reach the servos
so much later), and how long the new processes were ready to run and had no processor. On a machine with nothing else to
do they are a few milliseconds each.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from armctl.client import Client
from armctl.clock import NS_PER_S
from armctl.config import ArmConfig
from armctl.errors import ArmctlError
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.transform import FloatArray
from armctl.lab.demo import started
from armctl.sim.control import SimulatorClient, control_path
from armctl.trajectory.plan import Plan, joint_trajectory, preflight
from armctl.trajectory.preflight import DrivenArm
from proving.rig import ARM, KernelWatch, OtherWork, hold, installed, waited_s

RUNS = 200
STOP_S = 0.25
TRAVEL_RAD = math.radians(10.0)
FASTEST_DEG_S = 60.0
ADOPT_S = 2.0
SETTLED_RAD = math.radians(0.5)
# What a machine that keeps bytes back makes of servos that answer.
UNHEARD = ("SERVO_SILENT", "BUS_DEAD", "a fault is latched")
KEPT_BACK_S = 0.1
MACHINE_BEFORE_NS = NS_PER_S
# Of the runs.
MOST_UNJUDGED = 0.1
# How long the arm is watched after it was adopted.
WATCH_S = 0.3
PATIENCE_S = 20.0
# Control processes killed before it is the host's turn: a daemon whose control process dies oftener waits longer.
CONTROLS_A_DAEMON = 4
SPREAD_DEG = (60.0, 25.0, 25.0, 40.0, 60.0, 90.0)
# Poses the arm moves between: high enough that no way between two of them comes near the table.
CENTRE_DEG = (0.0, 130.0, -115.0, 60.0, 0.0, 0.0)

Victim = Literal["control", "host"]


@dataclass
class Run:
    """What one kill showed; times count from it."""

    victim: Victim
    stop_ms: float = math.nan
    travel_deg: float = math.nan
    adopt_s: float = math.nan
    # From the kill until the process was gone.
    dying_s: float = 0.0
    # The kernel's longest delay around the kill.
    kept_back_s: float = 0.0
    # How long the new processes waited for a processor.
    waited_s: float = 0.0
    # Of the fastest joint in the 50 ms before the kill.
    speed_deg_s: float = math.nan
    violations: list[str] = field(default_factory=list)
    # Why nothing follows from this run: the machine kept the arm from being heard.
    unjudged: str = ""


def prove(seed: int, runs: int = RUNS, tell: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Kill so often; every run is judged, a broken one included, but those that the machine broke are repeated."""
    rng = np.random.default_rng(seed)
    done: list[Run] = []
    unjudged: list[Run] = []
    with tempfile.TemporaryDirectory(prefix="armctl-") as name, contextlib.ExitStack() as cleanup:
        folder = Path(name)
        port = folder / "servos"
        cleanup.enter_context(installed(folder / "bytecode"))
        cleanup.enter_context(started(folder / "simulator.log", "sim", "--link", str(port), "--seed", str(seed)))
        simulator = cleanup.enter_context(SimulatorClient(control_path(port)))
        kernel = KernelWatch()
        cleanup.callback(kernel.close)
        bench = _Bench(folder, port, simulator, kernel, rng)
        cleanup.callback(bench.end)
        bench.start()
        other_work = OtherWork()
        victims = _victims(rng, runs)
        while len(done) < runs:
            run = Run(victim := victims[len(done)])
            begin_ns = time.monotonic_ns()
            try:
                bench.kill_once(run)
            except (ArmctlError, AssertionError, OSError) as error:
                run.violations.append(f"{type(error).__name__}: {error}")
            silent_s = kernel.worst_s(begin_ns - MACHINE_BEFORE_NS, time.monotonic_ns())
            excuse(run, silent_s, may=len(unjudged) < MOST_UNJUDGED * runs)
            (unjudged if run.unjudged else done).append(run)
            told = run.unjudged or "; ".join(run.violations) or "ok"
            tell(
                f"{len(done)}/{runs} {victim}: at {run.speed_deg_s:.0f} deg/s, stopped in {run.stop_ms:.0f} ms and "
                f"{run.travel_deg:.1f} deg, adopted in {run.adopt_s:.2f} s (gone in {1e3 * run.dying_s:.0f} ms, kernel "
                f"{1e3 * run.kept_back_s:.0f} ms, waited {run.waited_s:.2f} s); {told}"
            )
    return {
        "runs": len(done),
        "violations": sum(len(run.violations) for run in done),
        **_worst(done),
        **{victim: _figures([run for run in done if run.victim == victim]) for victim in ("control", "host")},
        "other_work_cores": other_work.cores(),
        "unjudged": [f"{run.victim}: {run.unjudged}" for run in unjudged],
        "examples": [f"{run.victim}: {text}" for run in done for text in run.violations][:10],
        "seed": seed,
    }


def excuse(run: Run, kept_back_s: float, *, may: bool) -> None:
    """Take out of judgement what the machine broke: servos unheard of while the kernel kept bytes back for a tick."""
    unheard = [text for text in run.violations if any(code in text for code in UNHEARD)]
    if may and unheard and len(unheard) == len(run.violations) and kept_back_s >= KEPT_BACK_S:
        run.unjudged = f"not judged, the kernel kept bytes back for {1e3 * kept_back_s:.0f} ms: {unheard[0]}"
        run.violations.clear()


def _victims(rng: np.random.Generator, runs: int) -> list[Victim]:
    """Whom to kill, at random, but the host after `CONTROLS_A_DAEMON` control processes at the latest."""
    victims: list[Victim] = []
    for _ in range(runs):
        overdue = victims[-CONTROLS_A_DAEMON:] == ["control"] * CONTROLS_A_DAEMON
        victims.append("host" if overdue or rng.random() < 0.5 else "control")
    return victims


def _figures(done: list[Run]) -> dict[str, Any]:
    stops_ms = [run.stop_ms for run in done if not math.isnan(run.stop_ms)]
    median = {"p50_stop_ms": _round(np.median(stops_ms))} if stops_ms else {}
    return {"runs": len(done), **_worst(done), **median}


def _worst(done: list[Run]) -> dict[str, float | None]:
    """The greatest of each figure; null where no run came so far."""
    names = {
        "stop_ms": "worst_stop_ms",
        "travel_deg": "worst_travel_deg",
        "adopt_s": "worst_adopt_s",
        "dying_s": "worst_dying_s",
        "kept_back_s": "worst_kept_back_s",
        "waited_s": "worst_waited_s",
    }
    return {
        key: _round(max((value for run in done if not math.isnan(value := getattr(run, name))), default=math.nan))
        for name, key in names.items()
    }


def _round(value: float) -> float | None:
    return None if math.isnan(value) else round(float(value), 3)


class _Bench:
    """The simulated arm, and the daemon of the moment."""

    def __init__(
        self, folder: Path, port: Path, simulator: SimulatorClient, kernel: KernelWatch, rng: np.random.Generator
    ) -> None:
        self.folder, self.port, self.simulator, self.kernel, self.rng = folder, port, simulator, kernel, rng
        self.socket = folder / "daemon.sock"
        self.arm: ArmConfig = load_arm(ARM)
        self.robot = robots.get(self.arm.robot, self.arm.lengths_m)
        self._config = folder / "armctl.yaml"
        text = yaml.safe_dump({"port": str(port), "arm": ARM, "data_dir": str(folder)})
        self._config.write_text(text, encoding="utf-8")
        self._daemon = contextlib.ExitStack()
        self._watcher = SimulatorClient(control_path(port))
        self._kept: list[tuple[int, bool, int]] = []
        self.host_pid = 0

    def start(self) -> None:
        """Start a daemon; returns when it serves."""
        command = ("daemon", "--config", str(self._config), "--socket", str(self.socket))
        self.host_pid = self._daemon.enter_context(started(self.folder / "daemon.log", *command))[0].pid

    def end(self) -> None:
        self._daemon.close()
        self._watcher.close()

    def goals_rad(self) -> tuple[float, ...]:
        servos = self.simulator.state()["servos"]
        return tuple(
            joint.position_rad(servo["goal_tick"]) for joint, servo in zip(self.arm.joints, servos, strict=True)
        )

    def kill_once(self, run: Run) -> None:
        """One motion, one kill, one adoption."""
        with Client(self.socket, timeout_s=PATIENCE_S) as client:
            run.violations += [f"found with {fault}" for fault in hold(client, PATIENCE_S)]
            status = client.call("status")
            plan = self._plan()
            trajectory = joint_trajectory(plan, DrivenArm(self.arm, self.robot, status["period_s"]), self.goals_rad())
            into_s = self.rng.uniform(trajectory.begin_s, trajectory.end_s)
            mover = _Mover(self.socket, plan)
            _until(client, lambda status: status["state"] == "moving" or mover.ended)
            time.sleep(into_s)
            assert not mover.ended, f"the motion ended before the kill: {mover.answer}"
            waited_before_s = waited_s(self.host_pid)
            killed_ns = self._kill(run, status["pids"]["control"])
        if run.victim == "host":
            self.start()
        with Client(self.socket, timeout_s=PATIENCE_S) as client:
            _until(client, lambda now: now["pids"]["control"] not in (None, status["pids"]["control"]))
            back = _until(client, lambda now: now["state"] in ("holding", "faulted"))
            adopted_ns = time.monotonic_ns()
        waited_host_s = waited_s(self.host_pid) - (waited_before_s if run.victim == "control" else 0.0)
        run.waited_s = max(waited_host_s, waited_s(back["pids"]["control"]))
        run.kept_back_s = self.kernel.worst_s(killed_ns - 2 * round(status["period_s"] * NS_PER_S), adopted_ns)
        run.adopt_s = (adopted_ns - killed_ns) / NS_PER_S
        time.sleep(WATCH_S)
        self._judge(run, killed_ns, time.monotonic_ns(), mover)

    def _kill(self, run: Run, control_pid: int) -> int:
        """When [ns]. Meanwhile the registers are read as soon as nothing may change them any more."""
        pid = control_pid if run.victim == "control" else self.host_pid
        handle = os.pidfd_open(pid)
        killed_ns = time.monotonic_ns()
        os.kill(pid, signal.SIGKILL)
        select.select((handle,), (), (), PATIENCE_S)
        run.dying_s = (time.monotonic_ns() - killed_ns) / NS_PER_S
        os.close(handle)
        self._keeping = threading.Thread(target=self._keep, args=(run, killed_ns), daemon=True)
        self._keeping.start()
        if run.victim == "host":
            self._daemon.close()  # reaps it
        return killed_ns

    def _keep(self, run: Run, killed_ns: int) -> None:
        time.sleep(max(0.0, STOP_S + run.dying_s - (time.monotonic_ns() - killed_ns) / NS_PER_S))
        time.sleep(self.kernel.worst_s(killed_ns, time.monotonic_ns()))
        self._kept = _registers(self._watcher)

    def _judge(self, run: Run, killed_ns: int, end_ns: int, mover: _Mover) -> None:
        truth = self.simulator.truth(killed_ns - NS_PER_S // 20, end_ns)
        after = truth.time_ns >= killed_ns
        q, time_s = truth.joints_rad[after], (truth.time_ns[after] - killed_ns) / NS_PER_S
        before = truth.joints_rad[~after]
        if len(before) > 1:
            took_s = float(truth.time_ns[~after][-1] - truth.time_ns[0]) / NS_PER_S
            run.speed_deg_s = math.degrees(float(np.abs(before[-1] - before[0]).max())) / took_s
        judge(run, q, time_s)
        self._keeping.join()
        if (now := _registers(self.simulator)) != self._kept:
            run.violations.append(f"goal, torque or torque limit changed: {self._kept} became {now}")
        if not all(torque for _, torque, _ in self._kept):
            run.violations.append("torque went off")
        if not mover.refused:
            run.violations.append(f"the motion was answered as done: {mover.answer}")

    def _plan(self) -> Plan:
        """A permitted motion from here to a random pose, its fastest joint at 50 to 100 % of what its limit allows."""
        start = self.goals_rad()
        while True:
            target = np.radians(self.rng.uniform(np.subtract(CENTRE_DEG, SPREAD_DEG), np.add(CENTRE_DEG, SPREAD_DEG)))
            low, high = np.array([joint.limits_rad for joint in self.arm.joints]).T
            duration_s = 1.0 / self.rng.uniform(0.5, 1.0)
            while duration_s < 8.0:
                plan = self._plan_to(start, np.clip(target, low, high), duration_s)
                reasons = preflight(plan, DrivenArm(self.arm, self.robot, 0.1), start)
                if not reasons:
                    return plan
                if not all("duration of" in reason for reason in reasons):
                    break  # not this way at all
                duration_s *= 1.1

    def _plan_to(self, start: tuple[float, ...], target: FloatArray, duration_s: float) -> Plan:
        return Plan(
            arm_id=self.arm.arm_id,
            calibration_hash=self.arm.calibration_hash,
            from_m=(0.0, 0.0, 0.0),
            to_m=(0.0, 0.1, 0.0),
            duration_s=duration_s,
            via=0,
            interpolation="cubic",
            waypoints_rad=(start, tuple(target.tolist())),
            waypoint_progress=(0.0, 1.0),
            predicted_mean_error_mm=0.0,
            predicted_max_error_mm=0.0,
            seed=0,
        )


def _registers(simulator: SimulatorClient) -> list[tuple[int, bool, int]]:
    """What no restart may change: goal, torque and torque limit of each servo."""
    return [
        (servo["goal_tick"], servo["torque_enabled"], servo["torque_limit"]) for servo in simulator.state()["servos"]
    ]


def judge(run: Run, q: FloatArray, time_s: FloatArray) -> None:
    """Complete a run with what the true joint positions show.

    Args:
        q: From the kill on [rad], shape (m, joints).
        time_s: Since the kill, shape (m,).
    """
    away = np.flatnonzero((np.abs(q - q[-1]) > SETTLED_RAD).any(axis=1))
    run.stop_ms = 1e3 * float(time_s[away[-1]]) if len(away) else 0.0
    run.travel_deg = math.degrees(float(np.abs(q - q[0]).max()))
    machine_s = run.dying_s + run.kept_back_s
    stop_s = STOP_S + machine_s
    travel_deg = math.degrees(TRAVEL_RAD) + FASTEST_DEG_S * machine_s
    late = q[time_s >= stop_s]
    jump_deg = math.degrees(float(np.abs(late - late[0]).max())) if len(late) else 0.0
    if run.stop_ms > 1e3 * stop_s:
        run.violations.append(f"moved for {run.stop_ms:.0f} ms after the kill")
    if run.travel_deg > travel_deg:
        run.violations.append(f"turned by {run.travel_deg:.1f} deg after the kill")
    if jump_deg > math.degrees(SETTLED_RAD):
        run.violations.append(f"moved by {jump_deg:.2f} deg from {1e3 * stop_s:.0f} ms on")
    if not run.adopt_s - run.waited_s - machine_s <= ADOPT_S:
        run.violations.append(f"adopted after {run.adopt_s:.2f} s")


class _Mover:
    """A client that runs a plan in a thread of its own."""

    def __init__(self, socket: Path, plan: Plan) -> None:
        self.answer, self.refused = "", False
        self._socket, self._plan = socket, plan
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def ended(self) -> bool:
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            with Client(self._socket, timeout_s=PATIENCE_S) as client:
                self.answer = str(client.call("run", plan=self._plan.model_dump(mode="json")))
        except ArmctlError as error:
            self.answer, self.refused = str(error), True


def _until(client: Client, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """The first status that fulfils the condition."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not holds(status := client.call("status")):
        assert time.monotonic() < deadline_s, f"never came: the daemon is {status['state']}, fault {status['fault']}"
        time.sleep(0.01)
    return status
