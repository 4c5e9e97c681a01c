"""Zero offsets and link lengths from touched points.

A limp arm's tool tip is guided by hand to points whose place in the base frame is known; at each one the servos'
positions are averaged. With q = direction (tick - zero_tick) TICK_RAD and the chain's tool position f, the zero
ticks and lengths that make

    sum_k | p_k - f(q_k(zero_ticks), lengths) |^2

least are found by Gauss-Newton. The columns of its matrix are scaled to mm per tick and mm per mm, so that singular
values mean something: along a singular vector, an error of e mm in the points becomes e / value ticks or mm.

What can be told apart, and what cannot:

- The points are in the base frame: origin where the chain begins (for `ax12-line` on the base yaw's axis, d1 below
  the shoulder's), x ahead at base position 0, z up. An error in the sheet's
  direction becomes an error of the base's zero, and one in its height an error of d1: moving the sheet down is the
  same as making d1 longer.
- Servos beyond the chain (a wrist roll) do not move the tool point; their zeros are held.
- If the tool always comes down at one angle, d1 and the last length are one number, and so are two neighbouring zeros
  if the joint between their links hardly moves. Touch every point in several postures: elbow high and low, tool
  steep and flat, near and far. A singular value below `WEAK` says that it was not done: the parameter that leans
  most on that direction is held at its present value and named with those it cannot be told from, and the search
  starts anew. The others then make up for what is wrong with it: right near these postures, less so elsewhere.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from pydantic import Field

from armctl.clock import Clock
from armctl.commissioning.texts import refusal
from armctl.config import ArmConfig, Frozen, parse_yaml, validate
from armctl.dynamixel import ax12a
from armctl.dynamixel.bus import ServoBus
from armctl.dynamixel.fitness import ServoJoint
from armctl.dynamixel.identify import IDENTIFY_LATENCY_MS
from armctl.errors import ConfigError, PortGone
from armctl.files import read_text
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray

MM = 1000.0
READINGS = 32
READING_PERIOD_NS = 20_000_000
# A servo is silent if so many samples in a row miss one; a limp arm is in no hurry.
SAMPLES = 5
# Highest minus lowest reading of one joint while the tool rests on a point; more: the arm moved.
MAX_SPREAD_TICK = 6
# Touches of fewer points fit almost any arm: calibrated by one or two, most arms come out worse than they were.
FEWEST_POINTS = 3
# Smallest singular value [mm per tick or mm] that counts as seen: there 0.25 mm are a whole tick.
WEAK = 0.25
HELD_ERROR_TICK = 5.0
# How wrong a held value may be. The others make up for that, and their standard errors include it.
HELD_ERROR_MM = 2.0
# Component of a weak direction from which on a parameter is named.
CONFUSED = 0.3
# Parameters -> how far the tool is off the points, coordinate by coordinate.
Residuals = Callable[[FloatArray], FloatArray]
# What the first line of a file of points may say.
HEADERS = ("x,y,z", "x_m,y_m,z_m")
BEYOND_CHAIN = "does not move the tool"
ITERATIONS = 50
# Gauss-Newton ends when no scaled parameter moves by more.
STEP = 1e-9
# Residuals above this come from points in the wrong order or frame, not from an arm.
MAX_RMS_MM = 5.0
# Of the differences that make the matrix [ticks, mm].
WIDTH = 1e-3


class Touch(Frozen):
    """The tool tip on one known point."""

    point_m: tuple[float, float, float] = Field(strict=False)
    # Mean position of every servo, in the calibration's order.
    ticks: tuple[float, ...] = Field(strict=False)


class Readings(Frozen):
    """All touches of one session."""

    arm_id: str
    touches: tuple[Touch, ...] = Field(strict=False)


class Fit(NamedTuple):
    """The result of a calibration."""

    arm: ArmConfig
    # Of each zero tick (`JOINT.zero_tick`) and length (`lengths_m.LENGTH`) its `name` and `unit`, `before` and `after`,
    # its `standard_error`, from the residuals and from what held ones may be wrong by, and why it was left alone
    # (`held`; then it has no error).
    parameters: list[dict[str, Any]]
    # Distance of the calibrated tool from each point.
    residuals_mm: list[float]
    rms_before_mm: float
    rms_mm: float
    # Whether the points showed everything that moves the tool.
    complete: bool


# ------------------------------------------------------------------------------------------------------- readings


def read_points(path: Path) -> list[tuple[float, float, float]]:
    """Points [m] from lines `x,y,z`, the first of which may be a header; what follows a # is a remark.

    Raises:
        ConfigError: naming the line.
    """
    bare = (line.partition("#")[0].strip() for line in read_text(path, "points").splitlines())
    lines = [(f"line {number}", text) for number, text in enumerate(bare, start=1) if text]
    points = []
    for where, text in lines[bool(lines and lines[0][1].replace(" ", "") in HEADERS) :]:
        try:
            x, y, z = map(float, text.split(","))
        except ValueError:
            raise ConfigError(str(path), where, f"{text!r} is not x,y,z in metres") from None
        if not all(math.isfinite(value) and abs(value) <= 10.0 for value in (x, y, z)):
            raise ConfigError(str(path), where, f"{text!r}: finite and within 10 m (the unit is metres)")
        points.append((x, y, z))
    if not points:
        raise ConfigError(str(path), "", "holds no point", "one line x,y,z in metres for each")
    return points


def load_readings(path: Path, arm: ArmConfig) -> tuple[Touch, ...]:
    """Touches as `readings_text` wrote them.

    Raises:
        ConfigError: what is wrong in the file, or that it belongs to another arm.
    """
    readings = validate(Readings, parse_yaml(read_text(path, "readings"), str(path)), str(path))
    if readings.arm_id != arm.arm_id:
        raise ConfigError(str(path), "arm_id", f"readings of {readings.arm_id!r}, the calibration is {arm.arm_id!r}")
    for i, touch in enumerate(readings.touches):
        if len(touch.ticks) != len(arm.joints):
            found = f"{len(touch.ticks)} values for {len(arm.joints)} servos"
            raise ConfigError(str(path), f"touches.{i}.ticks", found)
    return readings.touches


def readings_text(arm_id: str, touches: Iterable[Touch]) -> str:
    """YAML of touches of an arm."""
    readings = Readings(arm_id=arm_id, touches=tuple(touches))
    return yaml.safe_dump(readings.model_dump(mode="json"), sort_keys=False, default_flow_style=None)


def read_ticks(bus: ServoBus, joints: Sequence[ServoJoint], clock: Clock) -> tuple[float, ...]:
    """Mean position of every servo of a limp arm that is held still; takes 0.6 s, 3 s behind a slow adapter.

    Raises:
        RequestRefused: a servo is silent or has its torque on, or the arm moved.
        PortGone: the port vanished.
    """
    ticks = np.empty((READINGS, len(joints)))
    bus.port.allow_latency(IDENTIFY_LATENCY_MS)
    due_ns = clock.now_ns()
    for row in ticks:
        clock.sleep_until_ns(due_ns)
        due_ns += READING_PERIOD_NS
        row[:] = limp_ticks(bus, joints)
    return mean_ticks(joints, ticks)


def mean_ticks(joints: Sequence[ServoJoint], ticks: FloatArray) -> tuple[float, ...]:
    """The mean of readings, shape (m, joints), of an arm that stood still; RequestRefused (MOVED): it did not."""
    spread = np.ptp(ticks, axis=0)
    if spread.max() > MAX_SPREAD_TICK:
        moved = joints[int(spread.argmax())].name
        raise refusal("MOVED", joint=moved, ticks=spread.max())
    return tuple(ticks.mean(axis=0).round(3).tolist())


def limp_ticks(bus: ServoBus, joints: Sequence[ServoJoint]) -> tuple[int, ...]:
    """Present position of every servo of a limp arm; raises as `read_ticks`, but for one that moves."""
    ticks = list[int]()
    for _ in range(SAMPLES):
        sample = bus.read_sample()
        if not sample.port_open or all(reading.fresh for reading in sample.servos):
            break
    if not sample.port_open:
        raise PortGone(f"{bus.port.port_name}: the port vanished; plug the adapter in again")
    for joint, reading in zip(joints, sample.servos, strict=True):
        if not reading.fresh:
            raise refusal("SERVO_SILENT limp", servo_id=joint.servo_id, name=joint.name, problem=reading.problem)
        if ax12a.register_value(ax12a.TORQUE_ENABLE, reading.registers):
            raise refusal("TORQUE_ON limp", servo_id=joint.servo_id, name=joint.name)
        ticks.append(ax12a.register_value(ax12a.PRESENT_POSITION, reading.registers))
    return tuple(ticks)


# ------------------------------------------------------------------------------------------------------------ fit


def touches_needed(arm: ArmConfig) -> int:
    """Fewest touches for a fit: half as many equations again as unknowns."""
    robot = robots.get(arm.robot)
    return math.ceil(1.5 * (robot.chain.n + len(robot.lengths_m)) / 3.0)


def check_points(arm: ArmConfig, points_m: Sequence[tuple[float, float, float]]) -> None:
    """Refuse touches of these points, one for each, if they are too few to tell anything (TOO_FEW_POINTS)."""
    if len(points_m) < touches_needed(arm):
        raise refusal("TOO_FEW_POINTS touches", touches=len(points_m), least=touches_needed(arm))
    if (places := len(set(points_m))) < FEWEST_POINTS:
        raise refusal("TOO_FEW_POINTS places", places=places, least=FEWEST_POINTS)


def fit(arm: ArmConfig, touches: Sequence[Touch]) -> Fit:
    """Zero ticks and lengths by least squares.

    Raises:
        RequestRefused: too few touches or points, or no arm of this model fits them.
    """
    check_points(arm, [touch.point_m for touch in touches])
    robot = robots.of(arm)
    n, names = robot.chain.n, list(robot.lengths_m)
    directions = np.array([joint.direction for joint in arm.joints[:n]], dtype=np.float64)
    points = np.array([touch.point_m for touch in touches])
    ticks = np.array([touch.ticks[:n] for touch in touches])
    start = np.array([joint.zero_tick for joint in arm.joints[:n]] + [robot.lengths_m[name] * MM for name in names])

    def missed(x: FloatArray) -> FloatArray:
        """Tool less point [mm], shape (3 m,), by zeros [ticks] and lengths [mm]."""
        chosen = robot.with_lengths(dict(zip(names, (x[n:] / MM).tolist(), strict=True)))
        q = directions * (ticks - x[:n]) * ax12a.TICK_RAD
        return np.ravel((tool_position(chosen.chain, q) - points) * MM)

    held: dict[int, str] = {}
    labels = [f"{joint.name}.zero_tick" for joint in arm.joints[:n]] + [f"lengths_m.{name}" for name in names]
    x, J = _solve(missed, start, held)
    while weak := _weakest(J, held, labels):
        held[weak[0]] = weak[1]
        x, J = _solve(missed, start, held)
    residual = missed(x)
    rms_mm = _rms(residual)
    if not rms_mm <= MAX_RMS_MM:
        raise refusal("POOR_FIT limp", rms_mm=rms_mm, most_mm=MAX_RMS_MM)
    free = [i for i in range(x.size) if i not in held]
    errors = np.full(x.size, np.nan)
    variance = float(residual @ residual) / (residual.size - len(free))
    left_alone = [i for i in range(x.size) if i in held]
    absorbed = np.linalg.lstsq(J[:, free], J[:, left_alone], rcond=None)[0]
    absorbed *= np.array([HELD_ERROR_TICK if i < n else HELD_ERROR_MM for i in left_alone])
    errors[free] = np.sqrt(variance * np.diag(np.linalg.inv(J[:, free].T @ J[:, free])) + np.sum(absorbed**2, axis=1))
    scale = np.array([1.0] * n + [1.0 / MM] * len(names))
    columns = zip(labels, *((column * scale).tolist() for column in (start, x, errors)), strict=True)
    parameters = [
        {"name": name, "unit": "tick" if i < n else "m", "before": before, "after": after}
        | {"standard_error": None if i in held else error, "held": held.get(i, "")}
        for i, (name, before, after, error) in enumerate(columns)
    ]
    for joint in arm.joints[n:]:
        known = {"before": joint.zero_tick, "after": joint.zero_tick, "standard_error": None, "held": BEYOND_CHAIN}
        parameters.append({"name": f"{joint.name}.zero_tick", "unit": "tick", **known})
    zeros = [*x[:n].tolist(), *(joint.zero_tick for joint in arm.joints[n:])]
    lengths_m = {name: float(x[n + i] / MM) for i, name in enumerate(names) if n + i not in held}
    return Fit(
        arm=recalibrated(arm, zeros, {**arm.lengths_m, **lengths_m}),
        parameters=parameters,
        residuals_mm=np.linalg.norm(residual.reshape(-1, 3), axis=1).tolist(),
        rms_before_mm=_rms(missed(start)),
        rms_mm=rms_mm,
        complete=not held,
    )


def slopes(of: Residuals, x: FloatArray, step: float) -> FloatArray:
    """How each value of a function grows with each argument, by central differences; shape (values, arguments)."""
    return np.stack([(of(x + d) - of(x - d)) / (2.0 * step) for d in step * np.eye(len(x))], axis=1)


def _solve(missed: Residuals, start: FloatArray, held: dict[int, str]) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton over what is not held; parameters and the last matrix."""
    x = start.copy()
    free = [i for i in range(x.size) if i not in held]
    for _ in range(ITERATIONS):
        J = slopes(missed, x, WIDTH)
        # Minimum-norm: a direction the points do not show is not followed, whatever the numbers say.
        step = np.linalg.lstsq(J[:, free], missed(x), rcond=1e-9)[0]
        x[free] -= step
        if np.abs(step).max() <= STEP:
            break
    return x, J


def _weakest(J: FloatArray, held: dict[int, str], labels: Sequence[str]) -> tuple[int, str] | None:
    """The parameter that cannot be told, and why; None: all can."""
    free = [i for i in range(J.shape[1]) if i not in held]
    _, values, directions = np.linalg.svd(J[:, free], full_matrices=False)
    if values[-1] >= WEAK:
        return None
    weight = np.abs(directions[-1])
    worst = int(weight.argmax())
    others = [labels[free[i]] for i in np.flatnonzero(weight > CONFUSED) if i != worst]
    why = f"these points hardly tell it from {', '.join(others)}" if others else "these points do not show it"
    return free[worst], why


def _rms(residual_mm: FloatArray) -> float:
    """Root mean square distance of points whose coordinates' residuals these are."""
    return math.sqrt(3.0 * float(np.mean(residual_mm**2)))


# --------------------------------------------------------------------------------------------------- the new file


def zeroed(arm: ArmConfig, ticks: Sequence[float], positions_rad: Sequence[float]) -> ArmConfig:
    """The arm whose joints stand at `positions_rad` when the servos read `ticks`; a gripper's stays as it is."""
    grips = arm.gripper and arm.gripper.joint
    zeros = [
        joint.zero_tick + (tick - joint.tick(position) if joint.name != grips else 0.0)
        for joint, tick, position in zip(arm.joints, ticks, positions_rad, strict=True)
    ]
    return recalibrated(arm, zeros, arm.lengths_m)


def recalibrated(arm: ArmConfig, zero_ticks: Sequence[float], lengths_m: dict[str, float]) -> ArmConfig:
    """The arm with other zeros and lengths, its limits and rest pose staying at the same ticks.

    Stops and EEPROM limits stand at ticks and do not move because an angle gets a truer number. Limits are
    rounded outwards to 0.01 deg, much less than a tick: their whole ticks stay.

    Raises:
        ConfigError: a zero or length is beyond any arm.
    """
    data = arm.model_dump(mode="json", exclude_unset=True)
    if lengths_m:
        data["lengths_m"] = {name: round(length, 6) for name, length in lengths_m.items()}
    for joint, item, zero in zip(arm.joints, data["joints"], zero_ticks, strict=True):
        zero_tick = round(float(zero), 2)
        if zero_tick == joint.zero_tick:
            continue
        moved = joint.model_copy(update={"zero_tick": zero_tick})
        low, high = sorted(math.degrees(moved.position_rad(tick)) for tick in joint.limits_tick)
        low, high = math.floor(low * 100.0) / 100.0, math.ceil(high * 100.0) / 100.0
        rest = round(math.degrees(moved.position_rad(joint.tick(joint.rest_rad))), 2)
        if joint.linkage and joint.pair and joint.pair.zero_tick is not None:  # what it reads beside the first stays
            item["pair"]["zero_tick"] = round(joint.linkage.second(zero_tick), 2)
        item |= {"zero_tick": zero_tick, "limits_deg": [low, high], "rest_deg": min(max(rest, low), high)}
    return validate(ArmConfig, data, "the new calibration")


def calibration_text(arm: ArmConfig, remarks: Sequence[str]) -> str:
    """The YAML file of an arm, opening with remarks."""
    data = arm.model_dump(mode="json", exclude_unset=True)
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=120)
    return "".join(f"# {remark}\n" for remark in remarks) + text
