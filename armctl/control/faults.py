"""Every fault that can latch: one row each, the worst first, and the card a person reads.

What a fault does follows from its row alone: how a motion ends, whether the arm goes to rest while it lasts, and what
has to be over before `clear` is allowed. Several can be latched at once; each is shown. When it latches stands in
`detect.py` (what a sample shows), `sequences.py` (what a sequence waits for in vain) and `dynamixel/` (what is found
when connecting).
"""

from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from typing import Literal, NamedTuple

from armctl.messages import Fault, JointState


class Cause(StrEnum):
    """What may keep a fault from being cleared, in the order in which it is looked at (see requests.py)."""

    # The port is closed, or its servos are not identified.
    PORT = "port"
    # Connecting found something that forbids motion.
    PROBLEM = "problem"
    # A servo has not been heard just now.
    SILENCE = "silence"
    HEAT = "heat"
    SUPPLY = "supply"
    # A servo does not show the goal that was decided for it yet.
    GOAL = "goal"
    # Some servos have full torque, others have not: neither limp nor holding.
    TORQUE = "torque"
    # Nothing: to be cleared as soon as the arm is still.
    NONE = "none"


class FaultKind(NamedTuple):
    """One row of the table."""

    code: str
    # Whether servos are named, each for itself, or the first that shows what all of them have in common.
    of: Literal["servo", "supply", "bus"]
    # What becomes of a motion under way: no goal follows, or it comes to rest on its path.
    motion: Literal["ends", "slows"]
    # Whether it would soon end in a dropped arm: the arm goes to rest while it lasts, and goes limp there.
    to_rest: bool
    # What has to be over before `clear` is allowed; so have, for every fault, the causes of all others.
    until: Cause
    # In words that follow `what happened:`.
    what: str
    # The next command to type.
    remedy: str
    # Faults that explain this one where they are latched as well: those of the bus, or of the same servo.
    follows: tuple[str, ...] = ()


# Where a motion ends at once, going on would be wrong or in vain: the port is gone, or a servo does not follow.
# fmt: off
FAULTS: tuple[FaultKind, ...] = (
    FaultKind("PORT_GONE", "bus", "ends", False, Cause.PORT,
        "the USB adapter was unplugged; plugged in again, it is found by itself",
        "plug the adapter back in; when `armctl status` shows the joints again, type `armctl clear`"),
    FaultKind("BUS_DEAD", "bus", "slows", False, Cause.SILENCE,
        "no servo has answered for half a second",
        "check the arm's power supply and the bus cable, then type `armctl clear`",
        follows=("PORT_GONE",)),
    FaultKind("SERVO_SILENT", "servo", "slows", False, Cause.SILENCE,
        "one servo has not answered for half a second, the others have",
        "check the servo's cable and LED, then type `armctl clear`",
        follows=("PORT_GONE", "BUS_DEAD")),
    FaultKind("WRONG_MODEL", "servo", "slows", False, Cause.PROBLEM,
        "found when connecting: a servo is no AX-12A",
        "put an AX-12A with that ID on the bus (or correct the calibration file), then type `armctl clear`"),
    FaultKind("EEPROM_MISMATCH", "servo", "slows", False, Cause.PROBLEM,
        "found when connecting: a servo's EEPROM forbids what the calibration needs",
        "set the servo's EEPROM (or the calibration file) right, then type `armctl clear`"),
    FaultKind("DUPLICATE_ID", "servo", "slows", False, Cause.PROBLEM,
        "found when connecting: two servos answer to one id",
        "give one of the two servos another ID, alone on the bus, then type `armctl clear`"),
    FaultKind("SLOW_ADAPTER", "bus", "slows", False, Cause.PROBLEM,
        "found when connecting: the adapter holds every answer back",
        "set the USB adapter's latency timer to 1 ms, then type `armctl clear`"),
    FaultKind("LOST_TORQUE", "servo", "ends", False, Cause.TORQUE,
        "a servo restarted, and hangs limp or has forgotten its settings",
        "support the arm, type `armctl release`, then `armctl clear` and `armctl torque on`",
        follows=("PORT_GONE", "BUS_DEAD", "VOLTAGE", "SERVO_SILENT")),
    FaultKind("TRIPPED", "servo", "ends", False, Cause.TORQUE,
        "a servo shut itself down for heat or overload",
        "support the arm, remove the load, type `armctl release`, let the servo cool, then `armctl clear` "
        "and `armctl torque on`",
        follows=("HOT", "OVERLOAD", "BLOCKED", "VOLTAGE")),
    FaultKind("OVERRULED", "servo", "ends", False, Cause.NONE,
        "another program has gone on writing goals for a second, and has the arm until `armctl clear`",
        "end the other program that writes to the bus, then type `armctl clear`",
        follows=("OTHER_WRITER",)),
    FaultKind("HOT", "servo", "slows", True, Cause.HEAT,
        "a servo is near the temperature at which it gives up",
        "let the servo cool; see its temperature in `armctl status`, then type `armctl clear`"),
    FaultKind("VOLTAGE", "supply", "slows", True, Cause.SUPPLY,
        "the supply at the servos is out of range",
        "check the power supply and its plug, then type `armctl clear`"),
    FaultKind("OVERLOAD", "servo", "slows", True, Cause.NONE,
        "a joint has worked at more than 80 % of its strength for two seconds",
        "take the load off the arm, then type `armctl clear`",
        follows=("BLOCKED",)),
    FaultKind("BUS_NOISE", "bus", "slows", False, Cause.NONE,
        "more than a tenth of the replies came damaged in ten seconds",
        "check the bus cable, its length and its ground, then type `armctl clear`"),
    FaultKind("OTHER_WRITER", "servo", "ends", False, Cause.GOAL,
        "a servo shows a goal or a setting that was not sent from here; the arm is taken back at once, slowly",
        "end the other program that writes to the bus, then type `armctl clear`"),
    FaultKind("CONTACT", "servo", "ends", False, Cause.NONE,
        "a joint that stands has pushed for two seconds, beyond what gravity explains; its goal is now where it is",
        "take away what the arm pushes against, then type `armctl clear`"),
    FaultKind("BLOCKED", "servo", "ends", False, Cause.NONE,
        "a joint has been 8 degrees from its goal for 0.3 s",
        "free the joint, then type `armctl clear`",
        follows=("VOLTAGE",)),
    FaultKind("NOT_LIMP", "servo", "slows", False, Cause.TORQUE,
        "a servo of a limp arm has torque, and not from here",
        "end the other program that writes to the bus, then type `armctl release` and `armctl clear`"),
)
# fmt: on

KINDS = {kind.code: kind for kind in FAULTS}
CODES = tuple(KINDS)
NEXT = {kind.code: kind.remedy for kind in FAULTS}
WHAT = {kind.code: kind.what for kind in FAULTS}
SETTLING = frozenset(kind.code for kind in FAULTS if kind.to_rest)


def with_fault(faults: Sequence[Fault], new: Fault) -> tuple[Fault, ...]:
    """The faults latched, one more among them: the worst first, each with the one that it follows from."""
    both = sorted((*faults, new), key=lambda fault: CODES.index(fault.code))
    return tuple(replace(fault, follows=_cause(fault, both)) for fault in both)


def _cause(fault: Fault, faults: Sequence[Fault]) -> str:
    for other in faults:
        of_all = KINDS[other.code].of != "servo"
        if other.code in KINDS[fault.code].follows and (of_all or other.servo_id == fault.servo_id):
            return other.code
    return ""


def card(fault: Fault, joints: Sequence[JointState], moving: bool, rest_in_s: float | None = None) -> tuple[str, str]:
    """What the arm is doing now, and the next command, in plain language.

    Args:
        joints: As they were last seen.
        moving: Whether a motion is under way: the end of the one that a fault stopped, or the way to rest.
        rest_in_s: Time until the arm sets off for its rest pose, 0 once it has; None: it does not.
    Raises:
        KeyError: a code that no part of armctl latches.
    """
    kind = KINDS[fault.code]
    powered = [joint.torque_enabled for joint in joints]
    if kind.until is Cause.PORT:
        arm = "out of reach; every servo keeps the last goal it was given, with the torque it had"
    elif rest_in_s is not None:
        way = f"about to go to its rest pose (in {rest_in_s:.0f} s)" if rest_in_s else "on its way to the rest pose"
        arm = f"{way}, where torque goes off; `armctl stop` keeps it where it is"
    elif moving:
        arm = "coming to rest on its path"
    elif not any(powered):
        arm = "limp"
    elif fault.code == "OVERRULED":
        arm = "led by the other program: armctl sends no goal"
    elif all(powered):
        arm = "still; every servo holds the last goal it was given"
    else:
        arm = "partly limp; the servos that have torque hold the last goal they were given"
    return arm, kind.remedy
