"""Arguments and options of the commands: a table of each stands beside its module, in `MODULE.toml`.

Rules.
1. A table is named after its command, with the group before it where there is one. A key is what is typed, and behind
   a blank the name that it has in the function, where that is another.
2. A value is what click takes: `help`, `default`, `required` and so on; and `names`, which the Tab key finishes
   (`completion.py`). Its `type` is one of `KINDS`, a list of choices, a range such as `1..20`, `0..` or `0.1..60.0`
   (`0.5..longest`: see `Seconds`), `list of` one of these, or some with blanks between.
3. The value `"shared"` stands for that of the same key in the table `shared`, of the same file or of `shared.toml`.
4. What stands in the table `kept` of `shared.toml` is kept in the `Output`, see `kept_option`.

It is TOML because Python reads it by itself: no command waits for the package that reads YAML.
"""

import math
import tomllib
from functools import cache, partial
from pathlib import Path
from typing import Any

import click

from armctl.cli.completion import complete


def parameters(module: str, command: str) -> list[click.Parameter]:
    """What a command of a module of this package takes, in the order in which its help lists it.

    Args:
        module: Its name without the package's.
        command: Its name, and before it that of its group.
    """
    own = tables(module)
    shared = tables("shared")["shared"] | own.get("shared", {})
    return [parameter(words, shared[words] if row == "shared" else row) for words, row in own.get(command, {}).items()]


def parameter(words: str, about: dict[str, Any], **more: Any) -> click.Parameter:
    """The argument or option of one row of a table."""
    if "type" in about:
        more["type"] = _kind(about["type"])
    if names := about.get("names"):
        more["shell_complete"] = complete(names)
    made = click.Option if words.startswith("-") else click.Argument
    return made(words.split(), **{key: about[key] for key in about if key != "names"} | more)


@cache
def tables(name: str) -> dict[str, dict[str, Any]]:
    """What stands in a file `NAME.toml` of this package."""
    return tomllib.loads(Path(__file__).with_name(f"{name}.toml").read_text(encoding="utf-8"))


def _kind(of: str | list[str]) -> Any:
    if isinstance(of, list):
        return click.Choice(of)
    if of.startswith("list of "):
        return Several(_kind(of.removeprefix("list of ")))
    if " " in of and of not in KINDS:
        return click.Tuple([_kind(one) for one in of.split()])
    low, to, high = of.partition("..")
    if not to:
        return KINDS[of]
    if high == "longest":
        return Seconds(float(low))
    if "." in low:
        return FiniteRange(float(low), float(high) if high else None)
    return click.IntRange(int(low), int(high) if high else None)


class Numbers(click.ParamType):  # type: ignore[type-arg]  # generic only in some versions
    """Numbers with commas or blanks between them.

    Args:
        count: How many; 0: any.
        what: Said where the text is something else.
        metres: Which of them are coordinates, at most 10 m from the base.
    """

    def __init__(self, count: int, what: str, metres: slice) -> None:
        self.name = "x,y,z" if count == 3 else "a,b,..."
        self._count, self._what, self._metres = count, what, metres

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        if isinstance(value, tuple):
            return value
        fail = partial(self.fail, param=param, ctx=ctx)
        try:
            numbers = tuple(float(part) for part in str(value).replace(",", " ").split())
        except ValueError:
            fail(f"{value!r} is not {self._what}")
        if not all(math.isfinite(number) and abs(number) <= 10.0 for number in numbers[self._metres]):
            fail(f"{value!r}: each coordinate must be finite and within 10 m (the unit is metres)")
        if not numbers or not all(map(math.isfinite, numbers)):
            fail(f"{value!r}: the numbers must be finite")
        if self._count and len(numbers) != self._count:
            fail(f"{value!r} is not {self._what}: it has {len(numbers)} numbers, not {self._count}")
        return numbers


class Several(click.ParamType):  # type: ignore[type-arg]  # generic only in some versions
    """Values of one kind with commas or blanks between them."""

    name = "a,b,..."

    def __init__(self, kind: Any) -> None:
        self._kind = kind

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[Any, ...]:
        parts = value if isinstance(value, tuple) else str(value).replace(",", " ").split()
        if not parts:
            self.fail(f"{value!r}: give at least one", param, ctx)
        return tuple(self._kind.convert(part, param, ctx) for part in parts)


class NewFile(click.Path):
    """A file that will be written when the work is done, in the place of an earlier page or picture, of nothing else.

    Where that cannot be is told before.
    """

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        path = Path(str(super().convert(value, param, ctx)))
        if not path.parent.is_dir():
            self.fail(f"{str(path.parent)!r} is no folder; make it first", param, ctx)
        if path.is_file():
            with path.open("rb") as file:
                begins = file.read(14).lower()
            if begins and not begins.startswith((b"<!doctype html", b"<svg")):
                self.fail(f"{str(path)!r} exists and is no page or picture; choose another name", param, ctx)
        return path


class FiniteRange(click.FloatRange):
    """A range; NaN is in none, though it is not below nor above one either."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = super().convert(value, param, ctx)
        return number if math.isfinite(number) else self.fail(f"{value!r} must be finite", param, ctx)


class Seconds(FiniteRange):
    """How long a motion takes: at most what `messages` says, which is imported when somebody gives a duration."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        from armctl.messages import LONGEST_S

        self.max = LONGEST_S
        return super().convert(value, param, ctx)


def length(text: str) -> tuple[str, float]:
    """`name=metres`."""
    name, _, metres = text.partition("=")
    try:
        return name.strip(), float(metres)
    except ValueError:
        raise click.BadParameter(f"{text!r} is not a length such as a2=0.5") from None


def via_counts(text: str) -> tuple[int | str, ...]:
    """`0,1,2,8,auto,stream`."""
    found: list[int | str] = []
    for part in text.split(","):
        word = part.strip()
        if word.isdecimal() and int(word) <= 20:
            found.append(int(word))
        elif word in ("auto", "stream"):
            found.append(word)
        else:
            raise click.BadParameter(f"{part!r} is not a number of via points from 0 to 20, auto or stream")
    return tuple(found)


POINT = Numbers(3, "three numbers x,y,z in metres, such as 0.18,-0.125,0.10", slice(3))
KINDS: dict[str, Any] = {
    "int": click.INT,
    "float": click.FLOAT,
    "str": click.STRING,
    "path": click.Path(path_type=Path),
    "file": click.Path(path_type=Path, dir_okay=False),
    "new file": NewFile(path_type=Path, dir_okay=False, writable=True),
    "folder": click.Path(path_type=Path, file_okay=False),
    "point": POINT,
    "pose": Numbers(6, "six numbers x,y,z,roll,pitch,yaw", slice(3)),
    "matrix": Numbers(16, "a 4x4 pose row by row", slice(3, 12, 4)),
    "numbers": Numbers(0, "a list of numbers such as 0.1,-0.2,0.3", slice(0)),
    "length": click.types.FuncParamType(length),
    "via": click.types.FuncParamType(via_counts),
}
