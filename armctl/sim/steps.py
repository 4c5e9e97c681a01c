"""The millisecond steps of the simulated joints, as functions of plain numbers; `joint.py` and `arm.py` have the laws.

Nothing here knows of servos, and of registers only where they lie, so that numba can make machine code of it:
`compiled`, once in a process, makes what takes the most time of a simulation about a hundred times faster, bit for bit
the same. Without numba (the extra `fast`) everything runs as it stands.

All that changes lies in three flat arrays, see `state.py`: `numbers` and `counts` hold the arm's own and then those of
one joint after another, `chain` the links. The names in capitals below are places in them: of the arm's from 0 on, of
joint i's from `ARM_NUMBERS + i * JOINT_NUMBERS` (written `at`) and `ARM_COUNTS + i * JOINT_COUNTS` (`of`) on.

All functions stay in this one file, because numba keeps machine code until the file of a function changes, and does
not see those of the functions it calls.
"""

from __future__ import annotations

import functools
import math
from array import array

from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import LOAD_MAX, SPEED_UNIT_RAD_S, TICK_MAX, TICK_RAD, ErrorBit

STEP_S = 1e-3
HIGHEST_RAD = TICK_MAX * TICK_RAD
TURN_TICK = 2.0 * math.pi / TICK_RAD
EDGE_TICK = 10.0
"""The resistive track ends this far beyond 0 and 1023: a guess."""
STIFFNESS_NM_RAD = 60.0
DAMPING_NM_S = 0.6
MAX_TORQUE_NM = 2.0
"""Of the hand that guides the arm."""
GRAVITY_M_S2 = 9.81
RATED_V = 12.0
"""The supply at which stall torque and no-load speed are stated."""
OVERLOAD, VOLTAGE, OVERHEAT = int(ErrorBit.OVERLOAD), int(ErrorBit.VOLTAGE), int(ErrorBit.OVERHEAT)
TORQUE_ENABLE_AT, GOAL_AT = ax12a.TORQUE_ENABLE.address, ax12a.GOAL.address
POSITION_AT, SPEED_AT, LOAD_AT = ax12a.PRESENT_POSITION.address, ax12a.PRESENT_SPEED.address, ax12a.PRESENT_LOAD.address
VOLTAGE_AT, TEMPERATURE_AT = ax12a.PRESENT_VOLTAGE.address, ax12a.PRESENT_TEMPERATURE.address
MOVING_AT = ax12a.MOVING.address

# fmt: off
(
    # What the supply gives without load, and under the present one.
    SUPPLY_V, VOLTAGE_V,
    # Of the spec; when a chunk is a short one; within what gravity stays as it was weighed; what a chunk leaves of a
    # difference in temperature.
    NO_LOAD_RAD_S, FRICTION_NM, SLIP_RAD, OVERLOAD_OUTPUT, OVERLOAD_S, SUPPLY_OHM, STALL_A, IDLE_DEGC, HEATING_DEGC,
    ROTOR_KG_M2, SUPPORT_RAD, FAST_RAD_S, WEIGHED_RAD, DECAY, FAST_DECAY,
    ARM_NUMBERS,
) = range(18)
(
    # Those a servo reports.
    SHAFT, OMEGA, OUTPUT, REFERENCE, DEGC, SERVO_V,
    # Motor; where the ramp began; current as a fraction of the stall current.
    MOTOR, RAMP_BEGIN, EFFORT,
    # Gravity, step over inertia, and the shaft's angle that these belong to.
    LOAD, RATE, WEIGHED_AT,
    # What the joint is made of, in the order `Joint` takes it; low and high may be where something holds the shaft.
    DIRECTION, ZERO, REST, COULOMB, STICTION, HALF_PLAY, LOW, HIGH, STALL, BRAKE,
    # The drive, in the order `Joint.drive_by` writes it; the hand's aim of the shaft and its speed.
    GOAL, RAMP, LIMIT, PUNCH, CW_GAIN, CCW_GAIN, SPIN, AIM, AIM_SPEED,
    JOINT_NUMBERS,
) = range(32)
(
    JOINTS, LINKS,
    # Steps since the first `advance`; those at which the present chunk begins and ends; its length, slow and fast.
    STEP, CHUNK_STEP, CHUNK_END, CHUNK_STEPS, FAST_CHUNK_STEPS,
    # Whether gravity and inertia belong to the present configuration; whether anything changed in this chunk; whether
    # nothing did in the one before; whether nothing will until an input does; whether a hand pulls; whether some joint
    # asks for its servo.
    WEIGHED, STIRRED, STILL, RESTING, PULLS, ASKING,
    # Whether a servo was told something that the physics has not heard of; how often one's EEPROM was written to.
    TOLD, EEPROM_WRITES,
    ARM_COUNTS,
) = range(16)
(
    # Steps it has been integrated beyond the arm's time; since the ramp's begin; of too high an output.
    AHEAD, RAMPED, LOADED,
    # Whether drive or reference are others; what the drive says; what a frozen sensor reads, or -1; no torque at all.
    FRESH, ENABLED, SPINS, CW_MARGIN, CCW_MARGIN, FROZEN, DEAD,
    # Alarms: that stands, registers in the order the servo writes them; whether its servo has to be looked at.
    OVERLOADED, MAX_DEGC, MIN_DV, MAX_DV, SHUTDOWN, ASKS,
    # Whether its firmware is starting, and when that is over; whether a limp servo's goal follows its position.
    BOOTING, BOOT_STEP, FOLLOWS,
    JOINT_COUNTS,
) = range(20)
(TOOL_M, MODIFIED, CHAIN_NUMBERS) = range(3)
(COS_ALPHA, SIN_ALPHA, LINK_A, LINK_D, OFFSET, ANGLE, TORQUE, INERTIA, AXIS_X, AXIS_Y, AXIS_Z, LINK_NUMBERS) = range(12)
(POINT_X, POINT_Y, POINT_Z, POINT_KG, POINT_NUMBERS) = range(5)
# fmt: on

machine_code = False
"""Whether the functions below run as such."""


@functools.cache
def compiled() -> bool:
    """Let the functions below run as machine code from now on; whether they do: numba has to be there for it."""
    try:
        from numba import njit
    except ImportError:
        return False
    for name in (
        *("sensed_tick", "output_at", "hand_torque", "play_drift", "integrate", "weigh_links", "weigh"),
        *("far", "begin_chunk", "alarms", "turn", "drain", "warm", "close_chunk", "play"),
        *("to_signed_magnitude", "measure"),
    ):
        plain = globals()[name]
        try:
            globals()[name] = njit(cache=True)(plain)
        except RuntimeError:  # nowhere to keep machine code: it is made anew
            globals()[name] = njit(plain)
    globals()["machine_code"] = True
    return True


def sensed_tick(position_tick: float) -> int:
    """What the potentiometer reads at a shaft angle, the dead zone included."""
    tick = math.floor(position_tick + 0.5)
    if 0 <= tick <= TICK_MAX:
        return tick
    turned = position_tick % TURN_TICK
    if turned > TURN_TICK - EDGE_TICK:
        return 0
    if turned > TICK_MAX + EDGE_TICK:
        return int(turned * 64.0) * 0x9E3779B1 >> 12 & TICK_MAX  # erratic, yet the same at the same angle
    return min(math.floor(turned + 0.5), TICK_MAX)


def output_at(
    error_tick: int, limit: float, punch: float, cw_margin: int, ccw_margin: int, cw_gain: float, ccw_gain: float
) -> float:
    """Output at a distance from the goal [tick], CCW positive: 0 in the margin, then punch and slope."""
    if error_tick > ccw_margin:
        output = punch + (error_tick - ccw_margin) * ccw_gain
        return output if output < limit else limit
    if error_tick < -cw_margin:
        output = punch - (error_tick + cw_margin) * cw_gain
        return -output if output < limit else -limit
    return 0.0


def hand_torque(behind_rad: float, slower_rad_s: float) -> float:
    """Torque of the hand [N m] on a joint that is so far behind its aim and so much slower."""
    torque = STIFFNESS_NM_RAD * behind_rad + DAMPING_NM_S * slower_rad_s
    if torque > MAX_TORQUE_NM:
        return MAX_TORQUE_NM
    return torque if torque > -MAX_TORQUE_NM else -MAX_TORQUE_NM


def play_drift(external_Nm: float, friction_Nm: float, slip_rad: float) -> float:
    """How far a torque pushes the shaft through its play in a step [rad]; its friction holds it against less."""
    if -friction_Nm <= external_Nm <= friction_Nm:
        return 0.0
    return slip_rad if external_Nm > 0.0 else -slip_rad


def integrate(
    shaft: float,
    motor: float,
    omega: float,
    step: int,
    count: int,
    start: float,
    goal: float,
    ramp: float,
    arrival: int,
    load: float,
    rate: float,
    coulomb: float,
    stiction: float,
    half_play: float,
    low: float,
    high: float,
    stall: float,
    brake: float,
    friction: float,
    slip: float,
    frozen_tick: int,
    enabled: bool,
    spins: bool,
    spin: float,
    limit: float,
    punch: float,
    cw_margin: int,
    ccw_margin: int,
    cw_gain: float,
    ccw_gain: float,
    pulls: bool,
    aim: float,
    aim_speed: float,
    pulled: int,
) -> tuple[float, float, float, float]:
    """Let `count` steps pass; shaft [rad], motor [rad], its velocity [rad/s] and its output afterwards.

    Args:
        step: Steps taken since the ramp's begin, at `start` [tick].
        ramp: Its way in a step [tick], with its sign.
        arrival: The step in which the reference gets to the goal.
        rate: Step over inertia.
        stall, brake: Torque of the motor at full output [N m], and against its velocity [N m s]; 0: no motor.
        frozen_tick: What a frozen sensor reads; -1: it works.
        spins: Whether in wheel mode, at the output `spin`.
        pulls: Whether a hand pulls the shaft to `aim` [rad], which moves at `aim_speed` [rad/s] since step `-pulled`.
    """
    end = step + count
    external = load
    drift = play_drift(external, friction, slip)
    output = push = 0.0
    near, far, sensed = math.inf, -math.inf, 0
    held = False
    held_shaft = held_motor = 0.0
    while step < end:
        step += 1
        whole = math.floor((goal if step >= arrival else start + ramp * step) + 0.5)
        last = end
        if step < arrival and whole != goal:  # the last step before the reference gets to another tick
            if ramp > 0.0:
                last = min(end, max(step, math.ceil((whole + 0.5 - start) / ramp) - 1))
            else:
                last = min(end, max(step, math.floor((whole - 0.5 - start) / ramp)))
        stale = True
        for now in range(step, last + 1):
            if stale:
                stale = False
                if not near <= shaft < far:
                    # What the servo takes its shaft for, and the angles from near to below far it takes for the same.
                    if frozen_tick >= 0:
                        sensed, near, far = frozen_tick, low, high
                    elif low < 0.0 or high > HIGHEST_RAD:
                        sensed = sensed_tick(shaft / TICK_RAD)
                    else:
                        sensed = math.floor(shaft / TICK_RAD + 0.5)
                        near = (sensed - 0.5) * TICK_RAD
                        far = near + TICK_RAD
                        near = max(near, low)
                        far = min(far, high)
                if spins:
                    output = spin
                elif enabled:
                    output = output_at(whole - sensed, limit, punch, cw_margin, ccw_margin, cw_gain, ccw_gain)
                push = stall * output
            if pulls:
                external = load + hand_torque(aim + aim_speed * ((pulled + now) * STEP_S) - shaft, aim_speed - omega)
                drift = play_drift(external, friction, slip)
            torque = push - brake * omega + external
            if omega > 0.0:
                omega += (torque - coulomb) * rate
                if omega < 0.0:
                    omega = 0.0
            elif omega < 0.0:
                omega += (torque + coulomb) * rate
                if omega > 0.0:
                    omega = 0.0
            elif torque > stiction:
                omega = (torque - coulomb) * rate
            elif torque < -stiction:
                omega = (torque + coulomb) * rate
            else:
                held, held_shaft, held_motor = True, shaft, motor
            motor += omega * STEP_S
            shaft += drift
            if shaft > motor + half_play:
                shaft = motor + half_play
            elif shaft < motor - half_play:
                shaft = motor - half_play
            if not near <= shaft < far:
                stale = True
                if shaft < low:
                    motor, shaft, omega = motor + low - shaft, low, max(omega, 0.0)
                elif shaft > high:
                    motor, shaft, omega = motor + high - shaft, high, min(omega, 0.0)
            if held:
                held = False
                if shaft == held_shaft and motor == held_motor and not pulls:
                    break  # and so would every further step up to `last`
        step = last
    return shaft, motor, omega, output


def weigh_links(chain: array[float], links: int) -> None:
    """Gravity torque [N m] and inertia [kg m^2] about every axis of a chain; `gravity.py` has the law."""
    modified = chain[MODIFIED] != 0.0
    points = CHAIN_NUMBERS + links * LINK_NUMBERS
    ox = oy = oz = 0.0
    xx, xy, xz, yx, yy, yz, zx, zy, zz = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    px = py = pz = 0.0
    for i in range(links):
        at = CHAIN_NUMBERS + i * LINK_NUMBERS
        ca, sa, a, d = chain[at + COS_ALPHA], chain[at + SIN_ALPHA], chain[at + LINK_A], chain[at + LINK_D]
        if modified:
            ox, oy, oz = ox + a * xx, oy + a * xy, oz + a * xz
            if sa != 0.0:
                yx, yy, yz, zx, zy, zz = (
                    ca * yx + sa * zx, ca * yy + sa * zy, ca * yz + sa * zz,
                    ca * zx - sa * yx, ca * zy - sa * yy, ca * zz - sa * yz,
                )  # fmt: skip
        px, py, pz = ox, oy, oz
        chain[at + AXIS_X], chain[at + AXIS_Y], chain[at + AXIS_Z] = zx, zy, zz
        point = points + i * POINT_NUMBERS
        chain[point + POINT_X], chain[point + POINT_Y], chain[point + POINT_Z] = px, py, pz
        angle = chain[at + ANGLE] + chain[at + OFFSET]
        c, s = math.cos(angle), math.sin(angle)
        ox, oy, oz = ox + d * zx, oy + d * zy, oz + d * zz
        xx, xy, xz, yx, yy, yz = (
            c * xx + s * yx, c * xy + s * yy, c * xz + s * yz,
            c * yx - s * xx, c * yy - s * xy, c * yz - s * xz,
        )  # fmt: skip
        if not modified:
            ox, oy, oz = ox + a * xx, oy + a * xy, oz + a * xz
            if sa != 0.0:
                yx, yy, yz, zx, zy, zz = (
                    ca * yx + sa * zx, ca * yy + sa * zy, ca * yz + sa * zz,
                    ca * zx - sa * yx, ca * zy - sa * yy, ca * zz - sa * yz,
                )  # fmt: skip
    tool_m = chain[TOOL_M]
    ox, oy, oz = ox + tool_m * xx, oy + tool_m * xy, oz + tool_m * xz
    end = points + links * POINT_NUMBERS
    chain[end + POINT_X], chain[end + POINT_Y], chain[end + POINT_Z] = (px + ox) / 2.0, (py + oy) / 2.0, (pz + oz) / 2.0
    end += POINT_NUMBERS
    chain[end + POINT_X], chain[end + POINT_Y], chain[end + POINT_Z] = ox, oy, oz
    for i in range(links):
        at = CHAIN_NUMBERS + i * LINK_NUMBERS
        ux, uy, uz = chain[at + AXIS_X], chain[at + AXIS_Y], chain[at + AXIS_Z]
        point = points + i * POINT_NUMBERS
        px, py, pz = chain[point + POINT_X], chain[point + POINT_Y], chain[point + POINT_Z]
        torque = inertia = 0.0
        while point < end:
            point += POINT_NUMBERS
            rx, ry, rz = chain[point + POINT_X] - px, chain[point + POINT_Y] - py, chain[point + POINT_Z] - pz
            kg = chain[point + POINT_KG]
            vx, vy, vz = uy * rz - uz * ry, uz * rx - ux * rz, ux * ry - uy * rx
            torque -= kg * vz
            inertia += kg * (vx * vx + vy * vy + vz * vz)
        chain[at + TORQUE] = GRAVITY_M_S2 * torque
        chain[at + INERTIA] = inertia


def weigh(numbers: array[float], counts: array[int], chain: array[float]) -> None:
    """Gravity torque and diagonal inertia of every joint, from the true configuration."""
    counts[WEIGHED] = 1
    links, supported = counts[LINKS], True
    for i in range(counts[JOINTS]):
        at = ARM_NUMBERS + i * JOINT_NUMBERS
        angle = numbers[at + DIRECTION] * (numbers[at + SHAFT] - numbers[at + ZERO])
        if not abs(angle - numbers[at + REST]) <= numbers[SUPPORT_RAD]:
            supported = False
        if i < links:
            chain[CHAIN_NUMBERS + i * LINK_NUMBERS + ANGLE] = angle
    weigh_links(chain, links)
    for i in range(counts[JOINTS]):
        at = ARM_NUMBERS + i * JOINT_NUMBERS
        if i < links:
            link = CHAIN_NUMBERS + i * LINK_NUMBERS
            numbers[at + LOAD] = 0.0 if supported else numbers[at + DIRECTION] * chain[link + TORQUE]
            numbers[at + RATE] = STEP_S / (numbers[ROTOR_KG_M2] + chain[link + INERTIA])
            numbers[at + WEIGHED_AT] = numbers[at + SHAFT]
        else:
            numbers[at + LOAD] = 0.0
            numbers[at + RATE] = STEP_S / numbers[ROTOR_KG_M2]


def far(numbers: array[float], counts: array[int]) -> bool:
    """Whether a joint has come so far that gravity is to be weighed again."""
    weighed_rad = numbers[WEIGHED_RAD]
    for i in range(counts[LINKS]):
        at = ARM_NUMBERS + i * JOINT_NUMBERS
        if not -weighed_rad <= numbers[at + SHAFT] - numbers[at + WEIGHED_AT] <= weighed_rad:
            return True
    return False


def begin_chunk(numbers: array[float], counts: array[int], chain: array[float]) -> None:
    """Begin a chunk at the present step, a short one while a joint is fast; weigh the arm if it is time."""
    fast, fast_rad_s = False, numbers[FAST_RAD_S]
    for i in range(counts[JOINTS]):
        if not -fast_rad_s <= numbers[ARM_NUMBERS + i * JOINT_NUMBERS + OMEGA] <= fast_rad_s:
            fast = True
    counts[CHUNK_STEP] = counts[STEP]
    counts[CHUNK_END] = counts[STEP] + (counts[FAST_CHUNK_STEPS] if fast else counts[CHUNK_STEPS])
    if not counts[WEIGHED] and (counts[STILL] or far(numbers, counts)):
        weigh(numbers, counts, chain)


def alarms(numbers: array[float], counts: array[int], at: int, of: int) -> int:
    """Error bits of a servo that stand."""
    error = OVERLOAD if counts[of + OVERLOADED] else 0
    if not counts[of + MIN_DV] <= round(numbers[at + SERVO_V] * 10.0) <= counts[of + MAX_DV]:
        error |= VOLTAGE
    if round(numbers[at + DEGC]) > counts[of + MAX_DEGC]:
        error |= OVERHEAT
    return error


def turn(numbers: array[float], counts: array[int], i: int, ahead: int) -> None:
    """Let joint i come to `ahead` steps, at most to the end of the chunk, beyond where all joints are."""
    at, of = ARM_NUMBERS + i * JOINT_NUMBERS, ARM_COUNTS + i * JOINT_COUNTS
    begin = counts[of + AHEAD]
    count = ahead - begin
    if count <= 0:
        return
    counts[of + AHEAD] = ahead
    enabled, spins = counts[of + ENABLED] != 0, counts[of + SPINS] != 0
    if counts[of + FRESH]:
        counts[of + FRESH] = counts[of + RAMPED] = 0
        numbers[at + RAMP_BEGIN] = numbers[at + REFERENCE]
    step, start, goal, ramp = counts[of + RAMPED], numbers[at + RAMP_BEGIN], numbers[at + GOAL], numbers[at + RAMP]
    if spins:
        start = goal
    elif not enabled:
        goal = start
    arrival = 0  # in which step, counted from 1 at the ramp's begin, the reference reaches the goal
    if start != goal:
        arrival = math.ceil(abs(goal - start) / ramp) if ramp != 0.0 else 1
        if goal < start:
            ramp = -ramp
    stall = brake = 0.0
    if enabled and not counts[of + DEAD]:
        stall, brake = numbers[at + STALL] * (numbers[VOLTAGE_V] / RATED_V), numbers[at + BRAKE]
    turns = enabled and spins  # numba takes no decision among so many arguments
    shaft_before, omega_before = numbers[at + SHAFT], numbers[at + OMEGA]
    shaft, motor, omega, output = integrate(
        shaft_before, numbers[at + MOTOR], omega_before, step, count, start, goal, ramp, arrival,
        numbers[at + LOAD], numbers[at + RATE], numbers[at + COULOMB], numbers[at + STICTION], numbers[at + HALF_PLAY],
        numbers[at + LOW], numbers[at + HIGH], stall, brake, numbers[FRICTION_NM], numbers[SLIP_RAD],
        counts[of + FROZEN], enabled, turns, numbers[at + SPIN], numbers[at + LIMIT], numbers[at + PUNCH],
        counts[of + CW_MARGIN], counts[of + CCW_MARGIN], numbers[at + CW_GAIN], numbers[at + CCW_GAIN],
        counts[PULLS] != 0, numbers[at + AIM], numbers[at + AIM_SPEED],
        counts[STEP] + begin - counts[CHUNK_STEP] - step - 1,
    )  # fmt: skip
    moved = step < arrival or omega != 0.0 or omega != omega_before or shaft != shaft_before
    end = step + count
    numbers[at + SHAFT], numbers[at + MOTOR], numbers[at + OMEGA], numbers[at + OUTPUT] = shaft, motor, omega, output
    numbers[at + REFERENCE] = goal if end >= arrival else start + ramp * end
    counts[of + RAMPED] = end
    effort = output - omega / numbers[NO_LOAD_RAD_S] if output != 0.0 else 0.0
    numbers[at + EFFORT] = effort
    asks = False
    if enabled and not -numbers[OVERLOAD_OUTPUT] <= effort <= numbers[OVERLOAD_OUTPUT]:
        moved = True
        counts[of + LOADED] += count
        if counts[of + LOADED] * STEP_S > numbers[OVERLOAD_S] and not counts[of + OVERLOADED]:
            counts[of + OVERLOADED] = 1
            asks = True
    else:
        counts[of + LOADED] = 0
    if enabled and alarms(numbers, counts, at, of) & counts[of + SHUTDOWN]:
        asks = True
    if counts[of + BOOTING]:
        moved = True
        if counts[STEP] + ahead >= counts[of + BOOT_STEP]:
            counts[of + BOOTING] = 0
            asks = True
    if asks:
        counts[of + ASKS] = counts[ASKING] = 1
    if moved:
        counts[WEIGHED], counts[STIRRED] = 0, 1


def drain(numbers: array[float], counts: array[int]) -> bool:
    """Renew the voltage under the present load; whether it is another than before."""
    current_A = 0.0
    for i in range(counts[JOINTS]):
        at = ARM_NUMBERS + i * JOINT_NUMBERS
        output = numbers[at + OUTPUT]
        if output != 0.0:
            current_A += max(0.0, output * numbers[at + EFFORT]) * numbers[STALL_A]
    voltage_V = max(0.0, numbers[SUPPLY_V] - numbers[SUPPLY_OHM] * current_A)
    if voltage_V == numbers[VOLTAGE_V]:
        return False
    numbers[VOLTAGE_V] = voltage_V
    for i in range(counts[JOINTS]):
        numbers[ARM_NUMBERS + i * JOINT_NUMBERS + SERVO_V] = voltage_V
    return True


def warm(numbers: array[float], counts: array[int], decay: float) -> None:
    """Bring the temperatures nearer to where the present efforts lead; `decay` is what is left of the way."""
    idle, heating = numbers[IDLE_DEGC], numbers[HEATING_DEGC]
    for i in range(counts[JOINTS]):
        at = ARM_NUMBERS + i * JOINT_NUMBERS
        effort = numbers[at + EFFORT]
        settled = idle + heating * effort * effort
        numbers[at + DEGC] = settled + (numbers[at + DEGC] - settled) * decay


def close_chunk(numbers: array[float], counts: array[int]) -> None:
    """End the chunk: supply, temperatures, and whether the arm rests from now on."""
    if drain(numbers, counts):
        counts[STIRRED] = 1
    slow = counts[CHUNK_END] - counts[CHUNK_STEP] == counts[CHUNK_STEPS]
    warm(numbers, counts, numbers[DECAY] if slow else numbers[FAST_DECAY])
    counts[STILL], counts[STIRRED] = 0 if counts[STIRRED] else 1, 0
    # At rest nothing changes until an input does, if gravity is the one of this very configuration.
    counts[RESTING] = 1 if counts[WEIGHED] and counts[STILL] and not counts[PULLS] else 0


def play(numbers: array[float], counts: array[int], chain: array[float], until: int, only: int) -> bool:
    """Let time pass to the step `until`, or to where somebody has to look: at rest, or at a joint that asks.

    While a hand pulls it goes to the end of a chunk at most, because the aim is another in the next one.

    Args:
        only: The one joint that will be looked at, or -1; within a chunk the others then stay behind.
    Returns:
        Whether only this joint was brought to `until`.
    """
    while counts[STEP] < until:
        if counts[STEP] >= counts[CHUNK_END]:
            begin_chunk(numbers, counts, chain)
        due, left = until - counts[STEP], counts[CHUNK_END] - counts[STEP]
        if only >= 0 and due < left:
            turn(numbers, counts, only, due)
            return True
        count = min(due, left)
        for i in range(counts[JOINTS]):
            turn(numbers, counts, i, count)
            counts[ARM_COUNTS + i * JOINT_COUNTS + AHEAD] -= count
        counts[STEP] += count
        if counts[ASKING]:  # whoever looks closes the chunk
            break
        if count == left:
            close_chunk(numbers, counts)
            if counts[RESTING] or counts[PULLS]:
                break
    return False


def to_signed_magnitude(value: int) -> int:
    """A speed or load as its register has it, saturating at 1023: the inverse of `ax12a.signed_magnitude`."""
    return min(-value, 1023) | 0x400 if value < 0 else min(value, 1023)


def measure(numbers: array[float], counts: array[int], table: bytearray, i: int, noise_tick: float) -> int:
    """Bring what servo i measures up to date in its control table; the error bits that stand.

    Args:
        noise_tick: Of the position.
    """
    at, of = ARM_NUMBERS + i * JOINT_NUMBERS, ARM_COUNTS + i * JOINT_COUNTS
    enabled = table[TORQUE_ENABLE_AT] != 0
    position, speed = counts[of + FROZEN], 0
    if position < 0:
        position = sensed_tick(numbers[at + SHAFT] / TICK_RAD + noise_tick)
        speed = round(numbers[at + OMEGA] / SPEED_UNIT_RAD_S)
    if not enabled and counts[of + FOLLOWS]:
        table[GOAL_AT], table[GOAL_AT + 1] = position & 0xFF, position >> 8
    shown_speed, shown_load = to_signed_magnitude(speed), to_signed_magnitude(round(numbers[at + OUTPUT] * LOAD_MAX))
    table[POSITION_AT], table[POSITION_AT + 1] = position & 0xFF, position >> 8
    table[SPEED_AT], table[SPEED_AT + 1] = shown_speed & 0xFF, shown_speed >> 8
    table[LOAD_AT], table[LOAD_AT + 1] = shown_load & 0xFF, shown_load >> 8
    table[VOLTAGE_AT] = min(max(round(numbers[at + SERVO_V] * 10.0), 0), 255)
    table[TEMPERATURE_AT] = min(max(round(numbers[at + DEGC]), 0), 255)
    moving = enabled and (speed != 0 or numbers[at + REFERENCE] != table[GOAL_AT] + 256.0 * table[GOAL_AT + 1])
    table[MOVING_AT] = 1 if moving else 0
    return alarms(numbers, counts, at, of)
