"""A program: steps that the arm does one after another, as people write them.

Rules.
1. A step is a motion as it is asked for elsewhere (`move`, `play`, `path`), `grip` or `wait_s`, or it holds further
   steps: `repeat`, and `if_gripped` with what is done otherwise.
2. A step without a name is called by its number, one in another step by both: `4.2`, `5.then.1`. Within a repeat the
   turns stand behind it: `4.2@3`. So every time that something is done has a name of its own.
3. A program is known as a whole before anything moves: repeats are written out, and of every branch it is known where
   it leads. What is written out only ever leads onwards.
"""

import re
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from armctl.config import Frozen, Name, parse_yaml, validate
from armctl.errors import ConfigError, RequestRefused
from armctl.trajectory.playback import PlayRequest
from armctl.trajectory.target import MoveRequest
from armctl.trajectory.tool_path import PathRequest

# Of a program that is written out.
MOST_STEPS = 1000
# Where a step stands in a file, as its errors tell it.
_INNER = r"(?:repeat\.)?(?:if_gripped\.)?(steps|then|otherwise)\.(\d+)(?:\.|(?=:)|$)"

Steps = Annotated[tuple["Step", ...], Field(max_length=MOST_STEPS, strict=False)]


class Repeat(Frozen):
    """Steps that are done so many times."""

    times: int = Field(ge=1, le=MOST_STEPS)
    steps: Steps


class IfGripped(Frozen):
    """What is done if the gripper holds what it gripped, and otherwise."""

    then: Steps = ()
    otherwise: Steps = ()


class Step(Frozen):
    """One thing to do, and a name to call it by."""

    name: str | None = Field(None, pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,31}$")
    move: MoveRequest | None = None
    play: PlayRequest | None = None
    path: PathRequest | None = None
    grip: Literal["close", "open"] | None = None
    wait_s: float | None = Field(None, ge=0.1, le=3600.0)
    repeat: Repeat | None = None
    if_gripped: IfGripped | None = None

    @property
    def kinds(self) -> list[str]:
        """What it is: just one, in a step that is whole."""
        return [kind for kind in KINDS if getattr(self, kind) is not None]

    @property
    def words(self) -> str:
        """What it is, for people."""
        what = f"{self.wait_s:g} s" if self.wait_s else self.grip or ""
        return f"{self.kinds[0].removesuffix('_s').replace('_', ' ')} {what}".rstrip()

    @property
    def inner(self) -> tuple["Step", ...]:
        """The steps in it, of both branches."""
        branches = self.if_gripped
        return self.repeat.steps if self.repeat else branches.then + branches.otherwise if branches else ()

    @property
    def count(self) -> int:
        """How many steps it is, written out."""
        inside = sum(step.count for step in self.inner)
        return self.repeat.times * inside if self.repeat else inside + 1

    def _check(self) -> None:
        if len(self.kinds) != 1:
            raise ValueError(f"give just one of {', '.join(KINDS)} (found {', '.join(self.kinds) or 'none'})")


KINDS = tuple(name for name in Step.model_fields if name != "name")


class Program(Frozen):
    """What the arm is to do, step by step; by its name it is found again."""

    name: Name
    steps: Steps

    def _check(self) -> None:
        if not 1 <= (count := sum(step.count for step in self.steps)) <= MOST_STEPS:
            raise ValueError(f"steps: {count} with every repeat, 1 to {MOST_STEPS} can be done; repeat less often")
        names = [one.at for one in written_out(self) if one.at]
        if twice := {name for name in names if names.count(name) > 1}:
            raise ValueError(f"steps: name {min(twice)!r} stands twice; a step is found by its name")


class ProgramRequest(Program):
    """A program to run, from where it stands or from a step that is named."""

    from_step: str | None = Field(None, max_length=80)


class Instruction(NamedTuple):
    """One step of a program that is written out."""

    # What it is called, with its turns; empty: it only leads on.
    at: str
    step: Step | None
    # Which one follows if nothing is gripped, or if it only leads on.
    other: int = 0

    @property
    def name(self) -> str:
        return self.at.partition("@")[0]


def written_out(program: Program) -> tuple[Instruction, ...]:
    """Every step in the order in which it is done; each is followed by the next, or by its `other`."""
    out: list[Instruction] = []

    def add(steps: tuple[Step, ...], above: str, turns: tuple[int, ...]) -> None:
        for number, step in enumerate(steps, 1):
            name = step.name or f"{above}{number}"
            at = name + "@" * bool(turns) + ".".join(map(str, turns))
            if step.repeat:
                for turn in range(1, step.repeat.times + 1):
                    add(step.repeat.steps, f"{name}.", (*turns, turn))
                continue
            here = len(out)
            out.append(Instruction(at, step))
            if step.if_gripped:
                add(step.if_gripped.then, f"{name}.then.", turns)
                end = len(out)
                out.append(Instruction("", None))
                add(step.if_gripped.otherwise, f"{name}.otherwise.", turns)
                out[here], out[end] = Instruction(at, step, end + 1), Instruction("", None, len(out))

    add(program.steps, "", ())
    return tuple(out)


def place_of(instructions: tuple[Instruction, ...], name: str) -> int:
    """Index of the first instruction of that name: a step's, with its turns or without, or that of one it holds.

    The first one of all is always 1.

    Raises:
        RequestRefused: code NO_STEP, there is none; lists them.
    """
    for index, one in enumerate(instructions):
        if one.at and (name in (one.at, one.name, None if index else "1") or one.name.startswith(f"{name}.")):
            return index
    known = dict.fromkeys(one.name for one in instructions if one.at)
    raise RequestRefused("NO_STEP", f"there is no step {name[:80]!r}; steps: {', '.join(known)}")


def program_from_text(text: str, file: str, name: str) -> Program:
    """The program in a YAML text, known by that name if it gives none.

    Raises:
        ConfigError: it is none; names the step by its number, the key, the value and its bound.
    """
    try:
        return validate(Program, {"name": name} | parse_yaml(text, file), file)
    except ConfigError as error:
        remedy = "`armctl help programs` has every key"
        raise ConfigError(file, _numbered(error.key).rstrip(": "), _numbered(error.problem), remedy) from None


def _numbered(text: str) -> str:
    """Steps by the numbers that people know them by: `steps.2.repeat.steps.0.grip` is `step 3.1: grip`."""

    def number(found: re.Match[str]) -> str:
        inside = (f"{kind}.{int(at) + 1}".replace("steps.", "") for kind, at in re.findall(_INNER, found[2]))
        return f"{found[1]}step {'.'.join(inside)}: "

    return re.sub(rf"(?m)^( *)((?:{_INNER})+)(?:: )?", number, text)
