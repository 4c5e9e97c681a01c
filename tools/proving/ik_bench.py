"""Kinematics of the PUMA 560 beside other libraries in the same run: time a pose, and the share solved.

Every solver gets the same random reachable poses; a pose counts as solved at 1e-6 m and rad. What a library does one
pose at a time is called so; where it takes a batch it gets one. Rounds alternate and the best one counts, being the
one least disturbed by other work. Compare with an exact setting: at its default tolerance roboticstoolbox stops before
1e-6. pinocchio has no inverse kinematics of its own: the loop of its manual (damped least squares on the logarithm of
the pose error) is run from random starts. Poses and starts come from separate random streams: from one seed alone the
first starts would be the very configurations the poses were made of, and a search would have nothing to find.
"""

import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import numpy as np

from armctl.kinematics import robots
from armctl.kinematics.chain import SerialChain, forward_kinematics
from armctl.kinematics.inverse import pose_errors, refine_poses
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.spherical_wrist import SphericalWrist
from armctl.kinematics.transform import FloatArray
from proving import genetic_ik_bench, solve_bench
from proving.figures import check, row

POSES = 1000
SLOW_POSES = 100
# For solvers that take milliseconds, and tenths of a second, a pose.
SLOWEST_POSES = 10
FK_POSES = 100_000
ROUNDS = 5
SOLVED_M = SOLVED_RAD = 1e-6
# A pose is tried from at most so many starts.
MOST_STARTS = 40
# A solver that solves at least this share counts as exact.
EXACT_SHARE = 0.999
BATCH_BOUND_US = 2.0
ALONE_BOUND_US = 25.0
BATCH_RATIO = 50.0
ALONE_RATIO = 3.0
FK_BOUND_PER_S = 2e6
TOOLBOX = "roboticstoolbox"


@dataclass
class _Solver:
    """`solve` gives one configuration, shape (m, 6), for each of the poses."""

    who: str
    solve: Callable[[FloatArray], FloatArray]
    poses: int = POSES
    rounds: int = ROUNDS
    us: float = field(default=math.inf, init=False)
    share: float = field(default=0.0, init=False)


def bench(seed: int, poses: int = POSES, fk_poses: int = FK_POSES, rounds: int = ROUNDS) -> dict[str, Any]:
    """Rows and checks; `ratio` is to armctl's batch."""
    rows: list[dict[str, Any]] = []
    checks: list[dict[str, Any]] = []
    for part in (
        inverse(seed, poses, rounds),
        forward(seed, fk_poses, rounds),
        genetic_ik_bench.bench(seed),
        solve_bench.bench(seed),
    ):
        rows += part["rows"]
        checks += part["checks"]
    return {"rows": rows, "checks": checks, "seed": seed}


def configurations(seed: int, poses: int) -> FloatArray:
    """What the poses are made of [rad], shape (poses, 6)."""
    return np.random.default_rng((seed, 0)).uniform(-np.pi, np.pi, (poses, 6))


def starts(seed: int) -> np.random.Generator:
    """Where the solvers draw their starts from: a stream of its own."""
    return np.random.default_rng((seed, 1))


def inverse(seed: int, poses: int, rounds: int) -> dict[str, Any]:
    """Inverse kinematics: time a pose and share solved."""
    robot = robots.get("puma560")
    T = forward_kinematics(robot.chain, configurations(seed, poses))
    solvers = _solvers(robot, seed)
    for turn in range(rounds):
        for solver in solvers:
            if turn < solver.rounds:
                _time(solver, robot.chain, T[: min(poses, solver.poses)])
    ours = next(solver for solver in solvers if solver.who == "armctl, closed form, batch")
    alone = next(solver for solver in solvers if solver.who == "armctl, closed form, one by one from arrays")
    rows = [row("IK of a PUMA 560 pose", one.who, one.us, "us", one.us / ours.us) for one in solvers]
    rows += [row("poses solved to 1e-6 m and rad", one.who, one.share, "", one.share) for one in solvers]
    exact = [one.us for one in solvers if one.who.startswith(TOOLBOX) and one.share >= EXACT_SHARE]
    fastest = min(exact, default=math.inf)
    numeric = next(solver for solver in solvers if solver.who.startswith("armctl, damped"))
    checks = [
        check("closed form, batch [us a pose]", ours.us, BATCH_BOUND_US),
        check("closed form, one by one [us a pose]", alone.us, ALONE_BOUND_US),
        check("fastest exact roboticstoolbox / batch", fastest / ours.us, BATCH_RATIO, least=True),
        check(
            "fastest exact roboticstoolbox / one by one",
            fastest / alone.us,
            ALONE_RATIO,
            least=True,
        ),
        check("share solved by the closed form", ours.share, EXACT_SHARE, least=True),
        check("share solved by damped least squares", numeric.share, EXACT_SHARE, least=True),
    ]
    return {"rows": rows, "checks": checks}


def forward(seed: int, poses: int, rounds: int) -> dict[str, Any]:
    """Forward kinematics: poses a second."""
    chain = robots.get("puma560").chain
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (poses, 6))
    ets, pin = toolbox(chain).ets(), Pinocchio(chain)
    work: dict[str, Callable[[], Any]] = {
        "armctl, batch": lambda: forward_kinematics(chain, q),
        f"{TOOLBOX} (C++), batch": lambda: ets.eval(q),
        "pinocchio (C++), one by one": lambda: [pin.forward(one) for one in q],
    }
    taken_s = dict.fromkeys(work, math.inf)
    for _ in range(rounds):
        for who, run in work.items():
            begin = time.perf_counter()
            run()
            taken_s[who] = min(taken_s[who], time.perf_counter() - begin)
    rates = {who: poses / taken for who, taken in taken_s.items()}
    ours = rates["armctl, batch"]
    rows = [row("FK of a PUMA 560", who, rate / 1e6, "M poses/s", ours / rate) for who, rate in rates.items()]
    return {"rows": rows, "checks": [check("FK, batch [poses/s]", ours, FK_BOUND_PER_S, least=True)]}


def _time(solver: _Solver, chain: SerialChain, T: FloatArray) -> None:
    begin = time.perf_counter()
    q = solver.solve(T)
    solver.us = min(solver.us, (time.perf_counter() - begin) / len(T) * 1e6)
    position_m, turn_rad = pose_errors(chain, q, T)
    solver.share = float(((position_m <= SOLVED_M) & (turn_rad <= SOLVED_RAD)).mean())


def _solvers(robot: Robot, seed: int) -> list[_Solver]:
    chain, form = robot.chain, robot.closed_form
    assert isinstance(form, SphericalWrist)  # which has a form for one pose in plain floats
    own, ets, pin = toolbox(chain), toolbox(chain).ets(), Pinocchio(chain)
    analytic = _analytic(chain)
    limits = robot.limits_rad

    def one_of(T: list[list[float]]) -> Sequence[float]:
        found = form.pose(T)  # none where it is singular
        return found[0] if found else form.poses(np.array([T]))[0, 0]

    def alone(T: FloatArray) -> FloatArray:
        return np.array([one_of(one) for one in T.tolist()])

    def alone_from_array(T: FloatArray) -> FloatArray:
        return np.array([one_of(one.tolist()) for one in T])

    def all_branches(T: FloatArray) -> FloatArray:
        return form.poses(T)[:, 0]

    def numeric(T: FloatArray) -> FloatArray:
        return _from_starts(chain, T, limits, starts(seed))

    def lm(T: FloatArray, **options: Any) -> FloatArray:
        return np.array([ets.ik_LM(one, tol=1e-14, **options).q for one in T])

    def lm_python(T: FloatArray) -> FloatArray:
        rng = starts(seed)
        return np.array([own.ikine_LM(one, tol=1e-14, seed=int(rng.integers(2**31))).q for one in T])

    return [
        _Solver("armctl, closed form, batch", all_branches),
        _Solver("armctl, closed form, one by one from lists", alone),
        _Solver("armctl, closed form, one by one from arrays", alone_from_array),
        _Solver("armctl, damped least squares, batch", numeric),
        _Solver(f"{TOOLBOX}, ik_LM (C++), tol 1e-14", lm),
        _Solver(f"{TOOLBOX}, ik_LM (C++), Wampler 1e-6", lambda T: lm(T, method="wampler", k=1e-6)),
        _Solver(f"{TOOLBOX}, ik_LM (C++), default tol", lambda T: np.array([ets.ik_LM(one).q for one in T])),
        _Solver(f"{TOOLBOX}, analytic, one solution", analytic),
        _Solver(f"{TOOLBOX}, ikine_LM (Python), tol 1e-14", lm_python, SLOW_POSES, 1),
        _Solver("pinocchio, CLIK with restarts", lambda T: pin.inverse(T, starts(seed)), SLOW_POSES, 2),
        _Solver("ikpy", _ikpy(chain), SLOWEST_POSES, 1),
    ]


def _from_starts(chain: SerialChain, T: FloatArray, limits: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Damped least squares for every pose from random starts, until it is reached."""
    q, left = np.empty((len(T), chain.n)), np.arange(len(T))
    for _ in range(MOST_STARTS):
        drawn = rng.uniform(limits[:, 0], limits[:, 1], (len(left), chain.n))
        q[left] = refine_poses(chain, T[left], drawn, limits)
        left = left[np.max(pose_errors(chain, q[left], T[left]), axis=0) > SOLVED_M / 1e3]
        if not len(left):
            break
    return q


def toolbox(chain: SerialChain) -> Any:
    """A chain as a robot of roboticstoolbox."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import roboticstoolbox
        import spatialmath
    link = roboticstoolbox.RevoluteDH if chain.convention == "standard" else roboticstoolbox.RevoluteMDH
    rows = [link(d=row.d, a=row.a, alpha=row.alpha, offset=row.offset) for row in chain.rows]
    return roboticstoolbox.DHRobot(rows, tool=spatialmath.SE3(chain.tool_m, 0.0, 0.0))


def _analytic(chain: SerialChain) -> Callable[[FloatArray], FloatArray]:
    """Its closed form knows the PUMA 560 only, with the shoulder offset in row 3; the tool stays where it was."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import roboticstoolbox
        import spatialmath
    puma = roboticstoolbox.models.DH.Puma560()
    puma.base = puma.tool = spatialmath.SE3()
    offset = chain.rows[1].d
    for link, dh, d in zip(puma.links, chain.rows, (0.0, 0.0, offset, chain.rows[3].d, 0.0, 0.0), strict=True):
        link.d, link.a, link.alpha = d, dh.a, dh.alpha

    def solve(T: FloatArray) -> FloatArray:
        return np.array([puma.ikine_a(spatialmath.SE3(one, check=False)).q for one in T])

    return solve


class Pinocchio:
    """A chain as a pinocchio model: one revolute joint a row, one frame for the tool."""

    def __init__(self, chain: SerialChain) -> None:
        import pinocchio

        self.pin, self.model = pinocchio, pinocchio.Model()

        def turn(axis: str, angle: float, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Any:
            return pinocchio.SE3(pinocchio.utils.rotate(axis, angle), np.array(shift))

        modified = chain.convention == "modified"
        place, parent = pinocchio.SE3.Identity(), 0
        for i, dh in enumerate(chain.rows):
            twist, along = turn("x", dh.alpha, (dh.a, 0.0, 0.0)), turn("z", 0.0, (0.0, 0.0, dh.d))
            if modified:
                place = place * twist
            turned = place * turn("z", dh.offset)
            parent = self.model.addJoint(parent, pinocchio.JointModelRZ(), turned, f"joint {i + 1}")
            place = along if modified else along * twist
        place = place * turn("z", 0.0, (chain.tool_m, 0.0, 0.0))
        self.tool = self.model.addFrame(pinocchio.Frame("tool", parent, 0, place, pinocchio.FrameType.OP_FRAME))
        self.data = self.model.createData()

    def forward(self, q: FloatArray) -> Any:
        self.pin.forwardKinematics(self.model, self.data, q)
        return self.pin.updateFramePlacement(self.model, self.data, self.tool)

    def inverse(self, T: FloatArray, rng: np.random.Generator) -> FloatArray:
        return np.array([self._one(self.pin.SE3(pose), rng) for pose in T])

    def _one(self, wanted: Any, rng: np.random.Generator) -> FloatArray:
        pin, model, data, tool = self.pin, self.model, self.data, self.tool
        q = np.zeros(6)
        for _ in range(40):
            q = rng.uniform(-np.pi, np.pi, 6)
            for _ in range(100):
                error = self.forward(q).actInv(wanted)
                log = pin.log6(error).vector
                if np.abs(log).max() < 1e-8:
                    return q
                J = -pin.Jlog6(error.inverse()) @ pin.computeFrameJacobian(model, data, q, tool, pin.LOCAL)
                q = q - J.T @ np.linalg.solve(J @ J.T + 1e-6 * np.eye(6), log)
        return q


def _ikpy(chain: SerialChain) -> Callable[[FloatArray], FloatArray]:
    """Its release of these days still says np.float, which numpy 2 has dropped: lent to it while it works."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from ikpy.chain import Chain
        from ikpy.link import OriginLink, URDFLink
    links, place, turn = [OriginLink()], np.zeros(3), np.zeros(3)
    for i, dh in enumerate(chain.rows):
        links.append(URDFLink(f"joint {i + 1}", place, turn, rotation=np.array([0.0, 0.0, 1.0])))
        place, turn = np.array([dh.a, 0.0, dh.d]), np.array([dh.alpha, 0.0, 0.0])
    links.append(URDFLink("tool", place, turn, rotation=None))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        arm = Chain(links, active_links_mask=[False, *[True] * 6, False])

    def solve(T: FloatArray) -> FloatArray:
        with mock.patch.object(np, "float", float, create=True):
            return np.array([arm.inverse_kinematics_frame(one, orientation_mode="all")[1:7] for one in T])

    return solve
