"""Every fault code, and the card a person reads: what the arm does now, and the next command to type."""

from __future__ import annotations

from collections.abc import Sequence

from armctl.messages import Fault, JointState

NEXT: dict[str, str] = {
    "PORT_GONE": "plug the adapter back in; when `armctl status` shows the joints again, type `armctl clear`",
    "BUS_DEAD": "check the arm's power supply and the bus cable, then type `armctl clear`",
    "SERVO_SILENT": "check the servo's cable and LED, then type `armctl clear`",
    "WRONG_MODEL": "put an AX-12A with that ID on the bus (or correct the calibration file), then type `armctl clear`",
    "EEPROM_MISMATCH": "set the servo's EEPROM (or the calibration file) right, then type `armctl clear`",
    "DUPLICATE_ID": "give one of the two servos another ID, alone on the bus, then type `armctl clear`",
    "SLOW_ADAPTER": "set the USB adapter's latency timer to 1 ms, then type `armctl clear`",
    "LOST_TORQUE": "support the arm, type `armctl release`, then `armctl clear` and `armctl torque on`",
    "TRIPPED": "support the arm, remove the load, type `armctl release`, let the servo cool, then `armctl clear` "
    "and `armctl torque on`",
    "HOT": "let the servo cool; see its temperature in `armctl status`, then type `armctl clear`",
    "VOLTAGE": "check the power supply and its plug, then type `armctl clear`",
    "OVERLOAD": "take the load off the arm, then type `armctl clear`",
    "BUS_NOISE": "check the bus cable, its length and its ground, then type `armctl clear`",
    "OTHER_WRITER": "end the other program that writes to the bus, then type `armctl clear`",
    "BLOCKED": "free the joint, then type `armctl clear`",
    "NOT_LIMP": "end the other program that writes to the bus, then type `armctl release` and `armctl clear`",
}

WHAT: dict[str, str] = {
    "PORT_GONE": "the USB adapter was unplugged; plugged in again, it is found by itself",
    "BUS_DEAD": "no servo has answered for half a second",
    "SERVO_SILENT": "one servo has not answered for half a second, the others have",
    "WRONG_MODEL": "found when connecting: a servo is no AX-12A",
    "EEPROM_MISMATCH": "found when connecting: a servo's EEPROM forbids what the calibration needs",
    "DUPLICATE_ID": "found when connecting: two servos answer to one id",
    "SLOW_ADAPTER": "found when connecting: the adapter holds every answer back",
    "LOST_TORQUE": "a servo restarted, and hangs limp or has forgotten its settings",
    "TRIPPED": "a servo shut itself down for heat or overload",
    "HOT": "a servo is near the temperature at which it gives up",
    "VOLTAGE": "the supply at the servos is out of range",
    "OVERLOAD": "a joint has worked at more than 80 % of its strength for two seconds",
    "BUS_NOISE": "more than a tenth of the replies came damaged in ten seconds",
    "OTHER_WRITER": "a servo shows a goal or a setting that was not sent from here",
    "BLOCKED": "a joint has been 8 degrees from its goal for 0.3 s",
    "NOT_LIMP": "a servo of a limp arm has torque, and not from here",
}
"""What each code means, in words that follow `what happened:`."""

SETTLING = frozenset({"HOT", "VOLTAGE", "OVERLOAD"})
"""Faults that would soon end in a dropped arm: it goes to rest while it can."""

CODES: tuple[str, ...] = tuple(NEXT)
"""Every code a fault can latch with."""


def card(fault: Fault, joints: Sequence[JointState], moving: bool) -> tuple[str, str]:
    """What the arm is doing now, and the next command, in plain language.

    Args:
        joints: As they were last seen.
        moving: Whether a motion is under way: the end of the one that the fault stopped, or the way to rest.
    Raises:
        KeyError: a code that no part of armctl latches.
    """
    powered = [joint.torque_enabled for joint in joints]
    if fault.code == "PORT_GONE":
        arm = "out of reach; every servo keeps the last goal it was given, with the torque it had"
    elif moving and fault.code in SETTLING:
        arm = "on its way to the rest pose, where torque goes off"
    elif moving:
        arm = "coming to rest on its path"
    elif not any(powered):
        arm = "limp"
    elif all(powered):
        arm = "still; every servo holds the last goal it was given"
    else:
        arm = "partly limp; the servos that have torque hold the last goal they were given"
    return arm, NEXT[fault.code]
