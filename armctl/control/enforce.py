"""What was decided is sent until it is read back: torque off, and where the servos are to be.

Rules.
1. Torque goes off at every servo that has not been seen limp since, each tick, whatever else latches meanwhile. One
   that has been, and has torque again, has it from elsewhere, and whoever gave it may rely on it. Whoever asked is
   answered when all of them are seen limp, or after `LIMP_NS` with the name of one that is not. No goal is sent until
   it is over: that would energise a limp servo again.
2. A servo under torque that shows another goal than the one decided for it is told again, each tick, slowly. It alone
   is told while another servo is unheard, which a goal for all might wake.
3. What it shows was lost if it is one of the latest goals from here, and else another program's, which is overruled the
   same way. Only one that goes on writing for `YIELD_NS` is given way to, until `clear`.
4. A servo that was led off by more than `LED_OFF_TICKS` is not brought back: its goal becomes where it is. Two readings
   in a row have to say so, on a line that is well, with no reply damaged or missing beside them: one may be another
   servo's. A line that was too noisy is well again after `QUIET_S` without a damaged reply. Until then nothing is sent.
   One that was limp since it last showed its goal, and is woken to another one, is not brought back either.
5. While the port is gone anybody may move the arm. Then armctl has no say in it any more, until it takes it over again.
"""

import math
from dataclasses import replace

from armctl.control.machine import TRANSITIONS, Trigger
from armctl.control.tick import Tick
from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import Status

LIMP_NS = 500_000_000
YIELD_NS = 1_000_000_000
# After so long without a goal from elsewhere the next one is another story.
CALM_NS = 1_000_000_000
QUIET_S = 0.5
# How fast it is brought back from less: as slowly as to rest.
BACK_UNITS = ax12a.moving_speed_units(math.radians(20.0))
# A goal this near to the shaft asks for no way.
HERE_TICKS = 2


def switch_off(s: Tick) -> None:
    """Torque off, until every servo has been seen limp since it was decided; for an arm that is being let go."""
    going, now_ns = s.state.letting_go, s.inputs.now_ns
    assert going is not None
    stiff = [i for i in going.stiff if (servo := s.heard(i)) is None or servo.torque_enabled]
    if not stiff:
        for request_id in going.request_ids:
            s.reply(request_id, True)
        s.state.letting_go = None
        if Trigger.LIMP_SEEN in TRANSITIONS[s.state.phase]:
            s.go(Trigger.LIMP_SEEN)
        return
    overdue = now_ns - going.since_ns >= LIMP_NS
    for i in stiff:
        # One that stays silent is told again once it is heard: each attempt at it takes milliseconds.
        if s.heard(i) or not overdue:
            s.write(s.wire[i].servo_id, ax12a.TORQUE_ENABLE, 0)
    s.state.letting_go = replace(going, stiff=tuple(stiff))
    if overdue:
        _name_the_stiff(s, stiff[0])


def _name_the_stiff(s: Tick, index: int) -> None:
    """Tell whoever waits, and the card, which servo is not limp; it is told on."""
    going, servo = s.state.letting_go, s.wire[index]
    assert going is not None
    found = "torque stays on although it is switched off" if s.heard(index) else "not heard since; it may have torque"
    for request_id in going.request_ids:
        s.reply(request_id, False, "NOT_LIMP", f"servo {servo.servo_id} ({servo.name}): {found}; support the arm")
    s.state.letting_go = replace(going, request_ids=())
    s.latch_servo("NOT_LIMP", index, found)


# --------------------------------------------------------------------------------------------------- goals


def stay(s: Tick, index: int) -> None:
    """Decide that a joint's goal is where it is now: once, so that gravity does not walk it down.

    Each servo of it stays at its own place, so that two do not pull at each other. Nobody knows where one is that is
    not heard: it is not to be brought back.
    """
    here, of = s.here(index), s.wire[index].of
    unheard = [i for i, servo in enumerate(s.wire) if servo.of == of and s.heard(i) is None]
    s.state.limp = (*s.state.limp, *set(unheard).difference(s.state.limp))
    s.remember(tuple([s.here(i) if servo.of == of else s.state.goal[i] for i, servo in enumerate(s.wire)]))
    s.state.ramp = ()
    errors = zip(s.state.error_since_ns, s.wire, strict=False)
    s.state.error_since_ns = tuple([0 if servo.of == of else since_ns for since_ns, servo in errors])
    if (f := s.state.following) is not None:
        here_rad = s.wire[index].position_rad(here)
        s.state.following = replace(f, wanted_rad=(*f.wanted_rad[:of], here_rad, *f.wanted_rad[of + 1 :]))


def holds(s: Tick, index: int) -> Status | None:
    """What a servo says that is heard in this very sample and has torque; None of any other."""
    servo = s.heard(index)
    return servo if servo and servo.torque_enabled and servo.torque_limit else None


def hold_goals(s: Tick) -> None:
    """Send the goal that was decided, as long as a servo shows another one; for a tick in which no other is sent."""
    state = s.state
    if not s.inputs.sample.port_open:
        s.forget_goals()
    if not state.goal or state.yielded or not state.powered:
        return
    owed = [i for i in range(len(s.wire)) if (servo := holds(s, i)) is not None and servo.goal != state.goal[i]]
    foreign = [i for i in owed if not s.is_from_here(i)]
    if foreign and _goes_on(s):
        state.yielded = True
        s.latch_servo("OVERRULED", foreign[0], "another program goes on writing goals; the arm is left to it")
        return
    limp = [i for i in range(len(s.wire)) if (i in owed and i in state.limp) or (s.heard(i) and not holds(s, i))]
    state.limp = (*limp, *[i for i in state.limp if not s.heard(i)])
    led_off = [i for i in owed if s.is_led_off(i) or i in limp]
    well = s.fresh and ("BUS_NOISE" not in s.found or not any(state.noise[-s.ticks_in(QUIET_S) :]))
    unsure = set(led_off).difference(state.led_off if well else ())
    for i in set(led_off).difference(unsure):
        stay(s, i)
    state.led_off = tuple(led_off) if well else ()
    if sure := [i for i in owed if i not in unsure]:
        _send(s, sure, to_all=not unsure)


def _goes_on(s: Tick) -> bool:
    """Whether goals from elsewhere, one of which is seen now, have been for too long."""
    state, now_ns = s.state, s.inputs.now_ns
    if now_ns - state.foreign_ns > CALM_NS:
        state.foreign_since_ns = now_ns
    state.foreign_ns = now_ns
    return now_ns - state.foreign_since_ns >= YIELD_NS


def _send(s: Tick, owed: list[int], *, to_all: bool) -> None:
    """The goal that was decided: to all at once or, where that might wake or lead a servo, to those that lack it."""
    # Where no way is asked for the servo's own ramp is to come to the shaft at once.
    here = {i: abs(s.status(i).position - s.state.goal[i]) <= HERE_TICKS for i in owed}
    speeds = {i: s.wire[i].speed_limit_units if here[i] else BACK_UNITS for i in owed}
    if to_all and s.fresh and s.all_powered():
        s.send_goal(s.state.goal)
        if s.goal is not None:
            s.goal = replace(s.goal, speeds=tuple(speeds.get(i, v) for i, v in enumerate(s.goal.speeds)))
        return
    for i in owed:
        s.write(s.wire[i].servo_id, ax12a.MOVING_SPEED, speeds[i])
        s.write(s.wire[i].servo_id, ax12a.GOAL, s.state.goal[i])
