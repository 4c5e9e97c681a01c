"""The quantities of the papers' equations at random configurations, by `kinematics.chain` and not by symbols.

Below them what the cells of tables should be, where that can be computed: from the other tables, or by a robot.

Each function gives the values of all names at one configuration, and the equations' cells as numbers. A cell may also
be a function of the printed words, which tells how far off they are. None: not measured.
"""

import math
import operator
from collections.abc import Callable, Sequence
from functools import reduce
from itertools import pairwise
from typing import Any

import numpy as np

from armctl.kinematics import robots
from armctl.kinematics.chain import DHRow, SerialChain, forward_kinematics, jacobian, link_frames, tool_position
from armctl.kinematics.robots.papers import FIG_5_DEG, INITIAL_DEG, LANZHOU_RANGES_DEG, QZ_DEG
from armctl.kinematics.transform import FloatArray
from armctl.papers.derivations import NAMES, NAMES_OF_002
from armctl.papers.paper_000 import HEIGHT_CM, RADIUS_CM, population_formula
from armctl.papers.paper_004 import tool_rate
from armctl.papers.transcription import Transcription
from armctl.trajectory.straightness import distance_to_line, mean_error

# Values by name, and cells by equation.
Measured = tuple[dict[str, float], dict[str, Any]]
QUARTER = math.pi / 2.0


def _named(letter: str, values: FloatArray | Sequence[float]) -> dict[str, float]:
    return {f"{letter}{number}": float(value) for number, value in enumerate(values, 1)}


def _pose(T: FloatArray, names: Sequence[str] = NAMES) -> dict[str, float]:
    return dict(zip(names, T[:3].ravel().tolist(), strict=True))


def _any_pose(rng: np.random.Generator) -> FloatArray:
    return forward_kinematics(robots.get("puma560").chain, rng.uniform(-math.pi, math.pi, 6))


def _drawn(rng: np.random.Generator, *names: str) -> dict[str, float]:
    return {name: float(rng.uniform(0.1, 0.5)) for name in names}


def _links(frames: FloatArray) -> list[FloatArray]:
    """Each frame in the one before it."""
    return [np.linalg.inv(before) @ after for before, after in pairwise(frames)]


def _rows(frames: FloatArray, scale: float = 1.0, *, modified: bool = False) -> list[tuple[int, float, float, float]]:
    """Of each link between frames its number, a, alpha [deg] and d, from where its axes lie; lengths times `scale`."""
    rows = []
    for n, T in enumerate(_links(frames), 1):
        x, y, z, p = T[:3, :4].T
        a, alpha, d = (p[0], math.atan2(-z[1], z[2]), p @ z) if modified else (p @ x, math.atan2(y[2], z[2]), p[2])
        rows.append((n, round(float(a) * scale, 9), round(math.degrees(alpha), 9), round(float(d) * scale, 9)))
    return rows


def _says(words: str, number: float, scale: float = 1.0) -> Callable[[Any], float]:
    """How far a printed number is from what it should be; words are the right ones or infinitely far."""

    def off(printed: Any) -> float:
        if isinstance(printed, str):
            return 0.0 if printed == words else math.inf
        return abs(float(printed) - number) * scale

    return off


def _meant(means: dict[str, Any], true: Any) -> Callable[[str], float]:
    """How far what words mean, or the product of the words one by one, is from what is true; infinitely: nothing."""

    def off(words: str) -> float:
        factors = [means.get(word) for word in ([words] if words in means else words.split())]
        known = all(factor is not None for factor in factors)
        return float(np.abs(reduce(operator.matmul, factors) - true).max()) if known else math.inf

    return off


def _each(number: int, values: Sequence[Any] | FloatArray) -> dict[str, Any]:
    """Equations by their numbers, from the first on."""
    return {f"({k})": value for k, value in enumerate(values, number)}


def _one_link(rng: np.random.Generator, convention: Any, of_link: str) -> tuple[dict[str, float], FloatArray]:
    """Any row of a table, and its link; `of_link`: whose a and alpha, "i" or "before" the joint."""
    a, alpha, d, theta = rng.uniform(0.1, 1.4, 4).tolist()
    link = forward_kinematics(SerialChain((DHRow(a, alpha, d),), convention), np.array([theta]))
    return {f"a_{of_link}": a, f"alpha_{of_link}": alpha, "d_i": d, "theta_i": theta}, link


def _xiang(rng: np.random.Generator) -> Measured:
    q, lengths = rng.uniform(-math.pi, math.pi, 6), _drawn(rng, "a2", "a3", "a4")
    a2, a3, a4 = lengths.values()
    rows = (DHRow(alpha=QUARTER), DHRow(a2), DHRow(a3), DHRow(a4, -QUARTER), DHRow(alpha=QUARTER), DHRow())
    frames = link_frames(SerialChain(rows), q)
    T, links = frames[-1], _links(frames)
    turned, stretched = (np.linalg.inv(frames[joint]) @ T for joint in (1, 4))
    if rng.random() < 0.5:
        # Of the arm's own poses entries are 0 whatever their sign; the left sides hold for any other as well.
        T = _any_pose(rng)
        turned, left = np.linalg.inv(frames[1]) @ T, (np.linalg.inv(frames[4]) @ T).tolist()
        left[1][3] = None  # print has it as the 0 that it is
        cells = _each(2, links) | {"(10)": T, "(11), left": turned, "(17), left": left}
        return lengths | _pose(T) | _named("theta", q), cells
    # Eq. (18): the arm of Fig. 9, its angles from the vertical, its hand's joint turned by a quarter.
    fig_9 = _drawn(rng, "d1", "a2", "a3", "d5")
    robot = robots.get("xiang-6dof", fig_9)
    tool = tool_position(robot.chain, np.array([q[0], QUARTER - q[1], -q[2], -q[3] - QUARTER, 0.0]))
    target = _drawn(rng, "x0", "y0", "z0")
    missed = float(((tool - list(target.values())) ** 2).sum())
    signs = {"plus_minus": math.copysign(1.0, turned[0, 3]), "plus_minus3": math.copysign(1.0, math.sin(q[2]))}
    values = lengths | target | _pose(T) | _named("theta", q) | _named("l", list(fig_9.values())) | signs
    values |= {"x": float(tool[0]), "y": float(tool[1]), **_named("q", q)}
    rows_of_9 = _rows(link_frames(robots.get("xiang-6dof").chain, q[:5]), 100.0)
    table = [[n, q[n - 1], d, a, round(math.radians(alpha), 6), 0.0] for n, a, alpha, d in rows_of_9]
    ranges = [[low, angle, high] for (low, high), angle in zip(robot.limits_rad[1:4], q[1:4], strict=True)]
    sides = {"(12)": q[0], "(13)": turned[0, 3], "(14)": T[2, 3]}
    sides |= {"(15)": math.cos(q[2]), "(16)": math.cos(q[2]), "after (16)": math.sin(q[2])}
    product = [_meant(dict.fromkeys(("RT1 1T2 2T3 ... n-1Tn", "A1 A2 A3 ... An"), reduce(np.matmul, links)), T)] * 2
    matrices = {"(8)": [product], "(9)": T, "(10)": T, "(11), left": turned, "(11), right": turned}
    matrices |= {"(17), left": stretched, "(17), right": stretched, "(18)": [[missed], *ranges], "Fig. 9": table}
    return values, _each(2, links) | {number: [[value] * 2] for number, value in sides.items()} | matrices


def _puma(rng: np.random.Generator) -> Measured:
    values, link = _one_link(rng, "standard", "i")
    frames = link_frames(robots.get("puma560").chain, rng.uniform(-math.pi, math.pi, 6))
    T, other = frames[-1], frames[-2]
    values |= {f"p_n{axis}": float(away) for axis, away in zip("xyz", other[:3, 3], strict=True)}
    blocks = {"R_n3x3": reduce(np.matmul, _links(frames))[:3, :3], "O_n3x1": T[:3, 3:], "0_1x3": np.zeros((1, 3))}
    return values | _pose(T), {
        "(1)": link,
        "(3)": T,
        "(3), blocks": [[_meant(blocks, T[:3, :3]), _meant(blocks, T[:3, 3:])], [_meant(blocks, T[3:, :3]), 1.0]],
        "(5)": other - T,
        "Table 1": [[n, alpha, _says("", a, 1e3), None, _says("", d, 1e3)] for n, a, alpha, d in _rows(frames)],
    }


def _line(rng: np.random.Generator) -> Measured:
    q, lengths = rng.uniform(-math.pi, math.pi, 5), _drawn(rng, "a2", "a3", "a4", "d1", "a5", "a6")
    of_robot = {name: length for name, length in lengths.items() if name not in ("a5", "a6")}
    frames = link_frames(robots.get("ax12-line", of_robot | {"a56": lengths["a5"] + lengths["a6"]}).chain, q)
    T, links = frames[-1], _links(frames)
    table = [[n, alpha, a, d, q[n - 1]] for n, a, alpha, d in _rows(frames)]
    entries = _each(7, [[[value] * 2] for value in T[:3].ravel()])
    values = {name.replace("_", "", name[0] == "r"): value for name, value in _pose(T, NAMES_OF_002).items()}
    values |= {**lengths, **dict(zip(("P_x", "P_y", "P_z"), T[:3, 3].tolist(), strict=True)), **_named("theta", q)}
    # Any points and any line, the fitness of any population.
    A, B, *points = rng.uniform(-0.3, 0.3, (7, 3))
    P, fitness = np.array(points), rng.uniform(0.1, 1.0, 5)
    away, shares = np.linalg.norm(np.cross(P - A, P - B), axis=1) / np.linalg.norm(B - A), fitness / fitness.sum()
    cumulated = np.cumsum(fitness) / fitness.sum()
    means = {
        "norm((P_i - A) x (P_i - B)) / norm(B - A)": away,
        "sum(i = 1..n, f(x_i) / n)": sum(away / len(away)),
        "fitness value / total fitness population": shares,
        "P[1] + ... + P[i]": [sum(shares[: i + 1]) for i in range(len(shares))],
    } | {"P[i]": shares, "C[i]": cumulated}
    true = {"(19)": distance_to_line(P, A, B), "(20)": mean_error(P, A, B), "(21)": np.diff(cumulated, prepend=0.0)}
    words = {number: [[_meant(means, value)] * 2] for number, value in (true | {"(22)": cumulated}).items()}
    return values, _each(1, links) | entries | words | {"(6)": T, "Table I": table}


def _lanzhou(rng: np.random.Generator) -> Measured:
    if rng.random() < 0.5:
        # Of the arm's own poses a_z is 0 whatever its sign.
        return _pose(T := _any_pose(rng)), {"(2), names": T}
    q = np.radians(rng.uniform(*np.array(LANZHOU_RANGES_DEG).T))
    # Print knows the sum of these within half a turn.
    q[1:] *= min(1.0, 3.0 / abs(q[1:].sum()))
    lengths = _drawn(rng, "d1", "a2", "d2", "a3", "a4", "a5")
    frames = link_frames(robots.get("lanzhou-4dof", lengths).chain, q)
    T = frames[-1]
    # In the plane of links 3 and 4, seen from joint 2: x outwards, y the way positive angles turn.
    out, down = (np.linalg.inv(frames[1]) @ (frames[4] - frames[2])[:, 3])[[0, 2]] * (1.0, -1.0)
    along = math.hypot(out, down)
    alpha = math.acos((out * math.cos(q[1]) + down * math.sin(q[1])) / along)
    beta, total = math.atan2(down, out), float(q[1:].sum())
    values, link = _one_link(rng, "modified", "before")
    turned, weights = rng.uniform(-1.0, 1.0, 4), rng.uniform(0.1, 1.0, 4)
    weighted = float((np.abs(turned) * weights).sum())
    least, span, rand = (float(value) for value in rng.uniform(0.1, 1.0, 3))
    # In (12) theta_i is another angle than in (1); there it stands alone.
    values |= {**lengths, **_pose(T), **_named("theta", [*q, 0.3]), **_named("Δtheta", turned), **_named("l", weights)}
    values |= {"x": out, "y": down, "alpha": alpha, "beta": beta, "Δ": weighted}
    values |= {"theta_min": least, "theta_max": least + span, "Rand": rand}
    shown = _rows(link_frames(robots.get("lanzhou-4dof").chain, q), 1e3, modified=True)
    ranges = (*(f"{low:g}~{high:g}" for low, high in LANZHOU_RANGES_DEG), "0")
    table = [[n, values[f"theta{n}"], alpha, a, d, _says(ranges[n - 1], 0.0)] for n, a, alpha, d in shown]
    about: Any = {"Rot_z(theta_i)": {}, "Trans_z(d_i)": {"d": values["d_i"]}}
    about |= {"Trans_x(a_{i-1})": {"a": values["a_before"]}, "Rot_x(alpha_{i-1})": {"alpha": values["alpha_before"]}}
    turns = {name: np.array([values["theta_i"] if name == "Rot_z(theta_i)" else 0.0]) for name in about}
    motions = {name: forward_kinematics(SerialChain((DHRow(**row),)), turns[name]) for name, row in about.items()}
    bent_up = q[2] < 0.0
    matrices = {"(1), left": [[_meant(motions, link)]], "(1)": link, "(2), names": T, "(2)": T, "Table 1": table}
    sides = {"(4)": along**2, "(5)": math.cos(q[2]), "(7)": math.cos(alpha)}
    sides |= {"(8)": total, "(9)": q[3], "(10)": weighted}
    others = {"(3)": [[math.tan(q[0])] * 2, [q[0]] * 2], "(6)": [[math.tan(beta)] * 2, [beta] * 2]}
    others |= {"(11)": [[span * rand]], "(12)": [[values["theta_i"], least + span * rand]]}
    others["after (7)"] = [[q[1], q[1] if bent_up else None, None if bent_up else q[1]]]
    return values, matrices | {number: [[value] * 2] for number, value in sides.items()} | others


def _transfer(rng: np.random.Generator) -> Measured:
    q, lengths = rng.uniform(-math.pi, math.pi, 6), _drawn(rng, "a1", "a2", "d4", "d6")
    chain = robots.get("transfer-6dof", lengths).chain
    frames = link_frames(chain, q)
    T, J = frames[-1], jacobian(chain, q)
    values, link = _one_link(rng, "modified", "before")
    initial = forward_kinematics(robots.get("transfer-6dof").chain, np.radians(INITIAL_DEG))
    axes = frames[1:, :3, 2]
    levers = np.cross(axes, T[:3, 3] - frames[1:, :3, 3])
    columns, rate = np.concatenate([levers, axes], axis=1), rng.uniform(-1.0, 1.0, 6)  # (eq. 8)
    said = {"Z_i x iPn0": levers, "Z_i x (0R iPn)": levers, "Z_i": axes}
    speeds = {"V": rate @ columns, "dX/dt": tool_rate(chain, q, rate), "J(q) dq/dt": J @ rate}
    ways = {"0T6": T, "0T1 (1T2) (2T3) (3T4) (4T5) (5T6)": reduce(np.matmul, _links(frames))}
    angles = [_says(f"theta_{n}={deg:g}{'°' * bool(deg)}", 0.0) for n, deg in enumerate(INITIAL_DEG, 1)]
    shown = _rows(link_frames(robots.get("transfer-6dof").chain, q), 1e3, modified=True)
    table = [
        [n, _says(f"a_{n - 1}={a:g}", a), alpha, _says(f"d_{n}={d:g}", d), angle]
        for (n, a, alpha, d), angle in zip(shown, angles, strict=True)
    ]
    return values | lengths | _pose(T) | _named("theta", q), {
        "Table 1": table,
        "(1)": link,
        "(3)": T,
        "(4), second matrix": T,
        "after (3), 0T6": initial * np.array([[1.0, 1.0, 1.0, 1000.0]] * 3 + [[1.0] * 4]),
        "(4), first matrix": np.linalg.inv(frames[1]),
        "(2)": [[_meant(ways, forward_kinematics(chain, q))] * 2],
        "(7)": [[_meant(speeds, J @ rate)] * 3],
        "(8)": [[_meant(said, part)] * 2 for part in (J[:3].T, J[3:].T)],
        "(9)": [[_meant({f"TJ{k}(q)": column for k, column in enumerate(columns, 1)}, wanted) for wanted in J.T]],
    }


# By paper.
MEASURED = {"000": _xiang, "001": _puma, "002": _line, "003": _lanzhou, "004": _transfer}


# ----------------------------------------------------------------------------------------------------- cells of tables

# By table: what is true, and how uncertain that is because it is computed from rounded cells; shapes as the table's.
TrueCells = dict[str, tuple[FloatArray, FloatArray | float]]


def _grid_cells(printed: Transcription) -> TrueCells:
    """Each of the six tables from one of the others and the targets; Fig. 7 by its formula."""
    true: TrueCells = {"joint_1_population": (population_formula(), 0.0)}
    for axis, target in (("xy0", RADIUS_CM), ("z0", np.full_like(RADIUS_CM, HEIGHT_CM))):
        measured, away, share = (printed.tables[name] for name in (f"{axis}_test", f"delta_{axis}", f"p_{axis}"))
        # By whichever has more digits: "10" says little, 1.63E-07 of it much.
        ways = (measured.numbers - target, measured.rounding), (share.numbers * target, share.rounding * target)
        finer = ways[0][1] <= ways[1][1]
        true[f"{axis}_test"] = target + away.numbers, away.rounding
        true[f"delta_{axis}"] = np.where(finer, ways[0][0], ways[1][0]), np.where(finer, ways[0][1], ways[1][1])
        true[f"p_{axis}"] = away.numbers / target, away.rounding / target
    return true


def _place_mm(robot: str, q_deg: Sequence[float]) -> FloatArray:
    """Where its tool is, shape (1, 3), without the dust of rounding."""
    return np.round(tool_position(robots.get(robot).chain, np.radians([q_deg])) * 1e3, 9) + 0.0


# By paper; tables that are not named hold measurements, what was chosen, or motions that print does not give. By its
# text the arm of 004 is in its initial position at t = 0 of Fig. 3.
TRUE_CELLS: dict[str, Callable[[Transcription], TrueCells]] = {
    "000": _grid_cells,
    "003": lambda _: {
        "ikine": (np.radians([QZ_DEG]), 0.0),
        "fig_5": (_place_mm("lanzhou-4dof", FIG_5_DEG)[:, [0, 2]], 0.0),
    },
    "004": lambda _: {"fig_3": (_place_mm("transfer-6dof", INITIAL_DEG), 0.0)},
}
