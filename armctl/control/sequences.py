"""What goes on over several ticks: taking an arm over, torque coming on, the way to rest.

Which step comes next stands in `machine.TRANSITIONS`. Every step is decided by what the servos report, not by what was
written to them; and none is decided while one of them is unheard.
"""

import math

from armctl.control.detect import CLEAN_S, REST_AHEAD_S, SILENT_AGE_S
from armctl.control.faults import KINDS
from armctl.control.machine import Motion, Phase, Trigger
from armctl.control.motion import set_off
from armctl.control.stillness import Shaft
from armctl.control.tick import Tick
from armctl.dynamixel import ax12a
from armctl.messages import Event
from armctl.trajectory.approach import approach_trajectory, lowest_link_m
from armctl.trajectory.preflight import EDGE_TICKS

# Torque limit while torque comes on (12.5 %).
SOFT_TORQUE = 128
# No servo takes torque with a goal farther from its shaft (0.6 deg).
ENERGISE_AWAY_TICKS = 2
# How long a limp shaft may take to be known to stand still.
STILL_S = 4.0
# How long the torque limit rises.
RAMP_S = 0.5
# A servo that does not show its full torque limit by then refuses it.
CONFIRM_S = 0.8
JUMP_RAD = math.radians(6.0)
REST_TOLERANCE_RAD = math.radians(3.0)
# How long an arm that has arrived may take to settle at its rest pose.
VERIFY_S = 2.0


# ----------------------------------------------------------------------------------------------- adoption


def adopt(s: Tick) -> None:
    """Take over what the servos are doing: torque on stays on at its goal, off stays off."""
    if not s.state.connected or not s.fresh:
        return
    powered = [servo is not None and servo.torque_enabled for servo in s.servos]
    tripped = [i for i, servo in enumerate(s.servos) if servo is not None and servo.torque_limit == 0]
    weak = s.weak_servos()
    if not any(powered):
        s.go(Trigger.ADOPT_LIMP)
        s.state.powered = False
        return
    # Those that hold are to, and to push against nothing, whatever becomes of the others.
    s.take_over()
    s.state.lazy_ticks = -s.ticks_in(CLEAN_S)  # they may be on their way to their goals yet
    if tripped:
        s.latch_servo("TRIPPED", tripped[0], "found shut down (torque limit 0) while other servos hold")
    elif not all(powered):
        s.latch_servo("LOST_TORQUE", powered.index(False), "found limp while other servos hold")
    elif weak:
        limit = s.status(weak[0]).torque_limit
        s.latch_servo("LOST_TORQUE", weak[0], f"found with torque limit {limit}: its torque-on was interrupted")
    else:
        s.go(Trigger.ADOPT_POWERED)


# ------------------------------------------------------------------------------------------ torque comes on


def energise(s: Tick) -> None:
    """The careful torque-on: soft limit read back, then the goal; enable, watch, ramp the limit up."""
    state, anchor = s.state, s.state.anchor
    if state.ticks == 0:
        return  # asked for in this very tick: the next sample shows what was written
    if not s.fresh:
        state.ticks -= 1  # it waits until every servo has been heard; one that stays silent latches a fault
        return
    limp = [_limp_shaft(s, i) for i in range(len(anchor))]
    surprise = next(filter(None, (_surprise(s, i, anchor[i], limp[i]) for i in range(len(anchor)))), None)
    if surprise:
        s.events.append(Event("warning", *surprise))
        s.go(Trigger.ENERGISE_FAILED)
        s.end_sequence(*surprise)
        s.let_go()
        return
    here = [was if shaft is None else shaft.tick for shaft, was in zip(limp, anchor, strict=True)]
    moved = any(abs(tick - was) > ENERGISE_AWAY_TICKS for tick, was in zip(here, anchor, strict=True))
    match state.phase:
        case Phase.SOFTENING if soften(s):
            pass
        case Phase.SOFTENING | Phase.PREPARING if any(shaft and shaft.still is None for shaft in limp):
            pass
        case Phase.SOFTENING | Phase.PREPARING if moved or state.phase is Phase.SOFTENING:
            # Torque would pull a shaft that has moved back to where it was: another goal, to be looked at again.
            if moved:
                state.anchor = tuple(here)
            s.go(Trigger.SOFT_SEEN if state.phase is Phase.SOFTENING else Trigger.SHAFT_MOVED)
            s.send_goal(state.anchor)
        case Phase.PREPARING:
            s.write_all(ax12a.TORQUE_ENABLE, 1)
            s.send_goal(anchor)  # again: a limp servo may have let its goal follow the shaft
            s.go(Trigger.SETTINGS_SEEN)
        case Phase.ENABLING:
            s.go(Trigger.TORQUE_SEEN)
        case Phase.RAMPING:
            steps = s.ticks_in(RAMP_S, least=1)
            for joint in s.wire:
                limit = round(SOFT_TORQUE + (joint.full_torque - SOFT_TORQUE) * state.ticks / steps)
                s.write(joint.servo_id, ax12a.TORQUE_LIMIT, limit)
            if state.ticks == steps:
                s.go(Trigger.RAMPED)
        case Phase.CONFIRMING if _at_full_torque(s):
            s.reply(state.request_id, True)
            s.go(Trigger.ENERGISED)
            state.request_id, state.anchor = None, ()
            s.take_over()


def soften(s: Tick) -> bool:
    """Write the settings and the soft torque limit that some servo does not show yet; whether there was one."""
    before = len(s.writes)
    for servo, reading in zip(s.arm.servos, s.inputs.sample.servos, strict=True):
        compliance = servo.joint.compliance
        for register, value in (
            (ax12a.CW_MARGIN, compliance.margin),
            (ax12a.CCW_MARGIN, compliance.margin),
            (ax12a.CW_SLOPE, compliance.slope),
            (ax12a.CCW_SLOPE, compliance.slope),
            (ax12a.PUNCH, compliance.punch),
            (ax12a.TORQUE_LIMIT, SOFT_TORQUE),
        ):
            if ax12a.register_value(register, reading.registers) != value:
                s.write(servo.servo_id, register, value)
    return len(s.writes) > before


def _limp_shaft(s: Tick, index: int) -> Shaft | None:
    """Of a shaft where torque comes on; None: it has some, and however soft it only sags."""
    state = s.state
    if s.status(index).torque_enabled or state.phase not in (Phase.SOFTENING, Phase.PREPARING):
        return None
    return s.limp_shaft(index, state.anchor[index])


def _at_full_torque(s: Tick) -> bool:
    """Whether every servo shows the torque limit it is to hold with; one that missed the ramp's end is told again."""
    pairs = zip(s.wire, s.servos, strict=True)
    behind = [joint for joint, servo in pairs if servo is not None and servo.torque_limit != joint.full_torque]
    for joint in behind:
        s.write(joint.servo_id, ax12a.TORQUE_LIMIT, joint.full_torque)
    return not behind


def _surprise(s: Tick, index: int, anchor: int, limp: Shaft | None) -> tuple[str, str] | None:
    """What is not as it should be with one servo while torque comes on, and its code; None: nothing."""
    servo, full = s.status(index), s.wire[index].full_torque
    within = s.wire[index].within_limits
    who = f"servo {s.wire[index].servo_id} ({s.wire[index].name})"
    softening, preparing = s.state.phase is Phase.SOFTENING, s.state.phase is Phase.PREPARING
    too_long = limp is not None and limp.still is None and s.state.ticks > s.ticks_in(STILL_S)
    if limp is not None and (limp.still is False or too_long):
        return "JUMP_REFUSED", f"{who} moved while torque came on; hold the arm still and try again"
    if limp is not None and abs(limp.tick - within(limp.tick)) > EDGE_TICKS + 1:
        return "LIMIT", f"{who} went beyond its limit while torque came on; move it inside by hand"
    if abs(servo.position - anchor) * ax12a.TICK_RAD > JUMP_RAD:
        return "JUMP_REFUSED", f"{who} moved while torque came on; support the arm and try again"
    # That of a limp servo may follow its shaft.
    if not softening and abs(servo.goal - within(anchor)) > (limp.noise_ticks if limp is not None else 0):
        return "NOT_TAKEN", f"{who} shows goal {servo.goal} where {within(anchor)} was written"
    if preparing and not ax12a.register_value(ax12a.MOVING_SPEED, s.inputs.sample.servos[index].registers):
        # Torque would come on at full speed. A limp servo may let its goal follow the shaft, and shows one it missed.
        return "NOT_TAKEN", f"{who} has no speed limit: its goal was lost; try again"
    if softening and s.state.ticks <= s.ticks_in(CONFIRM_S):
        return None
    if (softening or preparing) and servo.torque_limit != SOFT_TORQUE:
        return "NOT_TAKEN", f"{who} shows torque limit {servo.torque_limit} where {SOFT_TORQUE} was written"
    if not (softening or preparing) and not servo.torque_enabled:
        return "NOT_TAKEN", f"{who} did not take torque"
    if s.state.phase is Phase.CONFIRMING and servo.torque_limit != full and s.state.ticks > s.ticks_in(CONFIRM_S):
        return "NOT_TAKEN", f"{who} shows torque limit {servo.torque_limit}; it does not take {full}"
    return None


# ----------------------------------------------------------------------------------------- the way to rest


def go_to_rest(s: Tick) -> None:
    """The slow way to rest: come to a stop, go there, see that it is there, switch torque off."""
    state, joints = s.state, s.arm.joints
    if not s.all_powered():
        return s.give_up_rest("LOST_TORQUE", "a servo has no torque")
    if any(joint.age_s > SILENT_AGE_S for joint in s.joints):
        return s.give_up_rest("SERVO_SILENT", "a servo does not answer")
    if state.motion is not None:
        return None
    match state.phase:
        case Phase.FAULT_STOPPING if state.ticks < s.ticks_in(REST_AHEAD_S):
            return None
        case Phase.FAULT_STOPPING if not any(KINDS[code].to_rest for code in s.found):
            s.events.append(Event("info", "REST_CALLED_OFF", "what sent the arm to rest is over; it holds"))
            s.go(Trigger.GIVE_UP)
        case Phase.PARK_STARTING | Phase.FAULT_STOPPING:
            way = approach_trajectory(s.wanted_rad(), [joint.rest_rad for joint in joints], s, "to rest")
            if lowest_link_m(way, s.robot) < s.arm.floor_m:
                return s.give_up_rest("LIMIT", "the straight way to rest leads below the floor")
            state.motion = Motion(way, None)
            set_off(s)
            s.go(Trigger.SET_OFF)
        case Phase.PARK_GOING | Phase.FAULT_GOING:
            s.go(Trigger.ARRIVED)
        case _ if s.fresh and all(
            abs(now.position_rad - joints[servo.of].rest_rad) <= REST_TOLERANCE_RAD
            for now, servo in zip(s.each, s.wire, strict=True)
        ):
            s.events.append(Event("info", "PARKED", "the arm is at its rest pose; torque goes off"))
            s.go(Trigger.PARKED)
            s.let_go(state.request_id)
            state.request_id = None
        case _ if state.ticks > s.ticks_in(VERIFY_S):
            s.give_up_rest("NOT_AT_REST", "the arm is over 3 deg from its rest pose")
    return None
