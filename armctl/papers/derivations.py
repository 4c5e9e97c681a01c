"""What every numbered equation should say, derived by symbols from the Denavit-Hartenberg table of its paper.

Each function gives, by the equations' numbers, cells like those of a transcription; `derived.yaml` has those that take
algebra by hand. A cell is an expression, or words where print has no formula to compute; None: not derived.
`measurements.py` has the same cells on numbers, by other means: a slip made here is found there.
"""

from collections.abc import Sequence
from functools import reduce
from typing import Any

from armctl.papers.notation import product_to_sum, read, symbol, sympy
from armctl.papers.transcription import written

Cells = Sequence[Sequence[Any]]
# Of the tool's pose, its rows one after the other.
NAMES = ("n_x", "o_x", "a_x", "p_x", "n_y", "o_y", "a_y", "p_y", "n_z", "o_z", "a_z", "p_z")
NAMES_OF_002 = [name for n, row in enumerate("xyz", 1) for name in (f"r_{n}1", f"r_{n}2", f"r_{n}3", f"p_{row}")]
THETA = [symbol(f"theta{joint}") for joint in range(1, 7)]
LAST = sympy.Matrix([[0, 0, 0, 1]])
QUARTER = sympy.pi / 2


def about_z(theta: Any, d: Any = 0) -> Any:
    """Turn about z by theta and go along it by d."""
    c, s = sympy.cos(theta), sympy.sin(theta)
    return sympy.Matrix([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, d], [0, 0, 0, 1]])


def about_x(alpha: Any, a: Any = 0) -> Any:
    """Turn about x by alpha and go along it by a."""
    c, s = sympy.cos(alpha), sympy.sin(alpha)
    return sympy.Matrix([[1, 0, 0, a], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]])


# Any link of a modified table.
LINK_AFTER = about_x(symbol("alpha_before"), symbol("a_before")) * about_z(symbol("theta_i"), symbol("d_i"))


def _sums(expression: Any) -> Any:
    """Products of sines and cosines as those of sums of their angles."""
    return sympy.expand(product_to_sum(expression))


def _product(*links: Any) -> Any:
    """Links with parallel axes, multiplied from the left."""
    return reduce(lambda T, link: (T * link).applyfunc(_sums), links)


def _back(T: Any) -> Any:
    """The inverse of such a product."""
    R = T[:3, :3].T
    return R.row_join((-R * T[:3, 3]).applyfunc(_sums)).col_join(LAST)


def _pose(names: Sequence[str] = NAMES) -> Any:
    return sympy.Matrix(3, 4, [symbol(name) for name in names]).col_join(LAST)


def derived(paper: str) -> dict[str, Cells]:
    """Every derived equation of a paper: those below, and `derived.yaml`."""
    by_hand: dict[str, Cells] = {}
    for number, lines in written("derived.yaml")[paper].items():
        rows = [map(str.strip, line.split("|")) for line in lines.splitlines()]
        by_hand[number] = [[cell[1:-1] if cell.startswith('"') else read(cell) for cell in row] for row in rows]
    return DERIVED[paper]() | by_hand


def _xiang() -> dict[str, Cells]:
    """Eqs. (2) to (17) are of an arm without d1, with a4 and a turned fifth joint; Fig. 9 is of another one."""
    a2, a3, a4 = (symbol(name) for name in ("a2", "a3", "a4"))
    rows = ((0, QUARTER), (a2, 0), (a3, 0), (a4, -QUARTER), (0, QUARTER), (0, 0))
    A = [about_z(theta) * about_x(alpha, a) for theta, (a, alpha) in zip(THETA, rows, strict=True)]
    upper, hand, T = _product(*A[1:4]), A[4] * A[5], _pose()
    turned = _back(A[0]) * T
    stretched, all_links = _back(upper) * turned, A[0] * upper
    # Print has it as the 0 that it is.
    stretched[1, 3] = stretched[1, 3].subs({T[0, 3]: all_links[0, 3], T[1, 3]: all_links[1, 3]})
    return {
        **{f"({number})": link.tolist() for number, link in enumerate(A, 2)},
        "(9)": (A[0] * upper * hand).tolist(),
        "(10)": T.tolist(),
        "(11), left": turned.tolist(),
        "(11), right": (upper * hand).tolist(),
        "(13)": [[turned[0, 3], upper[0, 3]]],
        "(14)": [[T[2, 3], upper[1, 3]]],
        "(17), left": stretched.tolist(),
        "(17), right": hand.tolist(),
    }


def _puma() -> dict[str, Cells]:
    theta, alpha, a, d = (symbol(f"{name}_i") for name in ("theta", "alpha", "a", "d"))
    return {
        "(1)": (about_z(theta, d) * about_x(alpha, a)).tolist(),
        "(3)": _pose().tolist(),
        "(5)": [*[[None, None, None, symbol(f"p_n{axis}") - symbol(f"p_{axis}")] for axis in "xyz"], [0, 0, 0, 0]],
    }


def _line() -> dict[str, Cells]:
    a2, a3, a4, a5, a6, d1 = (symbol(name) for name in ("a2", "a3", "a4", "a5", "a6", "d1"))
    rows = ((0, QUARTER, d1), (a2, 0, 0), (a3, 0, 0), (a4, 0, 0), (a5 + a6, 0, 0))
    A = [about_z(theta, d) * about_x(alpha, a) for theta, (a, alpha, d) in zip(THETA, rows, strict=False)]
    T = A[0] * _product(*A[1:])
    numbered = enumerate(((name.replace("p", "P"), T[k // 4, k % 4]) for k, name in enumerate(NAMES_OF_002)), 7)
    return {
        **{f"({number})": link.tolist() for number, link in enumerate(A, 1)},
        "(6)": _pose(NAMES_OF_002).tolist(),
        **{f"({number})": [[symbol(name), value]] for number, (name, value) in numbered},
    }


def _lanzhou() -> dict[str, Cells]:
    a2, a3, a4, a5, d1, d2 = (symbol(name) for name in ("a2", "a3", "a4", "a5", "d1", "d2"))
    rows = ((0, 0, d1), (a2, -QUARTER, d2), (a3, 0, 0), (a4, 0, 0))
    A = [about_x(alpha, a) * about_z(theta, d) for theta, (a, alpha, d) in zip(THETA, rows, strict=False)]
    T = A[0] * _product(*A[1:], about_x(0, a5))
    return {"(1)": LINK_AFTER.tolist(), "(2), names": _pose().tolist(), "(2)": T.tolist()}


def _transfer() -> dict[str, Cells]:
    a1, a2, d4, d6 = (symbol(name) for name in ("a1", "a2", "d4", "d6"))
    rows = ((0, 0, 0), (a1, -QUARTER, 0), (a2, 0, 0), (0, QUARTER, d4), (0, -QUARTER, 0), (0, QUARTER, d6))
    A = [about_x(alpha, a) * about_z(theta, d) for theta, (a, alpha, d) in zip(THETA, rows, strict=True)]
    # In the initial position, millimetres.
    at = {a1: 100, a2: 450, d4: 160, d6: 100} | dict(zip(THETA, (QUARTER, -QUARTER, 0, 0, 0, 0), strict=True))
    return {
        "(1)": LINK_AFTER.tolist(),
        "(3)": _pose().tolist(),
        "after (3), 0T6": reduce(lambda T, link: T * link.subs(at), A, sympy.eye(4)).tolist(),
        "(4), first matrix": _back(A[0]).tolist(),
        "(4), second matrix": _pose().tolist(),
    }


# By paper.
DERIVED = {"000": _xiang, "001": _puma, "002": _line, "003": _lanzhou, "004": _transfer}
