"""The daemon against everything that can happen on the wire: safety.md's fault matrix, row by row, on a pty.

A scenario brings the arm into a state, lets one fault strike, and watches: the daemon by its snapshots, the arm by the
simulated servos themselves. Judged in each of them:

1. The code and state of the matrix come within its bound (and one tick, for a fault may begin just behind a reading).
2. A motion that a fault stops is still at most 0.7 s after that bound (200 ms of goals, 500 ms to come to rest).
3. No joint moves that was not asked to, save the one whose servo the fault took away or commands.
4. Every goal a servo holds lies within the joint's limits; no torque comes on, and none goes off, unasked.
5. Where a fault latched: `clear` is refused while its cause stands, and once it is gone ready within 3 s, in the same
   control process.

How long the kernel kept back what went over a pseudo terminal meanwhile is measured and added to each bound; where it
was long enough to look like a silent servo, a silence that latched is told (`unjudged`), not judged.
"""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from armctl.client import Client
from armctl.control.detect import PAUSE_AGE_S
from armctl.errors import ArmctlError, RequestRefused
from armctl.trajectory.plan import Plan
from proving import wire_damage
from proving.rig import Rig, rig
from proving.wire_rows import LATER, SCENARIOS, SWING_S, TICK_S, Scenario, spoil

# For the observer: from the daemon's tick to its snapshot here, on a machine with other work.
SLACK_S = 0.08
LAST_GOAL_S = 0.2
REST_S = 0.5
CLEAR_S = 3.0
COOL_DEGC = 40.0
# What stiction and its correction make of a joint that stands while others turn; 1.8 deg were seen on 60 arms.
MOVED_RAD = math.radians(3.0)
# What it may move by as what bears the arm at rest is left, and met again; 4.7 deg were seen on 60 arms.
SAGGED_RAD = math.radians(5.5)
# Motion within 0.1 s that still counts as rest.
STILL_RAD = math.radians(0.4)
MOVING_IDS = (1, 6)
SWING_RAD = math.radians(30.0)
# Where a swing begins, but for one from the rest pose: there something bears the arm until the base has turned it away.
CENTRE_RAD = tuple(math.radians(deg) for deg in (0.0, 130.0, -115.0, 60.0, 0.0, 0.0))
TO_CENTRE_S = 4.0
# Of the whole motion, with its approach and dwell: here base and roll turn at 13 deg/s.
FAST_PROGRESS = 0.4


@dataclass
class Result:
    """What one scenario showed."""

    name: str
    code: str = ""
    state: str = ""
    detected_s: float | None = None
    bound_s: float = 0.0
    still_s: float | None = None
    recovered_s: float | None = None
    # The kernel's longest delay meanwhile.
    kept_back_s: float = 0.0
    unjudged: list[str] = field(default_factory=list)
    violations: list[str] = field(default_factory=list)


def prove(seed: int, names: Sequence[str] = (), tell: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Run the scenarios of those names (none: all) on daemons and simulators of their own."""
    chosen = [scenario for scenario in SCENARIOS if not names or scenario.name in names]
    results: list[Result] = []
    left = chosen
    while left:
        results += (done := _session(left, seed + len(results), tell))
        left = left[len(done) :]
    damage = wire_damage.prove(seed, 0 if names else wire_damage.TRIALS)
    return {
        "runs": len(results) + damage["runs"],
        "violations": sum(len(result.violations) for result in results) + damage["violations"],
        "red": damage["red"],
        "damage": damage["damage"],
        "scenarios": [vars(result) for result in results],
        "later": [{"row": row, "reason": reason} for row, reason in LATER],
        "seed": seed,
    }


def _session(scenarios: Sequence[Scenario], seed: int, tell: Callable[[str], None]) -> list[Result]:
    """Scenarios one after another on one pair, as long as it comes back to rest by itself."""
    results: list[Result] = []
    before_daemon = spoil(scenarios[0]) if scenarios[0].state == "connect" else None
    with rig(seed=seed, before_daemon=before_daemon) as running:
        for scenario in scenarios:
            if results and (scenario.state == "connect" or not _prepared(running)):
                break
            result = Result(scenario.name, bound_s=scenario.within_s)
            try:
                _run(running, scenario, result)
            except (ArmctlError, AssertionError, OSError) as error:
                result.violations.append(f"{type(error).__name__}: {error}")
            results.append(result)
            figures = f"{result.code or '-'} {_ms(result.detected_s)} still {_ms(result.still_s)}"
            figures += f" kernel {_ms(result.kept_back_s)}"
            tell(f"{result.name}: {figures} {'; '.join((*result.unjudged, *result.violations)) or 'ok'}")
            if result.violations or scenario.state == "connect":
                break
    return results


def _ms(value_s: float | None) -> str:
    return "-" if value_s is None else f"{1e3 * value_s:.0f} ms"


def _prepared(running: Rig) -> bool:
    """Whether the arm is limp at its rest pose, without a fault."""
    with contextlib.suppress(ArmctlError):
        if running.snapshot["fault"] is not None:
            return False
        joints = running.simulator.state()["joints_rad"]
        at_rest = all(
            abs(q - joint.rest_rad) < math.radians(3.0) for q, joint in zip(joints, running.arm.joints, strict=True)
        )
        if at_rest and running.snapshot["state"] == "holding":
            running.client.call("release", confirm=True)
        return at_rest and running.wait(lambda s: s["state"] == "off", 1.0)
    return False


# ------------------------------------------------------------------------------------------------ one scenario


def _run(running: Rig, scenario: Scenario, result: Result) -> None:
    if scenario.state == "connect":
        _judge_connection(running, scenario, result)
        return
    with _in_state(running, scenario) as motion:
        control_pid = running.snapshot["pids"]["control"]
        seen_from = len(running.seen.servos)
        begin_ns = time.monotonic_ns()
        fault_id = _begin(running, scenario)
        _watch(running, scenario, motion, begin_ns)
        end_ns = time.monotonic_ns()
        result.kept_back_s = running.kernel.worst_s(begin_ns, end_ns)
        _judge_detection(running, scenario, result, begin_ns, end_ns)
        _judge_motion(running, scenario, result, motion, begin_ns, end_ns)
        _judge_registers(running, scenario, result, seen_from)
        if result.code and fault_id is not None and scenario.kind not in ("trip", "brown_out", "hot"):
            _judge_refusal(running, result)
        ended_s = time.monotonic()
        if fault_id is not None:
            running.simulator.fault_end(fault_id)
        if scenario.kind == "hot":
            running.simulator.fault_begin("hot", servo_id=scenario.servo_id, value=COOL_DEGC)
        if result.code:
            _recover(running, scenario, result, ended_s)
        if scenario.act is None and running.snapshot["pids"]["control"] != control_pid:
            result.violations.append("another control process than before")


@dataclass
class _Motion:
    """A swing of base and roll, run by a client of its own."""

    thread: threading.Thread | None = None
    error: ArmctlError | None = None
    answered: bool = False


@contextlib.contextmanager
def _in_state(running: Rig, scenario: Scenario) -> Iterator[_Motion]:
    """The arm in a scenario's state, reached from limp at rest."""
    state, motion = scenario.state, _Motion()
    assert running.wait(lambda s: s["state"] == "off", 5.0), f"the daemon is {running.snapshot.get('state')}, not off"
    if state == "teaching":
        running.client.call("teach_begin", confirm=True)
    elif state != "off":
        running.client.call("torque_on")
    mover = Client(running.socket)
    try:
        if state == "moving":
            assert running.wait(lambda s: s["state"] == "holding", 2.0)
            centre_rad = tuple(joint.rest_rad for joint in running.arm.joints) if scenario.borne else CENTRE_RAD
            running.client.call("move", joints_rad=centre_rad, duration_s=TO_CENTRE_S)
            motion.thread = threading.Thread(target=_swing, args=(running, mover, motion, centre_rad), daemon=True)
            motion.thread.start()
            moved = running.wait(lambda s: s["state"] == "moving" and (s["progress"] or 0.0) > FAST_PROGRESS, 5.0)
            assert moved, f"the swing did not begin: {motion.error}"
        else:
            want = {"off": "off", "holding": "holding", "teaching": "teaching"}[state]
            assert running.wait(lambda s: s["state"] == want, 2.0)
            time.sleep(0.3)
        yield motion
    finally:
        if motion.thread is not None:
            motion.thread.join(SWING_S + 5.0)
        mover.close()
        if state == "teaching":
            with contextlib.suppress(ArmctlError):
                running.client.call("teach_end")


def _swing(running: Rig, client: Client, motion: _Motion, centre_rad: tuple[float, ...]) -> None:
    try:
        client.call("run", plan=_swing_plan(running, centre_rad).model_dump(mode="json"))
    except ArmctlError as error:
        motion.error = error
    motion.answered = True


def _swing_plan(running: Rig, centre_rad: tuple[float, ...]) -> Plan:
    """Base and roll go out and come back; nothing else moves."""
    out = tuple(
        q + (SWING_RAD if joint.servo_id in MOVING_IDS else 0.0)
        for q, joint in zip(centre_rad, running.arm.joints, strict=True)
    )
    return Plan(
        arm_id=running.arm.arm_id,
        calibration_hash=running.arm.calibration_hash,
        from_m=(0.0, 0.0, 0.0),
        to_m=(0.0, 0.1, 0.0),
        duration_s=SWING_S,
        via=1,
        interpolation="cubic",
        waypoints_rad=(centre_rad, out, centre_rad),
        waypoint_progress=(0.0, 0.5, 1.0),
        predicted_mean_error_mm=0.0,
        predicted_max_error_mm=0.0,
        seed=0,
    )


def _begin(running: Rig, scenario: Scenario) -> int | None:
    if scenario.act is not None:
        scenario.act(running)
        return None
    return running.simulator.fault_begin(
        scenario.kind,
        servo_id=scenario.servo_id,
        probability=scenario.probability,
        count=scenario.count,
        value=scenario.value,
    )


def _watch(running: Rig, scenario: Scenario, motion: _Motion, begin_ns: int) -> None:
    """Let the bound pass, and a while more; a motion nothing may stop, to its end."""
    if scenario.codes and "" not in scenario.codes:
        running.wait(lambda s: s["fault"] is not None, scenario.within_s + 1.0)
        settle_s = LAST_GOAL_S + REST_S + 0.3
        time.sleep(max(settle_s, scenario.watch_s))
    else:
        if motion.thread is not None:
            motion.thread.join(SWING_S + 5.0)
        time.sleep(max(0.0, scenario.within_s - (time.monotonic_ns() - begin_ns) / 1e9))


def _judge_detection(running: Rig, scenario: Scenario, result: Result, begin_ns: int, end_ns: int) -> None:
    faults = [
        (at_ns, snapshot)
        for at_ns, snapshot in list(running.seen.snapshots)
        if begin_ns <= at_ns <= end_ns and snapshot["fault"] is not None and snapshot["fault"]["code"] != "RESTARTED"
    ]
    wanted = scenario.codes
    result.state = running.snapshot["state"]
    if not faults:
        if wanted and "" not in wanted:
            result.violations.append(f"nothing latched, wanted {wanted[0]}")
        _judge_undisturbed(running, scenario, result)
        return
    at_ns, first = faults[0]
    result.code = first["fault"]["code"]
    result.detected_s = (at_ns - begin_ns) / 1e9 - first["fault"]["since_s"]
    if result.code not in wanted:
        silenced = result.code in ("SERVO_SILENT", "BUS_DEAD") and result.kept_back_s > PAUSE_AGE_S
        told = result.unjudged if silenced else result.violations
        told.append(f"latched {result.code}, wanted {' or '.join(wanted) or 'nothing'}")
    bound_s = scenario.within_s + TICK_S + SLACK_S + result.kept_back_s
    if result.detected_s > bound_s:
        result.violations.append(f"latched after {result.detected_s:.2f} s, bound {bound_s:.2f}")
    named = first["fault"]["servo_id"]
    if scenario.servo_id is not None and result.code in wanted and named not in (None, scenario.servo_id):
        result.violations.append(f"names servo {named}, it was {scenario.servo_id}")
    for key in ("arm", "next", "text"):
        if not first["fault"][key]:
            result.violations.append(f"the card says nothing under {key!r}")
    if not scenario.settles and result.state != "faulted":
        result.violations.append(f"state {result.state} with a latched fault")


def _judge_undisturbed(running: Rig, scenario: Scenario, result: Result) -> None:
    """Nothing latched: the arm must be in the state it would be in anyway."""
    after = "holding" if scenario.state == "moving" else scenario.state
    if not running.wait(lambda s: s["state"] == after, 2.0):
        result.violations.append(f"state {running.snapshot['state']}, wanted {after}")


def _judge_motion(
    running: Rig, scenario: Scenario, result: Result, motion: _Motion, begin_ns: int, end_ns: int
) -> None:
    truth = running.simulator.truth(begin_ns, end_ns)
    assert len(truth.time_ns) > 20, "the simulator kept no truth"
    ids = [joint.servo_id for joint in running.arm.joints]
    kept = [i for i, servo_id in enumerate(ids) if servo_id not in scenario.free]
    asked = [i for i in kept if scenario.state == "moving" and ids[i] in MOVING_IDS]
    settling = scenario.settles
    for i in kept:
        moved = float(np.ptp(truth.joints_rad[:, i]))
        if i not in asked and not settling and moved > (SAGGED_RAD if scenario.borne else MOVED_RAD):
            result.violations.append(f"servo {ids[i]} moved {math.degrees(moved):.1f} deg, and was not asked to")
    if scenario.state != "moving" or not asked:
        return
    steps = max(1, round(0.1 / 0.01))
    moving = np.abs(truth.joints_rad[steps:, asked] - truth.joints_rad[:-steps, asked]).max(axis=1) > STILL_RAD
    last = np.flatnonzero(moving)
    result.still_s = (int(truth.time_ns[last[-1] + steps]) - begin_ns) / 1e9 if len(last) else 0.0
    if not len(last):
        result.unjudged.append("the arm stood when it struck, on a turn or on a busy machine: its rest shows nothing")
    stopped = bool(result.code) or scenario.act is not None
    if stopped and not settling:
        bound_s = scenario.within_s + TICK_S + SLACK_S + LAST_GOAL_S + REST_S + result.kept_back_s
        if result.still_s > bound_s:
            result.violations.append(f"moved for {result.still_s:.2f} s, bound {bound_s:.2f}")
        if motion.answered and motion.error is None:
            result.violations.append("the run was answered as done")
    elif not stopped and motion.error is not None:
        result.violations.append(f"the run failed: {motion.error}")


def _judge_registers(running: Rig, scenario: Scenario, result: Result, seen_from: int) -> None:
    """Goals within the limits, and no torque switched by the daemon."""
    samples = [servos for _, servos in list(running.seen.servos)[seen_from:]]
    strange = (scenario.servo_id,) if scenario.servo_id else tuple(joint.servo_id for joint in running.arm.joints)
    touched = strange if scenario.kind in ("second_writer", "brown_out", "trip") else ()
    for index, joint in enumerate(running.arm.joints):
        if joint.servo_id in touched:
            continue
        low, high = joint.limits_tick
        goals = [servos[index]["goal_tick"] for servos in samples]
        torque = [servos[index]["torque_enabled"] for servos in samples]
        if scenario.state in ("holding", "moving") and not all(low <= goal <= high for goal in goals):
            result.violations.append(f"servo {joint.servo_id} held a goal outside {low}..{high}")
        changed = len(set(torque)) > 1
        if changed and not (scenario.settles and torque[0]):
            result.violations.append(f"torque of servo {joint.servo_id} changed unasked")


def _judge_refusal(running: Rig, result: Result) -> None:
    """`clear` must be refused while the cause stands."""
    if result.code in ("BLOCKED", "OTHER_WRITER", "NOT_LIMP", "BUS_NOISE"):
        return  # what is wrong shows only once something moves, writes or has been read for a while
    with contextlib.suppress(RequestRefused):
        running.client.call("clear")
        result.violations.append("clear was accepted while the cause stands")


def _recover(running: Rig, scenario: Scenario, result: Result, ended_s: float) -> None:
    """`clear` until it is accepted."""
    if scenario.limp:
        running.client.call("release", confirm=True)
    while True:
        try:
            running.client.call("clear")
            break
        except RequestRefused as refusal:
            if time.monotonic() - ended_s > CLEAR_S + SLACK_S:
                result.violations.append(f"not cleared {CLEAR_S:g} s after the cause was gone: {refusal}")
                return
            time.sleep(0.05)
    result.recovered_s = time.monotonic() - ended_s
    powered = scenario.state in ("holding", "moving") and not scenario.limp and not scenario.settles
    want = "holding" if powered else "off"
    if not running.wait(lambda s: s["state"] == want and s["fault"] is None, 1.0):
        result.violations.append(f"cleared, but {running.snapshot['state']} and not {want}")


def _judge_connection(running: Rig, scenario: Scenario, result: Result) -> None:
    """A bus that is unfit from the start: latched at the first tick, torque refused, nothing moves."""
    running.wait(lambda s: s["fault"] is not None, 2.0)
    fault = running.snapshot["fault"]
    result.state = running.snapshot["state"]
    result.code = fault["code"] if fault else ""
    if result.code not in scenario.codes:
        result.violations.append(f"latched {result.code or 'nothing'}, wanted {' or '.join(scenario.codes)}")
    begin_ns = time.monotonic_ns()
    for request in ("torque_on", "clear"):
        with contextlib.suppress(RequestRefused):
            running.client.call(request)
            result.violations.append(f"{request} was accepted")
    time.sleep(0.5)
    _judge_motion(running, replace(scenario, state="off"), result, _Motion(), begin_ns, time.monotonic_ns())
    if any(servo["torque_enabled"] for servo in running.simulator.state()["servos"]):
        result.violations.append("a servo is under torque")
