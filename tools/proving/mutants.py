"""Does the soak notice? Bugs planted one at a time in a copy of the package, each run through short soak episodes.

A mutant is a small patch of the source. It counts as caught when the judge of `invariants.py` reports a violation in an
episode that the sound copy plays without one. Only what survives is also given to the unit tests of the control
package, which is told beside it and does not count. A patch that no longer fits its file is an error, so that mutants
do not rot. None is in the simulator, nor in `proving`.
"""

from __future__ import annotations

import concurrent.futures
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from armctl.errors import ArmctlError

SEED = 1
EPISODES = 24
"""At most so many for each mutant, until one fails."""
TIMEOUT_S = 240.0
TOOLS = Path(__file__).resolve().parents[1]
ROOT = TOOLS.parent / "armctl"


class StaleMutant(ArmctlError):
    """A mutant whose old text stands in its file no more, or not once."""

    def __init__(self, mutant: Mutant, old: str, count: int) -> None:
        where = f"{old!r} stands {count} times in {mutant.file}, not once"
        super().__init__(f"mutant {mutant.name!r}: {where}; bring its patch up to date")


@dataclass(frozen=True, slots=True)
class Mutant:
    """One planted bug."""

    name: str
    file: str
    """Below the package."""
    patches: tuple[tuple[str, str], ...]
    """Old text, which stands once, and new."""


def _m(name: str, file: str, *patches: tuple[str, str]) -> Mutant:
    return Mutant(name, file, patches)


TICK, DETECT, SEQUENCES = "control/tick.py", "control/detect.py", "control/sequences.py"
REQUESTS, MACHINE, LOOP, BUS = "control/requests.py", "control/machine.py", "control/loop.py", "dynamixel/bus.py"

MUTANTS: tuple[Mutant, ...] = (
    _m("goals are not clamped", TICK, ("clamped = min(max(tick, low), high)", "clamped = tick")),
    _m("limits of the joint beside", TICK, (
        "low, high = joint.limits_tick", "low, high = s.arm.joints[i - 1].limits_tick",
    )),
    _m("speed 0 is written", TICK, ("speeds.append(min(slowest,", "speeds.append(0 * min(slowest,")),
    _m("speed is not limited", TICK, ("speeds.append(min(slowest,", "speeds.append(max(slowest, 700,")),
    _m("a goal follows torque-off", TICK, (
        "s.goal = None  # a goal after",
        "s.goal = Goal(s.state.goal, (16,) * len(s.state.goal)) if s.state.goal else None  # a goal after",
    )),
    _m("a fault cuts torque", TICK, ('s.events.append(Event("error", code, text, servo_id))', "torque_off(s)")),
    _m("a stop is forgotten", TICK, ("replace(motion, stop_code=code)", "replace(motion, stop_code='')")),
    _m("a trip is not latched", DETECT, ("if registers.torque_limit == 0:", "if registers.torque_limit < 0:")),
    _m("a restart is not noticed", DETECT,
       ("if not registers.torque_enabled:", "if registers.torque_enabled > 9:"),
       ("if registers.settings != settings[i]:", "if registers.settings < 0:")),
    _m("silence latches too late", DETECT, ("SILENT_AGE_S = 0.5", "SILENT_AGE_S = 5.0")),
    _m("a blocked joint is not latched", DETECT, (">= BLOCKED_NS:", ">= 99 * BLOCKED_NS:")),
    _m("a lost port is not latched", DETECT, ("if not s.inputs.sample.port_open:", "if s.inputs.tick < 0:")),
    _m("another writer is not noticed", DETECT, ("if registers.goal != previous[i]:", "if registers.goal < 0:")),
    _m("heat is not noticed", DETECT, ("joint.temperature_degC >= limit_degC", "joint.temperature_degC >= 999")),
    _m("voltage is not noticed", DETECT, ("if not low_V <= joint.voltage_V <= high_V", "if not 0 <= joint.voltage_V")),
    _m("a hold rewrites goal := measured each tick", DETECT, (
        "if lost and s.fresh:\n        send_goal(s, goal)",
        "if s.fresh:\n        send_goal(s, [r.position if r else g for r, g in zip(s.registers, goal, strict=True)])",
    )),
    _m("a stale sample is used", SEQUENCES, ("or motion.paused or not s.fresh", "or motion.paused"), (
        "    if not s.fresh:\n        s.state = replace(s.state, motion",
        "    if s.inputs.tick < 0:\n        s.state = replace(s.state, motion",
    )),
    _m("goals two ticks further ahead", SEQUENCES,
       ("q = sample_trajectory(trajectory, time_s)", "q = sample_trajectory(trajectory, time_s + 2.0 * s.period_s)"),
       ("if share < 1.0:", "if share < 0.0:")),
    _m("the lead is not bounded", TICK, ("LEAD_TICKS = math.radians(9.0)", "LEAD_TICKS = math.radians(25.0)")),
    _m("a pause is ignored", SEQUENCES, ("or motion.paused or", "or")),
    _m("the host's death is ignored", REQUESTS, ('finish_motion(s, "HOST_LOST", "")', "pass")),
    _m("a late tick is ignored", SEQUENCES, ('stop_motion(s, "LATE")', "pass")),
    _m("sign of direction", TICK, ("round(joint.tick(q))", "round(joint.tick(-q))")),
    _m("torque-on without a goal", REQUESTS, (
        "    send_goal(s, ticks)\n    s.state = replace(s.state, request_id=request_id, anchor=tuple(ticks))",
        "    held = tuple(r.goal for r in s.registers if r)\n"
        "    s.state = replace(s.state, request_id=request_id, anchor=held)",
    )),
    _m("torque-on without a soft limit", REQUESTS, ("            (ax12a.TORQUE_LIMIT, SOFT_TORQUE),\n", "")),
    _m("torque-on at a goal of its own", REQUESTS, (
        "ticks.append(min(max(registers.position, low), high))",
        "ticks.append(min(max(registers.position + 9, low), high))",
    )),
    _m("an EEPROM write in service", SEQUENCES, (
        "s.writes.append(Write(joint.servo_id, ax12a.TORQUE_LIMIT.address,",
        "s.writes.append(Write(joint.servo_id, ax12a.MAX_TORQUE.address,",
    )),
    _m("settling without seeing the rest pose", SEQUENCES, (
        "<= REST_TOLERANCE_RAD", "<= 99.0 * REST_TOLERANCE_RAD",
    )),
    _m("settling too fast", "trajectory/approach.py", (
        "APPROACH_SPEED_RAD_S = math.radians(20.0)", "APPROACH_SPEED_RAD_S = 0.9",
    )),
    _m("adoption rewrites the goals", SEQUENCES, (
        "s.go(Trigger.ADOPT_POWERED)\n        take_over(s)",
        "s.go(Trigger.ADOPT_POWERED)\n        take_over(s)\n"
        "        send_goal(s, [r.position for r in s.registers if r is not None])",
    )),
    _m("clear while the cause lasts", REQUESTS, ("    if causes:\n", "    if not causes and False:\n")),
    _m("a run while a fault is latched", MACHINE, (
        "(Mode.FAULTED, Trigger.RELEASE): Mode.FAULTED,",
        "(Mode.FAULTED, Trigger.RELEASE): Mode.FAULTED, (Mode.FAULTED, Trigger.RUN): Mode.MOVING,",
    )),
    _m("torque on while a fault is latched", MACHINE, (
        "(Mode.FAULTED, Trigger.RELEASE): Mode.FAULTED,",
        "(Mode.FAULTED, Trigger.RELEASE): Mode.FAULTED, (Mode.FAULTED, Trigger.TORQUE_ON): Mode.ENERGISING,",
    )),
    _m("a run may start anywhere", REQUESTS, ("TOLERANCE_RAD = math.radians(2.0)", "TOLERANCE_RAD = 9.0")),
    _m("joint speed is not checked", REQUESTS, ("if speed > joint.speed_limit_rad_s * 1.001:", "if speed > 1e9:")),
    _m("NaN is not refused", REQUESTS, (" or not all(map(math.isfinite, point))", "")),
    _m("late ticks are made up for in a burst", LOOP, ("if behind_ns > self._skip_ns:", "if behind_ns > 10**15:")),
    _m("a lost port is looked for too seldom", LOOP, ("REOPEN_NS = NS_PER_S // 2", "REOPEN_NS = NS_PER_S * 8")),
    _m("no retry", BUS, ("retries < SAMPLE_RETRIES", "retries < 0")),
    _m("a lost reply looks fresh", BUS, ("old.stamp_ns, False, old.error", "self._clock.now_ns(), True, old.error")),
    _m("goals of the joints beside", BUS, (
        "zip(self.servo_ids, goal.ticks, goal.speeds, strict=True)",
        "zip(self.servo_ids, goal.ticks[1:] + goal.ticks[:1], goal.speeds, strict=True)",
    )),
    _m("the EEPROM is not compared", "dynamixel/fitness.py",
       ("if cw == ccw == 0:", "if cw < 0:"), ("if ccw < high:", "if ccw < 0:")),
    _m("a jog goes on by itself", "control/jog.py", ("HEARTBEAT_NS = 80_000_000", "HEARTBEAT_NS = 8_000_000_000")),
)  # fmt: skip


def plant(mutant: Mutant, package: Path) -> None:
    """Put the bug into a copy of the package.

    Raises:
        StaleMutant: its patch does not fit.
    """
    path = package / mutant.file
    text = path.read_text(encoding="utf-8")
    for old, new in mutant.patches:
        count = text.count(old)
        if count != 1:
            raise StaleMutant(mutant, old, count)
        text = text.replace(old, new)
    path.write_text(text, encoding="utf-8")


@dataclass(frozen=True, slots=True)
class Result:
    """What the soak said of one copy."""

    name: str
    violation: str
    """Empty: it noticed nothing."""
    seconds: float
    tests: str = ""
    """What the unit tests said of a survivor."""


def judge(mutant: Mutant | None, seed: int, episodes: int) -> Result:
    """Run the soak on a copy with the mutant planted (None: a sound one)."""
    begin_s = time.monotonic()
    name = "none" if mutant is None else mutant.name
    with tempfile.TemporaryDirectory(prefix="armctl-mutant-") as folder:
        shutil.copytree(ROOT, Path(folder) / "armctl", ignore=shutil.ignore_patterns("__pycache__"))
        if (calibration := ROOT.parent / "calibration").is_dir():
            shutil.copytree(calibration, Path(folder) / "calibration")
        if mutant is not None:
            plant(mutant, Path(folder) / "armctl")
        violation = _soak(folder, seed, episodes)
        tests = "" if violation or mutant is None else _unit_tests(folder)
    return Result(name, violation, time.monotonic() - begin_s, tests)


def _soak(folder: str, seed: int, episodes: int) -> str:
    command = [sys.executable, "-m", "proving.mutants", str(seed), str(episodes)]
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env=_environment(folder),
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return ""
    if done.returncode:
        raise ArmctlError(f"the episodes of a mutant ended with {done.returncode}: {done.stderr[-500:]}")
    return str(json.loads(done.stdout)["violation"])


def _unit_tests(folder: str) -> str:
    """What the control package's own tests say; they lie beside the package, where it is not installed."""
    tests = ROOT.parent / "tests"
    if not tests.is_dir():
        return "none here"
    shutil.copytree(tests, Path(folder) / "tests", ignore=shutil.ignore_patterns("__pycache__"))
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "tests/control"]
    done = subprocess.run(command, cwd=folder, env=_environment(folder), capture_output=True, check=False)
    return "caught" if done.returncode == 1 else "nothing" if done.returncode == 0 else "did not run"


def _environment(folder: str) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": os.pathsep.join((folder, str(TOOLS))), "PYTHONDONTWRITEBYTECODE": "1"}


def prove(
    seed: int = SEED,
    *,
    workers: int = 2,
    episodes: int = EPISODES,
    mutants: Sequence[Mutant] = MUTANTS,
    tell: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Plant every mutant in turn.

    Raises:
        StaleMutant: a patch does not fit its file any more; told before anything runs.
    """
    with tempfile.TemporaryDirectory(prefix="armctl-mutant-") as folder:
        for mutant in mutants:
            copy = Path(folder) / mutant.file
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / mutant.file, copy)
            plant(mutant, Path(folder))
    begin_s = time.monotonic()
    results: list[Result] = []
    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        sound = pool.submit(judge, None, seed, episodes)
        waiting = [pool.submit(judge, mutant, seed, episodes) for mutant in mutants]
        for future in concurrent.futures.as_completed(waiting):
            result = future.result()
            results.append(result)
            said = result.violation or f"NOTHING; unit tests: {result.tests}"
            tell(f"{len(results)} of {len(mutants)}, {result.seconds:.0f} s: {result.name}: {said}")
    survivors = [result for result in results if not result.violation]
    violation = sound.result().violation
    if violation:
        tell(f"the sound copy fails as well, so nothing is proven: {violation}")
    return {
        "runs": len(results),
        "caught": len(results) - len(survivors),
        "survivors": sorted(result.name for result in survivors),
        "tests": {result.name: result.tests for result in survivors},
        "violations": int(bool(violation)) + max(0, len(survivors) - len(results) // 30),
        "sound": violation,
        "seconds": round(time.monotonic() - begin_s, 1),
        "mutants": [
            {"name": result.name, "violation": result.violation, "seconds": round(result.seconds, 1)}
            for result in sorted(results, key=lambda result: result.name)
        ],
        "seed": seed,
    }


def main(seed: int, episodes: int) -> None:
    """The first violation among some episodes, as JSON on stdout: what runs inside a copy."""
    import logging

    from proving.episode import Episode, stage
    from proving.story import draw

    logging.disable(logging.CRITICAL)
    on, violation = stage(), ""
    for episode in range(episodes):
        found = Episode(draw(seed, episode, on.arm), on).play().violations
        if found:
            violation = f"episode {episode}, invariant {found[0].invariant}: {found[0].text}"
            break
    sys.stdout.write(json.dumps({"violation": violation}))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
