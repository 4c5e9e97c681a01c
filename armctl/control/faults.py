"""Every fault that can latch, one table each in `faults.toml`, the worst first; and the card a person reads.

What a fault does follows from its table alone: how a motion ends, whether the arm goes to rest while it lasts, and what
has to be over before `clear` is allowed. Several can be latched at once; each is shown. When it latches stands in
`detect.py` (what a sample shows), `sequences.py` (what a sequence waits for in vain) and `dynamixel/` (what is found
when connecting).
"""

import tomllib
from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from importlib import resources
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
    # The two servos of a joint read apart.
    PAIR = "pair"
    # A servo does not show the goal that was decided for it yet.
    GOAL = "goal"
    # Some servos have full torque, others have not: neither limp nor holding.
    TORQUE = "torque"
    # Nothing: to be cleared as soon as the arm is still.
    NONE = "none"


class FaultKind(NamedTuple):
    """One table of `faults.toml`, and its name."""

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
    follows: Sequence[str] = ()


_TABLE = tomllib.loads(resources.files(__package__).joinpath("faults.toml").read_text("utf-8"))
FAULTS = tuple(FaultKind(code, **row | {"until": Cause(row["until"])}) for code, row in _TABLE.items())
KINDS = {kind.code: kind for kind in FAULTS}
CODES = tuple(KINDS)
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
