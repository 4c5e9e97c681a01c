"""A client that ends in the middle of its motion, judged by where the simulated arm really goes.

The client is a program of its own that uses `Arm` as people do. It moves, follows a path, plays, runs a program or
jogs: the base turns at up to 45 deg/s. It ends at a random instant:

- interrupted: SIGINT, and it goes.
- notebook: SIGINT, and it keeps its connection, as the kernel of a notebook does.
- killed: SIGKILL.
- forked: SIGKILL, while a child that it forked lives on.
- cut off: somebody between it and the daemon closes the connection.

Then, by the simulator's truth alone:

1. Every joint is within half a degree of where it stays `STOP_S` after the end. What the kernel kept back over the
   pseudo terminal meanwhile is measured and allowed for; how many runs needed that is told.
2. Torque stays on.

A run in which the arm did not turn when the client ended (between its way to a path and the path, say) shows nothing.
It is repeated, and told.
"""

import contextlib
import json
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from armctl.clock import NS_PER_S
from armctl.errors import ArmctlError, RequestRefused
from armctl.kinematics.transform import FloatArray
from proving.hang import CENTRE_DEG, stood_after_s
from proving.rig import OtherWork, Rig, hold, rig

RUNS = 200
STOP_S = 0.5
# The arm is watched for so long after the end: any of the motions would go on for most of it.
WATCH_S = 1.2
SWING_RAD = math.radians(60.0)
SWING_S = 2.5
# On average.
RETURN_RAD_S = math.radians(25.0)
JOG_RAD_S = math.radians(18.0)
# The client ends so long after the base was seen to turn, and no longer slowly: on its way to where it begins.
ENDS_AFTER_S = (0.0, 0.8)
SEEN_RAD_S = math.radians(15.0)
# Over the last tick before the end, of the fastest joint.
SLOWEST_DEG_S = 3.0
# Of the runs.
MOST_STILL = 0.05
PATIENCE_S = 20.0
# Why the arm may not come back to its begin at once: Linux hands on the bytes of a pseudo terminal late, say.
TOO_BUSY = ("BUSY", "HOST_SILENT", "SERVO_SILENT", "BUS_DEAD")

Way = Literal["interrupted", "notebook", "killed", "forked", "cut off"]
Motion = Literal["move", "path", "play", "program", "jog"]
WAYS: tuple[Way, ...] = get_args(Way)
MOTIONS: tuple[Motion, ...] = get_args(Motion)

# What it is told: socket and way; then, as a line, method and parameters.
CLIENT = """
import json, os, signal, sys, time
from armctl import Arm

signal.signal(signal.SIGINT, signal.default_int_handler)  # also where the proof itself runs in the background
socket, way = sys.argv[1:]
try:
    with Arm(socket) as arm:
        child = os.fork() if way == "forked" else -1
        if child == 0:
            os.close(0)
            while True:
                signal.pause()
        print(child, flush=True)
        method, params = json.loads(sys.stdin.readline())
        try:
            getattr(arm, method)(**params)
        except KeyboardInterrupt:
            if way != "notebook":
                raise
            time.sleep(60.0)
except KeyboardInterrupt:
    sys.exit(130)
"""


@dataclass
class Run:
    """What one end showed; times count from it."""

    way: Way
    motion: Motion
    # Until every joint stood where it stays.
    rest_s: float = 0.0
    # Of the fastest joint just before.
    speed_deg_s: float = 0.0
    kept_back_s: float = 0.0
    violations: list[str] = field(default_factory=list)

    @property
    def still(self) -> bool:
        """Whether the arm did not turn, so that nothing follows."""
        return not self.violations and self.speed_deg_s < SLOWEST_DEG_S


def prove(seed: int, runs: int = RUNS, tell: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """So many ends, every way with every motion in turn."""
    rng, done, still = np.random.default_rng(seed), list[Run](), 0
    pairs = tuple(zip(WAYS * len(MOTIONS), _turned(), strict=True))
    other_work = OtherWork()
    with rig(seed=seed) as running:
        _to_centre(running)
        taught = [_swing(running, sign) for sign in (1, -1)]
        while len(done) < runs:
            run = Run(*pairs[len(done) % len(pairs)])
            try:
                _end_once(running, run, taught, rng)
            except (ArmctlError, AssertionError, OSError, subprocess.TimeoutExpired) as error:
                run.violations.append(f"{type(error).__name__}: {error}")
            if run.still:
                still += 1
                if still <= max(1, MOST_STILL * runs):
                    continue
                run.violations.append("the arm did not turn when the client ended, and so oftener than allowed")
            done.append(run)
            told = "; ".join(run.violations) or "ok"
            tell(
                f"{len(done)}/{runs} {run.way}, {run.motion}: at {run.speed_deg_s:.0f} deg/s, stood in "
                f"{run.rest_s:.2f} s (kernel {1e3 * run.kept_back_s:.0f} ms); {told}"
            )
    return {
        "runs": len(done),
        "violations": sum(len(run.violations) for run in done),
        "stopped_in_time": sum(not run.violations for run in done),
        "still": still,
        "allowed_for": sum(not run.violations and run.rest_s > STOP_S for run in done),
        "worst_rest_s": round(max((run.rest_s for run in done), default=0.0), 3),
        "median_rest_s": round(float(np.median([run.rest_s for run in done])), 3) if done else None,
        "by_way": [
            {"way": way, "runs": len(own), "worst_rest_s": round(max(run.rest_s for run in own), 3)}
            for way in WAYS
            if (own := [run for run in done if run.way == way])
        ],
        "other_work_cores": other_work.cores(),
        "examples": [f"{run.way}, {run.motion}: {text}" for run in done for text in run.violations][:10],
        "seed": seed,
    }


def _turned() -> tuple[Motion, ...]:
    """The motions so that each comes with each way once in as many runs as there are pairs."""
    count = len(MOTIONS)
    return tuple(MOTIONS[(number + number // count) % count] for number in range(count * len(WAYS)))


def judge(run: Run, q: FloatArray, time_s: FloatArray) -> None:
    """Complete a run with what the true joint positions show.

    Args:
        q: Around the end [rad], shape (m, joints).
        time_s: Since the end, shape (m,); before it they are negative.
    """
    before, after = q[time_s < 0.0], q[time_s >= 0.0]
    run.speed_deg_s = math.degrees(float(np.abs(before[-1] - before[0]).max())) / -float(time_s[0])
    run.rest_s = stood_after_s(after, time_s[time_s >= 0.0])
    if run.rest_s > STOP_S + run.kept_back_s:
        run.violations.append(f"moved for {run.rest_s:.2f} s")


# ---------------------------------------------------------------------------------------------------- one run


def _end_once(running: Rig, run: Run, taught: list[str], rng: np.random.Generator) -> None:
    direct = contextlib.nullcontext((running.socket, lambda: None))
    with contextlib.ExitStack() as both:
        through, cut = both.enter_context(_relay(running.socket) if run.way == "cut off" else direct)
        client = both.enter_context(_client(through, run.way, _words_of(running)))
        _to_centre(running)
        number = int(rng.integers(2))
        child = _begun(client, *_asked(running, run.motion, 1 - 2 * number, taught[number]))
        if child > 0:
            both.callback(_kill, child)
        deadline_s = time.monotonic() + PATIENCE_S
        while _base_rad_s(running) < SEEN_RAD_S:
            assert time.monotonic() < deadline_s, "the arm never moved"
            assert client.poll() is None, f"the client ended by itself: {_last_words(running)}"
        time.sleep(rng.uniform(*ENDS_AFTER_S))
        end_ns = time.monotonic_ns()
        end(run.way, client, cut)
        time.sleep(WATCH_S)
        truth = running.simulator.truth(end_ns - NS_PER_S // 10, end_ns + round(WATCH_S * NS_PER_S))
        run.kept_back_s = running.kernel.worst_s(end_ns - NS_PER_S // 10, end_ns + NS_PER_S // 2)
        judge(run, truth.joints_rad, (truth.time_ns - end_ns) / NS_PER_S)
        if not all(servo["torque_enabled"] for servo in running.simulator.state()["servos"]):
            run.violations.append("torque went off")
        if run.way == "forked":
            os.kill(child, 0)  # raises if it is gone: then it had no connection to keep
        if run.way != "notebook":
            client.wait(PATIENCE_S)  # an interpreter takes its time to end, on a busy machine
        elif client.poll() is not None:
            run.violations.append(f"the notebook has ended: {client.returncode}")


def _base_rad_s(running: Rig) -> float:
    """How fast the base turns."""
    seen = []
    for _ in range(2):
        seen.append((time.monotonic(), running.simulator.state()["joints_rad"][0]))
        time.sleep(0.03)
    (begin_s, begin_rad), (end_s, end_rad) = seen
    return abs(float(end_rad - begin_rad)) / (end_s - begin_s)


def end(way: Way, client: "subprocess.Popen[str]", cut: Callable[[], None]) -> None:
    """End it."""
    if way == "cut off":
        cut()
    else:
        client.send_signal(signal.SIGINT if way in ("interrupted", "notebook") else signal.SIGKILL)


def _to_centre(running: Rig) -> None:
    centre, deadline_s = np.radians(CENTRE_DEG), time.monotonic() + PATIENCE_S
    while True:
        hold(running.client, PATIENCE_S)
        q = np.array([joint["position_rad"] for joint in running.client.call("status")["joints"]])
        duration_s = 0.5 + float(np.abs(q - centre).max()) / RETURN_RAD_S
        try:
            running.client.call("move", joints_rad=centre.tolist(), duration_s=duration_s)
            return
        except RequestRefused as refusal:  # what the client began ends just now, or the machine is too busy
            if refusal.code not in TOO_BUSY or time.monotonic() > deadline_s:
                raise
        time.sleep(0.05)


def _swing(running: Rig, sign: int) -> str:
    """A swing of the base to one side; its recording."""
    method, params = _asked(running, "move", sign, "")
    name = running.client.call(method, **params)["recording"]
    _to_centre(running)
    return str(name)


def _asked(running: Rig, motion: Motion, sign: int, taught: str) -> tuple[str, dict[str, Any]]:
    """The method of `Arm` and its parameters for a swing of the base to one side."""
    to_rad = np.radians(CENTRE_DEG)
    to_rad[0] += sign * SWING_RAD
    if motion == "jog":
        return "jog", {"seconds": SWING_S, "joints_rad_s": [sign * JOG_RAD_S] + [0.0] * (len(to_rad) - 1)}
    if motion == "play":
        return "play", {"name": taught}
    if motion == "program":
        file = running.socket.with_name("swing.yaml")
        file.write_text(json.dumps({"steps": [{"move": {"joints_rad": to_rad.tolist(), "duration_s": SWING_S}}]}))
        return "program_run", {"file": str(file), "from_step": "1"}
    if motion == "path":
        x, y, z = running.client.call("status")["tool"]["position_m"]
        turns = sign * np.linspace(0.0, SWING_RAD, 13)
        points = np.column_stack([x * np.cos(turns) - y * np.sin(turns), x * np.sin(turns) + y * np.cos(turns)])
        return "path", {"points_m": [[*point, z] for point in points.tolist()], "duration_s": SWING_S}
    return "move", {"joints_rad": to_rad.tolist(), "duration_s": SWING_S}


@contextlib.contextmanager
def _client(through: Path, way: Way, words: Path) -> Iterator["subprocess.Popen[str]"]:
    """The client, which connects and waits to be told what to do; what it says of errors stands in a file."""
    command, pipe = [sys.executable, "-c", CLIENT, str(through), way], subprocess.PIPE
    with (
        words.open("w", encoding="utf-8") as said,
        subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=said, text=True) as client,
    ):
        try:
            yield client
        finally:
            client.kill()


def _words_of(running: Rig) -> Path:
    return running.socket.with_name("client.log")


def _last_words(running: Rig) -> str:
    return _words_of(running).read_text(encoding="utf-8").strip().rpartition("\n")[2]


def _begun(client: "subprocess.Popen[str]", method: str, params: dict[str, Any]) -> int:
    """Let it do that; the child that it has forked (-1: none)."""
    assert client.stdin is not None
    assert client.stdout is not None
    child = int(client.stdout.readline() or "0")
    print(json.dumps([method, params]), file=client.stdin, flush=True)
    return child


def _kill(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


@contextlib.contextmanager
def _relay(daemon: Path) -> Iterator[tuple[Path, Callable[[], None]]]:
    """A socket that leads to the daemon's for one connection, and what cuts that."""
    path = daemon.with_name("relay.sock")
    path.unlink(missing_ok=True)
    with (
        socket.socket(socket.AF_UNIX) as listening,
        socket.socket(socket.AF_UNIX) as far,
        contextlib.ExitStack() as open_ones,
    ):
        listening.bind(str(path))
        listening.listen()
        far.connect(str(daemon))

        def pump(source: socket.socket, sink: socket.socket) -> None:
            with contextlib.suppress(OSError):
                while data := source.recv(1 << 16):
                    sink.sendall(data)
                sink.shutdown(socket.SHUT_RDWR)

        def serve() -> None:
            with contextlib.suppress(OSError):
                near = open_ones.enter_context(listening.accept()[0])
                threading.Thread(target=pump, args=(far, near), daemon=True).start()
                pump(near, far)

        serving = threading.Thread(target=serve, daemon=True)
        serving.start()

        def cut() -> None:
            far.shutdown(socket.SHUT_RDWR)

        try:
            yield path, cut
        finally:
            with contextlib.suppress(OSError):
                far.shutdown(socket.SHUT_RDWR)
            listening.shutdown(socket.SHUT_RDWR)
            serving.join(PATIENCE_S)
