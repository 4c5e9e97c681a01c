"""Commands of the kinematics: robots, fk, ik, jacobian, workspace, trajectory. No daemon needed."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from armctl.cli.output import POINT, Output, output_option
from armctl.cli.tables import show_table
from armctl.errors import ConfigError

if TYPE_CHECKING:
    from armctl.kinematics.robots.robot import Robot
    from armctl.kinematics.solution import Answer, Target

F = TypeVar("F", bound=Callable[..., Any])
OUT = click.Path(path_type=Path, dir_okay=False)


class NumbersType(click.ParamType):  # type: ignore[type-arg]  # generic only in some versions
    """Numbers parted by commas or blanks."""

    name = "a,b,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in str(value).replace(",", " ").split())
        except ValueError:
            self.fail(f"{value!r} is not a list of numbers such as 0.1,-0.2,0.3", param, ctx)
        if not numbers or not all(math.isfinite(number) for number in numbers):
            self.fail(f"{value!r}: the numbers must be finite", param, ctx)
        return numbers


class LengthType(click.ParamType):  # type: ignore[type-arg]  # generic only in some versions
    """`name=metres`."""

    name = "name=m"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, float]:
        if isinstance(value, tuple):
            return value
        name, _, text = str(value).partition("=")
        try:
            return name.strip(), float(text)
        except ValueError:
            self.fail(f"{value!r} is not a length such as a2=0.5", param, ctx)


NUMBERS = NumbersType()


def robot_options(function: F) -> F:
    """Adds `--robot` and `--set`; the command receives `robot_name` and `lengths`."""
    set_option = click.option("--set", "lengths", type=LengthType(), multiple=True, help="Another length, metres.")
    return click.option("--robot", "robot_name", required=True, metavar="R", help="See `armctl robots`.")(
        set_option(function)
    )


deg_option = click.option("--deg", is_flag=True, help="Angles are given and told in degrees (JSON: always radians).")


@click.command("robots")
@output_option
def robots_command(output: Output) -> None:
    """The robot models armctl knows.

    Example: armctl robots
    """
    from armctl.kinematics import robots

    known = [robots.get(name) for name in robots.names()]
    rows = [{"name": r.name, "joints": r.chain.n, "convention": r.chain.convention, "source": r.source} for r in known]
    if not output.result({"robots": rows}):
        shown = [(str(row["name"]), str(row["joints"]), f"{row['convention']} DH", str(row["source"])) for row in rows]
        columns = ("robot", "joints", "convention", "source")
        show_table(output.console, "", columns, shown, words=("robot", "convention", "source"))


@click.command("fk")
@robot_options
@click.option("--q", required=True, type=NUMBERS, help="Joint positions.")
@deg_option
@output_option
def fk_command(
    output: Output, robot_name: str, lengths: tuple[tuple[str, float], ...], q: tuple[float, ...], deg: bool
) -> None:
    """Forward kinematics: the tool's pose for joint positions.

    Example: armctl fk --robot puma560 --q 0,45,-30,0,20,0 --deg
    """
    import numpy as np

    from armctl.kinematics.chain import forward_kinematics
    from armctl.kinematics.transform import rpy_from_matrix

    robot = _robot(robot_name, lengths)
    T = forward_kinematics(robot.chain, np.array(_configuration(robot, "--q", q, deg)))
    rpy = rpy_from_matrix(T[:3, :3])
    if output.result({"T": T.tolist(), "position_m": T[:3, 3].tolist(), "rpy_rad": list(rpy)}):
        return
    _say_matrix(output, T.tolist())
    output.say(f"position  {_numbers(T[:3, 3].tolist())} m")
    output.say(f"rpy       {_angles(rpy, deg)}")


@click.command("ik")
@robot_options
@click.option("--xyz", type=POINT, help="A point for the tool, metres.")
@click.option("--pose", type=NUMBERS, help="x,y,z,roll,pitch,yaw; R = Rz(yaw) Ry(pitch) Rx(roll).")
@click.option("--T", "matrix", type=NUMBERS, help="A pose as 16 numbers, row by row.")
@click.option(
    "--method", type=click.Choice(("closed", "numeric", "ga", "ga-improved")), default="closed", show_default=True
)
@click.option("--polish/--no-polish", default=True, show_default=True, help="Bring solutions onto the target.")
@click.option("--all", "every", is_flag=True, help="Every solution, not only the best.")
@click.option("--near", type=NUMBERS, help="Present joint positions: solutions near them come first.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0), help="Repeats a random search.")
@deg_option
@output_option
def ik_command(
    output: Output,
    robot_name: str,
    lengths: tuple[tuple[str, float], ...],
    xyz: tuple[float, float, float] | None,
    pose: tuple[float, ...] | None,
    matrix: tuple[float, ...] | None,
    method: str,
    polish: bool,
    every: bool,
    near: tuple[float, ...] | None,
    seed: int,
    deg: bool,
) -> None:
    """Inverse kinematics: joint positions for a point or a pose of the tool, or the nearest there are.

    A target out of reach is an answer too: `reachable` is false, the solutions are the nearest configurations and
    `least_position_error_m` is the exact distance.

    Example: armctl ik --robot puma560 --pose 0.0968,-0.7558,0.0972,-2.7913,2.1047,-1.6016 --all
    """
    robot = _robot(robot_name, lengths)
    target = _target(xyz, pose, matrix, deg)
    present = None if near is None else _configuration(robot, "--near", near, deg)
    found = METHODS[method](robot, target, present, polish, seed)
    solutions = found.solutions if every else found.solutions[:1]
    if output.result(
        {
            "reachable": found.reachable,
            "least_position_error_m": found.least_position_error_m,
            "solutions": [
                {
                    "q_rad": list(one.q_rad),
                    "position_error_m": one.position_error_m,
                    "orientation_error_rad": one.orientation_error_rad,
                    "within_limits": one.within_limits,
                }
                for one in solutions
            ],
        }
    ):
        return
    if not found.reachable:
        gap = found.least_position_error_m
        output.say(
            f"out of reach by {gap * 1000.0:.6g} mm; the nearest:"
            if gap > 0.0
            else "the position is in reach, this rotation is not; the nearest:"
        )
    for one in solutions:
        missed = f"{one.position_error_m * 1000.0:.3g} mm, {one.orientation_error_rad:.3g} rad off"
        output.say(_angles(one.q_rad, deg))
        output.say(f"  {missed}{'' if one.within_limits else ', outside the joint ranges'}")


@click.command("jacobian")
@robot_options
@click.option("--q", required=True, type=NUMBERS, help="Joint positions.")
@deg_option
@output_option
def jacobian_command(
    output: Output, robot_name: str, lengths: tuple[tuple[str, float], ...], q: tuple[float, ...], deg: bool
) -> None:
    """The geometric Jacobian in the base frame, its rank and the manipulability.

    Example: armctl jacobian --robot transfer-6dof --q 0,-60,20,0,30,0 --deg
    """
    import numpy as np

    from armctl.kinematics.chain import jacobian
    from armctl.kinematics.differential import dexterity

    robot = _robot(robot_name, lengths)
    J = jacobian(robot.chain, np.array(_configuration(robot, "--q", q, deg)))
    found = dexterity(J)
    result = {
        "J": J.tolist(),
        "rank": found.rank,
        "manipulability": found.manipulability,
        "singular_values": found.singular_values.tolist(),
    }
    if output.result(result):
        return
    _say_matrix(output, J.tolist())
    singular = "" if found.rank == min(J.shape) else "   singular"
    output.say(f"rank {found.rank}, manipulability {found.manipulability:.6g}{singular}")


@click.command("workspace")
@robot_options
@click.option("--samples", default=20000, show_default=True, type=click.IntRange(1, 2_000_000), help="Random samples.")
@click.option("--grid", default=0, type=click.IntRange(0, 60), help="Map a grid of N points an axis too.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0), help="Repeats a run.")
@click.option("--out", type=OUT, help="An HTML page with the workspace in 3D and three projections.")
@output_option
def workspace_command(
    output: Output,
    robot_name: str,
    lengths: tuple[tuple[str, float], ...],
    samples: int,
    grid: int,
    seed: int,
    out: Path | None,
) -> None:
    """Where the tool can be within the joint ranges: exact extents, and those of a random cloud.

    Example: armctl workspace --robot lanzhou-4dof --out workspace.html
    """
    import numpy as np

    from armctl.kinematics import workspace

    robot = _robot(robot_name, lengths)
    rng = np.random.default_rng(seed)
    extent = workspace.extents(robot.chain, robot.limits_rad, rng)
    points = workspace.cloud(robot.chain, robot.limits_rad, samples, rng)
    reach = workspace.reachability(robot, workspace.grid(extent, grid)) if grid else None
    if out is not None:
        from armctl.report import kinematics as report

        report.write_workspace(robot, extent, points, reach, out)
    result: dict[str, Any] = {
        "extent_m": _box(extent.tolist()),
        "monte_carlo_extent_m": _box(workspace.cloud_extents(points).tolist()),
    }
    if reach is not None:
        result["reachable_share"] = float(reach.reachable.mean())
    if output.result(result):
        return
    for axis in "xyz":
        exact, cloud = result["extent_m"][axis], result["monte_carlo_extent_m"][axis]
        output.say(f"{axis}: {exact[0]:9.6f} .. {exact[1]:9.6f} m   random: {cloud[0]:9.6f} .. {cloud[1]:9.6f} m")
    if reach is not None:
        output.say(f"{100.0 * result['reachable_share']:.1f} % of the grid's points are in reach")
    if out is not None:
        output.say(f"drawn: {out}")


@click.command("trajectory")
@robot_options
@click.option("--q0", required=True, type=NUMBERS, help="Joint positions at the start.")
@click.option("--q1", required=True, type=NUMBERS, help="Joint positions at the end.")
@click.option("--duration", required=True, type=float, help="Seconds.")
@click.option("--v0", type=NUMBERS, help="Joint velocities at the start, per second.")
@click.option("--v1", type=NUMBERS, help="Joint velocities at the end.")
@click.option("--a0", type=NUMBERS, help="Joint accelerations at the start, per second squared.")
@click.option("--a1", type=NUMBERS, help="Joint accelerations at the end.")
@click.option("--samples", default=101, show_default=True, type=click.IntRange(2, 100_000), help="Times evaluated.")
@click.option("--out", type=OUT, help="An HTML page with the curves of joints and tool.")
@deg_option
@output_option
def trajectory_command(
    output: Output,
    robot_name: str,
    lengths: tuple[tuple[str, float], ...],
    q0: tuple[float, ...],
    q1: tuple[float, ...],
    duration: float,
    v0: tuple[float, ...] | None,
    v1: tuple[float, ...] | None,
    a0: tuple[float, ...] | None,
    a1: tuple[float, ...] | None,
    samples: int,
    out: Path | None,
    deg: bool,
) -> None:
    """A fifth-order joint trajectory: curves of the joints and the tool's path.

    Example: armctl trajectory --robot lanzhou-4dof --q0 0,60,-30,0 --q1 60,45,-60,60 --duration 2 --deg
    """
    import numpy as np

    from armctl.trajectory import quintic

    robot = _robot(robot_name, lengths)

    def boundary(name: str, values: tuple[float, ...] | None) -> Any:
        return 0.0 if values is None else np.array(_configuration(robot, name, values, deg))

    motion = quintic.quintic(
        boundary("--q0", q0),
        boundary("--q1", q1),
        duration,
        v0=boundary("--v0", v0),
        v1=boundary("--v1", v1),
        a0=boundary("--a0", a0),
        a1=boundary("--a1", a1),
    )
    curves = quintic.curves(robot.chain, motion, np.linspace(0.0, duration, samples))
    if out is not None:
        from armctl.report import kinematics as report

        report.write_trajectory(robot, curves, out)
    result = {
        "time_s": curves.time_s.tolist(),
        "position_rad": curves.position_rad.tolist(),
        "velocity_rad_s": curves.velocity_rad_s.tolist(),
        "acceleration_rad_s2": curves.acceleration_rad_s2.tolist(),
        "tool_position_m": curves.tool_position_m.tolist(),
        "tool_velocity_m_s": curves.tool_velocity_m_s.tolist(),
        "tool_acceleration_m_s2": curves.tool_acceleration_m_s2.tolist(),
    }
    if output.result(result):
        return
    peak, push = np.abs(curves.velocity_rad_s).max(axis=0), np.abs(curves.acceleration_rad_s2).max(axis=0)
    unit = "deg" if deg else "rad"
    shown = [
        (str(joint + 1), *(f"{math.degrees(value) if deg else value:.6f}" for value in values))
        for joint, values in enumerate(zip(peak.tolist(), push.tolist(), strict=True))
    ]
    show_table(output.console, "", ("joint", f"peak velocity, {unit}/s", f"peak acceleration, {unit}/s^2"), shown)
    output.say(f"tool from {_numbers(result['tool_position_m'][0])} to {_numbers(result['tool_position_m'][-1])} m")
    if out is not None:
        output.say(f"drawn: {out}")


def _closed(robot: Robot, target: Target, present: list[float] | None, polish: bool, seed: int) -> Answer:
    return _solve("closed", robot, target, present, polish, seed)


def _numeric(robot: Robot, target: Target, present: list[float] | None, polish: bool, seed: int) -> Answer:
    return _solve("numeric", robot, target, present, polish, seed)


def _genetic(robot: Robot, target: Target, present: list[float] | None, polish: bool, seed: int) -> Answer:
    return _evolve("ga", robot, target, present, polish, seed)


def _improved(robot: Robot, target: Target, present: list[float] | None, polish: bool, seed: int) -> Answer:
    return _evolve("ga-improved", robot, target, present, polish, seed)


def _evolve(method: Any, robot: Robot, target: Target, present: list[float] | None, polish: bool, seed: int) -> Answer:
    import numpy as np

    from armctl.kinematics.genetic.solve import solve

    near = None if present is None else np.array(present)
    return solve(robot, target, method=method, present=near, polish=polish, seed=seed)


def _solve(method: Any, robot: Robot, target: Target, present: list[float] | None, polish: bool, seed: int) -> Answer:
    import numpy as np

    from armctl.kinematics.solution import solve

    near = None if present is None else np.array(present)
    return solve(robot, target, method=method, present=near, polish=polish, seed=seed)


Method = Callable[["Robot", "Target", "list[float] | None", bool, int], "Answer"]
METHODS: dict[str, Method] = {"closed": _closed, "numeric": _numeric, "ga": _genetic, "ga-improved": _improved}
"""Name of each method -> (robot, target, present [rad] or None, polish, seed) -> answer."""


def _robot(name: str, lengths: tuple[tuple[str, float], ...]) -> Robot:
    from armctl.kinematics import robots

    return robots.get(name, dict(lengths))


def _target(
    xyz: tuple[float, float, float] | None,
    pose: tuple[float, ...] | None,
    matrix: tuple[float, ...] | None,
    deg: bool,
) -> Target:
    import numpy as np

    from armctl.kinematics.solution import point_target, pose_target
    from armctl.kinematics.transform import pose_from_xyz_rpy

    if sum(given is not None for given in (xyz, pose, matrix)) != 1:
        raise click.UsageError("give one of --xyz, --pose and --T")
    if xyz is not None:
        return point_target(xyz)
    if pose is not None:
        if len(pose) != 6:
            raise ConfigError("target", "--pose", f"{len(pose)} numbers", "give x,y,z,roll,pitch,yaw")
        x, y, z, *rpy = pose
        roll, pitch, yaw = (math.radians(angle) if deg else angle for angle in rpy)
        return pose_target(pose_from_xyz_rpy(x, y, z, roll, pitch, yaw))
    numbers = matrix or ()
    if len(numbers) != 16:
        raise ConfigError("target", "--T", f"{len(numbers)} numbers", "give 16, the 4x4 pose row by row")
    return pose_target(np.array(numbers).reshape(4, 4))


def _configuration(robot: Robot, option: str, values: tuple[float, ...], deg: bool) -> list[float]:
    """One number a joint [rad].

    Raises:
        ConfigError: another count of numbers.
    """
    if len(values) != robot.chain.n:
        raise ConfigError(robot.name, option, f"{len(values)} numbers", f"this robot has {robot.chain.n} joints")
    return [math.radians(value) if deg else value for value in values]


def _box(extent: list[list[float]]) -> dict[str, list[float]]:
    return dict(zip("xyz", extent, strict=True))


def _say_matrix(output: Output, rows: list[list[float]]) -> None:
    """A matrix of up to six columns within 80 characters."""
    for row in rows:
        output.say("  ".join(f"{value:11.8f}" for value in row))


def _numbers(values: list[float], digits: int = 6) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def _angles(values: Any, deg: bool) -> str:
    if deg:
        return f"{_numbers([math.degrees(value) for value in values], 5)} deg"
    return f"{_numbers(list(values))} rad"
