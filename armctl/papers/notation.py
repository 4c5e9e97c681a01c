"""The papers' notation: C23 is cos(theta_2 + theta_3), two things side by side are multiplied.

As in the papers' text a subscript stands behind its letter, with or without `_`; `a_{i-1}` is the link before joint i.
"""

import re
from functools import cache
from typing import Any
from zlib import crc32

from armctl.recording.export import extra

# Any: sympy tells no types.
sympy: Any = extra("the papers' equations", "sympy", "papers")
product_to_sum: Any = extra("the papers' equations", "sympy.simplify.fu", "papers").TR8

_FUNCTIONS = {name: getattr(sympy, name) for name in ("sin", "cos", "tan", "sqrt", "atan2")}
_FUNCTIONS |= {"arctan": sympy.atan, "abs": sympy.Abs}
_TOKEN, _MARKS = re.compile(r"\d+\.?\d*|[^\W\d]\w*|\S"), "+-*/(),"
_LETTERS = {"θ": "theta_", "α": "alpha_", "__": "_", "{i-1}": "before", "°": "", "180 -": "pi -", "^": "**"}
# A sine or cosine by its letter: `C23`, `s1`, `ctheta_i`.
_TRIG = re.compile(r"([CScs])(\d+|(?:theta|alpha)_\w+)")


def symbol(name: str) -> Any:
    """`theta_1` and `theta1` are the same."""
    return sympy.Symbol(re.sub(r"_(?=\d)", "", name))


@cache
def read(text: str) -> Any:
    """A printed formula as an expression, angles in radians; what is no formula is no number either (nan)."""
    for letter, word in _LETTERS.items():
        text = text.replace(letter, word)
    words, names = [""], dict[str, Any]()
    for token in _TOKEN.findall(text):
        factor = token[0].isalnum() or token == "("
        if factor and (words[-1][-1:].isalnum() or words[-1] == ")") and words[-1] not in _FUNCTIONS:
            words.append("*")
        if token[0] not in _MARKS and not token[0].isalnum():
            return sympy.nan
        if token[0].isalpha() and token not in _FUNCTIONS:
            # A name of its own, so that no word of Python and no constant of sympy is meant by it.
            names[f"v{len(names)}"] = _named(token)
            token = f"v{len(names) - 1}"
        words.append(token)
    try:
        return sympy.sympify("".join(words), locals={**_FUNCTIONS, **names}, rational=True)
    except (sympy.SympifyError, SyntaxError, TypeError):
        return sympy.nan


def _named(token: str) -> Any:
    trig = _TRIG.fullmatch(token)
    if token == "pi" or trig is None:
        return sympy.pi if token == "pi" else symbol(token)
    angles = [f"theta{digit}" for digit in trig[2]] if trig[2].isdigit() else [trig[2]]
    return (sympy.cos if trig[1] in "Cc" else sympy.sin)(sum(map(symbol, angles)))


def show(expression: Any, *, small: bool) -> str:
    """An expression in the papers' notation; `small`: c23 and not C23."""

    def letters(function: Any) -> Any:
        joints = re.findall(r"theta(\d)", str(function.args[0]))
        letter = "cs"[isinstance(function, sympy.sin)]
        return sympy.Symbol((letter if small else letter.upper()) + "".join(sorted(joints)))

    joint_angles = re.compile(r"theta\d( \+ theta\d)*")
    plain = expression.replace(
        lambda part: isinstance(part, sympy.sin | sympy.cos) and joint_angles.fullmatch(str(part.args[0])) is not None,
        letters,
    )
    text = re.sub(r"\*\*", "^", str(plain)).replace("*", " ").replace("_before", "_{i-1}")
    return re.sub(r"\b(theta)(\d)", r"\1_\2", text)


def some_value(name: str) -> float:
    """A number for a name that has none of its own, always the same."""
    return 0.3 + crc32(name.encode()) % 1000 / 1000.0


@cache
def same(first: Any, second: Any) -> bool:
    """Whether two expressions are one function.

    Products of sines and cosines become sums; if that is not enough, sines and cosines become rational functions of the
    tangents of half the angles: of those, and of everything else in them, the difference is a fraction, and it is zero
    where its numerator is.
    """
    gap = sympy.expand(first - second)
    # Where they differ at one place no more is needed.
    if abs(gap.evalf(subs={name: some_value(str(name)) for name in gap.free_symbols})) > 1e-9:
        return False
    if sympy.expand(product_to_sum(gap)) == 0:
        return True
    gap = sympy.expand_trig(gap)
    half = {part.args[0]: sympy.Symbol(f"half {part.args[0]}") for part in gap.atoms(sympy.sin, sympy.cos)}
    sines = {sympy.sin(angle): 2 * u / (1 + u**2) for angle, u in half.items()}
    cosines = {sympy.cos(angle): (1 - u**2) / (1 + u**2) for angle, u in half.items()}
    return bool(sympy.expand(sympy.numer(sympy.together(gap.xreplace(sines | cosines)))) == 0)
