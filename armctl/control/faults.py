"""Every fault code, and the card a person reads: what the arm does now, and the next command to type."""

from __future__ import annotations

from armctl.messages import Fault, Mode

_NEXT: dict[str, str] = {
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

SETTLING = frozenset({"HOT", "VOLTAGE", "OVERLOAD"})
"""Faults that would soon end in a dropped arm: it goes to rest while it can."""

CODES: tuple[str, ...] = tuple(_NEXT)
"""Every code a fault can latch with."""


def card(fault: Fault, mode: Mode) -> tuple[str, str]:
    """What the arm is doing now, and the next command, in plain language.

    Raises:
        KeyError: a code that no part of armctl latches.
    """
    if fault.code == "PORT_GONE":
        arm = "out of reach; every servo keeps the last goal it was given, with the torque it had"
    elif fault.code in SETTLING:
        arm = "on its way to the rest pose, where torque goes off; or still, where it could not go there"
    elif fault.code in ("LOST_TORQUE", "TRIPPED"):
        arm = "the servo named here is limp; the others keep the torque they have at their last goal"
    else:
        arm = "still; every servo keeps its last goal with the torque it has"
    return arm, _NEXT[fault.code]
