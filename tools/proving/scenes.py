"""Short episodes drawn for one situation each: what random stories meet too seldom to tell one program from another.

A scene is a story (`story.py`), played and judged as any other. It brings the arm to where the situation
begins; which servo, when, how long and on which arm comes from the seed. Scenes are numbered from `SCENES_FROM`.
"""

import re
import zlib
from collections.abc import Callable

import numpy as np

from armctl.config import ArmConfig
from proving.story import Drawing, Garble, HostGone, Kill, Late, Story, Tamper, Wish, Word

SCENES_FROM = 1_000_000
STANDS_S, LIFTED_S = 3.0, 10.5  # by then the arm is under torque: where it lay, or where a hand has lifted it
# Those that are not played on whichever arm.
NO_REST = "heat of an arm whose file forbids the way to rest"
WRONG_MOTIONS = "motions that are wrong in one thing"
# Each draws its lines and says how long it lasts [s].
SCENES: dict[str, Callable[[Drawing], float]] = {}


def _scene(name: str, begin: str = "") -> Callable[[Callable[[Drawing], float]], None]:
    """A scene for a function that draws what comes once the arm stands, or is lifted; `begin` says which of these."""

    def enter(draw: Callable[[Drawing], float]) -> None:
        def drawn(d: Drawing) -> float:
            if begin:
                d.wish(begin, 0.3)
            return draw(d)

        SCENES[name] = drawn

    return enter


# ---------------------------------------------------------------------------------------- torque that goes and comes


@_scene("a servo misses that the arm is let go", "stand")
def _(d: Drawing) -> float:
    at_s = d.strike("mute", STANDS_S, (0.2, 0.4))
    d.lines.append(Word(round(at_s + 0.01, 4), d.either("release", "teach"), d.number()))
    return STANDS_S + 3.0


@_scene("a servo is not heard for long while the arm is let go", "stand")
def _(d: Drawing) -> float:
    at_s = d.strike("mute", STANDS_S, (1.0, 2.0))
    d.lines.append(Word(round(at_s + 0.01, 4), "release", d.number()))
    return STANDS_S + 4.0


@_scene("what lets the arm go comes damaged", "stand")
def _(d: Drawing) -> float:
    d.garble(STANDS_S, 1.0, 0.6, d.either("dropped", "flipped"))
    d.say((d.either("release", "teach"), STANDS_S + 0.1))
    return STANDS_S + 4.0


@_scene("what gives torque comes damaged")
def _(d: Drawing) -> float:
    for at_s in (1.0, 5.0, 9.0):
        d.garble(at_s, 1.2, float(d.rng.uniform(0.1, 0.4)), d.either("dropped", "flipped"))
        d.say(("torque_on", at_s), ("release", at_s + 2.5))
    return 12.0


@_scene("the first words of a torque-on are lost")
def _(d: Drawing) -> float:
    for at_s in (1.0, 4.0, 7.0, 10.0):
        d.lines.append(Word(at_s - 0.05, "torque_on", d.number()))
        # Behind the readings of the tick that carries it out.
        d.lines.append(Garble(d.within(at_s + 0.003, 0.005), 0.08, 0.6, "dropped"))
        d.lines.append(Word(at_s + 2.0, "release", d.number()))
    return 12.0


@_scene("a limp arm gets torque from elsewhere")
def _(d: Drawing) -> float:
    d.strike("second_writer", 2.0, (1.5, 3.0), (5.0, 30.0))
    return 6.0


@_scene("a servo restarts while nobody is in charge", "stand")
def _(d: Drawing) -> float:
    d.lines.append(Kill(d.within(STANDS_S), int(d.rng.integers(3)), 1.5))
    d.strike("brown_out", STANDS_S + 0.5, (0.02, 0.1), (5.0, 9.0))
    return STANDS_S + 5.0


@_scene("torque is asked for while a servo is hot")
def _(d: Drawing) -> float:
    d.heat(1.0, (3.0, 5.0))
    d.say(("torque_on", 1.8), ("torque_on", 4.0))
    return 8.0


# --------------------------------------------------------------------------------------------------- the way to rest


@_scene("heat, and a clear while it lasts", "lift")
def _(d: Drawing) -> float:
    d.heat(LIFTED_S)
    d.say(("clear", LIFTED_S + 2.6), ("clear", LIFTED_S + 4.0), ("clear", LIFTED_S + 7.0))
    return LIFTED_S + 9.0


@_scene("heat, and a stop on the way to rest", "lift")
def _(d: Drawing) -> float:
    d.heat(LIFTED_S, (3.0, 5.0))
    d.say(("hold", LIFTED_S + float(d.either("3.0", "7.0"))))
    return LIFTED_S + 14.0


@_scene(NO_REST, "lift")
def _(d: Drawing) -> float:
    d.heat(LIFTED_S, (3.0, 5.0))
    return LIFTED_S + 8.0


@_scene("the supply is too low", "lift")
def _(d: Drawing) -> float:
    one = d.one if d.either("one", "all") == "one" else None
    d.strike("brown_out", LIFTED_S, (3.0, 5.0), (5.0, 8.3), one, probability=0.0)
    d.say(("clear", LIFTED_S + 1.5))
    return LIFTED_S + 7.0


@_scene("short dips of the supply", "lift")
def _(d: Drawing) -> float:
    for k in range(3):
        d.strike("brown_out", LIFTED_S + 2.0 * k, (0.05, 0.4), (5.0, 8.3), None, probability=0.0)
    return LIFTED_S + 9.0


@_scene("an obstacle, or another program, on the way to rest", "lift")
def _(d: Drawing) -> float:
    d.heat(LIFTED_S, (3.0, 5.0), d.other)
    kind = d.either("blocked_joint", "trip", "second_writer")
    d.strike(kind, LIFTED_S + 5.6, (2.0, 3.0), (30.0, 60.0) if kind == "second_writer" else None)
    return LIFTED_S + 12.0


@_scene("a servo falls silent on the way to rest", "lift")
def _(d: Drawing) -> float:
    d.heat(LIFTED_S, (3.0, 5.0), d.other)
    d.strike("mute", LIFTED_S + 5.6, (1.5, 2.0))
    return LIFTED_S + 12.0


@_scene("parked, and halted on the way", "lift")
def _(d: Drawing) -> float:
    d.wish("halt", LIFTED_S)
    d.wish("park", LIFTED_S + 1.0)
    return LIFTED_S + 22.0


@_scene("parked, and held just short of the rest pose", "stand")
def _(d: Drawing) -> float:
    d.wish("aside", STANDS_S)
    d.strike("blocked_joint", STANDS_S + 4.0, (7.0, 8.0), servo_id=None)
    d.say(("park", STANDS_S + 5.0))
    return STANDS_S + 10.0


@_scene("a silent servo, and a clear while it lasts", "stand")
def _(d: Drawing) -> float:
    d.strike("mute", STANDS_S, (3.0, 4.0))
    d.say(("clear", STANDS_S + 1.2), ("clear", STANDS_S + 2.2))
    return STANDS_S + 6.0


@_scene("two servos are silent at once", "stand")
def _(d: Drawing) -> float:
    d.say(("run", STANDS_S))
    for servo_id in (d.one, d.other):
        d.strike("mute", STANDS_S + 1.0, (1.5, 2.0), servo_id=servo_id)
    return STANDS_S + 4.0


@_scene("one fault behind another", "stand")
def _(d: Drawing) -> float:
    d.strike("second_writer", STANDS_S, (0.3, 0.6), (20.0, 60.0))
    if d.either("hot", "mute") == "hot":
        d.heat(STANDS_S + 0.8, (3.0, 5.0), d.other)
    else:
        d.strike("mute", STANDS_S + 0.8, (1.5, 2.0), servo_id=d.other)
    return STANDS_S + 5.0


@_scene("whatever is asked for while a fault is latched", "stand")
def _(d: Drawing) -> float:
    d.strike("mute", STANDS_S, (1.0, 1.2))
    if d.either("holds", "limp") == "limp":
        d.lines[0] = Wish(0.3, "release", d.number())
    d.say(*((what, STANDS_S + 1.5 + 0.2 * k) for k, what in enumerate(("run", "torque_on", "jog", "run", "torque_on"))))
    return STANDS_S + 4.0


@_scene("the adapter is pulled out of a moving arm", "stand")
def _(d: Drawing) -> float:
    d.say(("run", STANDS_S))
    d.strike("unplug", STANDS_S + 1.0, (0.3, 2.0), servo_id=None)
    d.say(("clear", STANDS_S + 5.0))
    return STANDS_S + 7.0


@_scene("a servo restarts, or trips", "stand")
def _(d: Drawing) -> float:
    d.strike(d.either("brown_out", "trip"), STANDS_S + 0.5, (0.02, 0.1), (5.0, 9.0))
    return STANDS_S + 4.0


@_scene("a servo trips, or restarts, while the arm moves", "stand")
def _(d: Drawing) -> float:
    d.say(("run", STANDS_S))
    d.strike(d.either("trip", "brown_out"), STANDS_S + 1.5, (0.05, 0.1), (5.0, 9.0))
    return STANDS_S + 5.0


# -------------------------------------------------------------------------------- goals that are not there, and pushing


@_scene("one goal from elsewhere", "lift")
def _(d: Drawing) -> float:
    for k, value in enumerate(((5.0, 60.0), (80.0, 250.0))):
        d.strike("second_writer", LIFTED_S + 6.0 * k, (0.02, 0.05), value)
    return LIFTED_S + 11.0


@_scene("a servo that is not heard is led far off", "lift")
def _(d: Drawing) -> float:
    at_s = d.strike("mute", LIFTED_S, (2.5, 3.5))
    d.strike("second_writer", at_s + 0.02, (0.02, 0.05), (150.0, 250.0))
    return LIFTED_S + 7.0


@_scene("goals from elsewhere go on", "lift")
def _(d: Drawing) -> float:
    d.strike("second_writer", LIFTED_S, (2.0, 4.0), (5.0, 60.0))
    return LIFTED_S + 7.0


@_scene("another program leads a joint that is held", "lift")
def _(d: Drawing) -> float:
    d.strike("blocked_joint", LIFTED_S, (7.0, 7.5))
    d.strike("second_writer", LIFTED_S + 0.2, (6.0, 6.5), (60.0, 120.0))
    return LIFTED_S + 8.0


@_scene("goals are lost while the arm moves", "stand")
def _(d: Drawing) -> float:
    d.say(("run", STANDS_S))
    d.garble(STANDS_S + 0.5, 6.0, float(d.rng.uniform(0.2, 0.4)), "dropped")
    return STANDS_S + 8.0


@_scene("a joint is blocked on its way", "lift")
def _(d: Drawing) -> float:
    d.say(("run", LIFTED_S))
    d.strike("blocked_joint", LIFTED_S + 0.5, (6.0, 7.0))
    return LIFTED_S + 8.0


@_scene("a joint is blocked, and its relief comes damaged", "stand")
def _(d: Drawing) -> float:
    d.wish("ram", STANDS_S)
    d.garble(STANDS_S + 0.4, 1.6, 0.5, "dropped")
    return STANDS_S + 7.0


@_scene("a joint is held, and the arm leans on it", "stand")
def _(d: Drawing) -> float:
    d.wish("press", STANDS_S)
    return STANDS_S + 7.0


@_scene("a joint is held, and the arm strains against it", "stand")
def _(d: Drawing) -> float:
    for k in range(3):
        d.wish("strain", STANDS_S + 14.0 * k)
    return STANDS_S + 42.0


@_scene("an arm that leans is stopped", "stand")
def _(d: Drawing) -> float:
    d.wish("ram", STANDS_S)
    d.say(("hold", STANDS_S + float(d.rng.uniform(0.65, 0.75))))
    return STANDS_S + 5.0


@_scene("a tick comes late while the arm moves", "stand")
def _(d: Drawing) -> float:
    for k in range(4):
        at_s = STANDS_S + 3.0 * k
        d.say(("run", at_s))
        d.lines.append(Late(d.within(at_s + 1.2), round(float(d.rng.uniform(280.0, 1500.0)), 1)))
    return STANDS_S + 12.0


@_scene("a moving arm is paused, and its host falls silent and dies", "stand")
def _(d: Drawing) -> float:
    d.say(("run", STANDS_S), ("host_silent", STANDS_S + 1.2))
    d.say(("run", STANDS_S + 3.0), ("pause", STANDS_S + 4.0), ("resume", STANDS_S + 5.0))
    d.lines.append(HostGone(d.within(STANDS_S + 5.8), 0.5))
    return STANDS_S + 9.0


@_scene("runs that no host has looked at", "stand")
def _(d: Drawing) -> float:
    for k in range(8):
        d.say((("nonsense", "elsewhere")[k % 2], STANDS_S + 0.3 * k))
    return STANDS_S + 4.0


@_scene("a program takes over an arm that moves", "stand")
def _(d: Drawing) -> float:
    d.say(("run", STANDS_S))
    d.lines.append(Kill(d.within(STANDS_S + 1.5), int(d.rng.integers(6)), 0.5))
    return STANDS_S + 4.0


@_scene("a servo was left in wheel mode")
def _(d: Drawing) -> float:
    d.lines.append(Tamper(d.one))
    d.say(("clear", 0.5), ("torque_on", 0.8))
    return 3.0


@_scene(WRONG_MOTIONS, "lift")
def _(d: Drawing) -> float:
    for k, what in enumerate(("sink", "sweep", "dash", "fold")):
        d.wish(what, LIFTED_S + 0.3 * k)
    return LIFTED_S + 2.0


@_scene("motions that nobody has looked at", "lift")
def _(d: Drawing) -> float:
    for at_s in (LIFTED_S, LIFTED_S + 0.1):
        d.wish("plan", at_s)
    return LIFTED_S + 20.0


@_scene("a jog", "lift")
def _(d: Drawing) -> float:
    d.wish("jog", LIFTED_S)
    d.wish("jog", LIFTED_S + 4.0)
    return LIFTED_S + 12.0


def scene_arm(text: str, number: int) -> str:
    """The file of an arm as a scene has it."""
    if named(number) == WRONG_MOTIONS:  # within reach of the arms that hang, too
        return re.sub(r"floor_m: -.*", "floor_m: -0.1", text)
    return text + ("\nrest_on_strain: false\n" if named(number) == NO_REST else "")


def named(number: int) -> str:
    """What a scene is about; empty: it is an episode."""
    return list(SCENES)[(number - SCENES_FROM) % len(SCENES)] if number >= SCENES_FROM else ""


def seeded(number: int) -> int:
    """What draws a scene, and its arm: the same for the same scene and turn, whichever others there are."""
    return zlib.crc32(named(number).encode()) + (number - SCENES_FROM) // len(SCENES)


def scene(seed: int, number: int, arm: ArmConfig) -> Story:
    """The story of a scene, the same for the same numbers."""
    drawing = Drawing(np.random.default_rng((seed, seeded(number), 21)), arm, (number - SCENES_FROM) // len(SCENES))
    duration_s = SCENES[named(number)](drawing)
    return Story(int(drawing.rng.integers(2**31)), duration_s, tuple(sorted(drawing.lines, key=lambda it: it.at_s)))
