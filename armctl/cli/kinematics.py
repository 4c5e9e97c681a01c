"""Commands of the kinematics: robots, fk, ik, jacobian, workspace, trajectory. No daemon needed."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from armctl.cli.output import Output, command
from armctl.cli.tables import show_rows, show_table
from armctl.errors import ConfigError
from armctl.files import find_arm_file, load_arm

if TYPE_CHECKING:
    from armctl.kinematics.robots.robot import Robot
    from armctl.kinematics.solution import Answer, Solution
    from armctl.kinematics.target import Target
    from armctl.kinematics.transform import FloatArray


def robot_option(function: Callable[..., object]) -> Callable[..., object]:
    """For commands with `--robot` and `--set`, which receive the `Robot` as their second argument."""

    @functools.wraps(function)
    def on_robot(output: Output, robot_name: str, lengths: tuple[tuple[str, float], ...], **given: Any) -> object:
        return function(output, _robot(robot_name).with_lengths(dict(lengths)), **given)

    return on_robot


def _robot(name: str) -> Robot:
    """A robot by its name, or that of an arm or its file."""
    from armctl.kinematics import robots

    file = None
    with suppress(ConfigError):  # of what is neither, `get` says which there are
        file = None if name in robots.names() else find_arm_file(name)
    return robots.get(name) if file is None else robots.of(load_arm(name))


@command("robots")
def robots_command(output: Output) -> None:
    """The robot models armctl knows.

    Example: armctl robots
    """
    from armctl.kinematics import robots

    known = [robots.get(name) for name in robots.names()]
    rows = [{"name": r.name, "joints": r.chain.n, "convention": r.chain.convention, "source": r.source} for r in known]
    output.answer({"robots": rows}, lambda: show_rows(output.console, "robots", "", rows))


@command("fk")
@robot_option
def fk_command(output: Output, robot: Robot, q: tuple[float, ...], deg: bool) -> None:
    """Forward kinematics: the tool's pose for joint positions.

    Example: armctl fk --robot puma560 --q 0,45,-30,0,20,0 --deg
    """
    from armctl.kinematics.chain import forward_kinematics
    from armctl.kinematics.transform import rpy_from_matrix

    T = forward_kinematics(robot.chain, _configuration(robot, "--q", q, deg))
    position_m, rpy_rad = T[:3, 3].tolist(), list(rpy_from_matrix(T[:3, :3]))
    output.answer(
        {"T": T.tolist(), "position_m": position_m, "rpy_rad": rpy_rad},
        f"{_matrix(T.tolist())}\nposition  {_numbers(position_m)} m\nrpy       {_angles(rpy_rad, deg)}",
    )


@command("ik")
@robot_option
def ik_command(
    output: Output, robot: Robot, method: Any, every: bool, near: tuple[float, ...] | None, deg: bool, **asked: Any
) -> None:
    """Inverse kinematics: joint positions for a point or a pose of the tool, or the nearest there are.

    A target out of reach is an answer too: `reachable` is false, the solutions are the nearest configurations and
    `least_position_error_m` is the exact distance.

    Example: armctl ik --robot puma560 --pose 0.0968,-0.7558,0.0972,-2.7913,2.1047,-1.6016 --all
    """
    from armctl.kinematics import solution
    from armctl.kinematics.genetic import solve as genetic
    from armctl.kinematics.target import direction_target

    direction = asked.pop("direction")
    target = _target(asked.pop("xyz"), asked.pop("pose"), asked.pop("matrix"), deg)
    if direction is not None:
        if target.turned or method.startswith("ga"):
            raise click.UsageError("--direction goes with --xyz, and with --method closed or numeric")
        target = direction_target(target.position_m, direction)
    present = None if near is None else _configuration(robot, "--near", near, deg)
    solve = genetic.solve if method.startswith("ga") else solution.solve
    found = solve(robot, target, method=method, present=present, **asked)
    solutions = found.solutions if every else found.solutions[:1]
    keys = ("q_rad", "position_error_m", "orientation_error_rad", "within_limits")
    answer: dict[str, Any] = {key: getattr(found, key) for key in ("reachable", "least_position_error_m")}
    answer["solutions"] = [{key: getattr(one, key) for key in keys} for one in solutions]
    output.answer(answer, lambda: show_solutions(output, found, solutions, deg))


def show_solutions(output: Output, found: Answer, solutions: Sequence[Solution], deg: bool) -> None:
    from armctl.kinematics.solution import REACHED_M

    if not found.reachable:
        gap = found.least_position_error_m
        found_it = bool(solutions) and solutions[0].position_error_m <= REACHED_M
        in_reach = "the position is in reach, this rotation is not" if found_it else "in reach, but not reached by this"
        output.say(f"{f'out of reach by {gap * 1000.0:.6g} mm' if gap > 0.0 else in_reach}; the nearest:")
    for solution in solutions:
        missed = f"{solution.position_error_m * 1000.0:.3g} mm, {solution.orientation_error_rad:.3g} rad off"
        output.say(_angles(solution.q_rad, deg))
        output.say(f"  {missed}{'' if solution.within_limits else ', outside the joint ranges'}")


@command("jacobian")
@robot_option
def jacobian_command(output: Output, robot: Robot, q: tuple[float, ...], deg: bool) -> None:
    """The geometric Jacobian in the base frame, its rank and the manipulability.

    Example: armctl jacobian --robot transfer-6dof --q 0,-60,20,0,30,0 --deg
    """
    from armctl.kinematics.chain import jacobian
    from armctl.kinematics.differential import dexterity

    J = jacobian(robot.chain, _configuration(robot, "--q", q, deg))
    found = dexterity(J)
    result = {"J": J.tolist(), **found._asdict(), "singular_values": found.singular_values.tolist()}
    singular = "" if found.rank == min(J.shape) else "   singular"
    told = f"rank {found.rank}, manipulability {found.manipulability:.6g}{singular}"
    output.answer(result, f"{_matrix(J.tolist())}\n{told}")


@command("workspace")
@robot_option
def workspace_command(output: Output, robot: Robot, samples: int, grid: int, seed: int, out: Path | None) -> None:
    """Where the tool can be within the joint ranges: exact extents, and those of a random cloud.

    Example: armctl workspace --robot lanzhou-4dof --out workspace.html
    """
    import numpy as np

    from armctl.kinematics import workspace

    rng = np.random.default_rng(seed)
    extent = workspace.extents(robot.chain, robot.limits_rad, rng)
    points = workspace.cloud(robot.chain, robot.limits_rad, samples, rng)
    reach = workspace.reachability(robot, workspace.grid(extent, grid)) if grid else None
    if out is not None:
        from armctl.report import kinematics as report

        report.write_workspace(robot, extent, points, reach, out)
    boxes = {"extent_m": extent.tolist(), "monte_carlo_extent_m": workspace.cloud_extents(points).tolist()}
    result: dict[str, Any] = {key: dict(zip("xyz", box, strict=True)) for key, box in boxes.items()}
    told = [
        f"{axis}: {low:9.6f} .. {high:9.6f} m   random: {cloud_low:9.6f} .. {cloud_high:9.6f} m"
        for axis, (low, high), (cloud_low, cloud_high) in zip("xyz", *boxes.values(), strict=True)
    ]
    if reach is not None:
        result["reachable_share"] = float(reach.reachable.mean())
        told.append(f"{100.0 * result['reachable_share']:.1f} % of the grid's points are in reach")
    if out is not None:
        told.append(f"drawn: {out}")
    output.answer(result, "\n".join(told))


@command("trajectory")
@robot_option
def trajectory_command(
    output: Output, robot: Robot, duration: float, samples: int, out: Path | None, deg: bool, **ends: Any
) -> None:
    """A fifth-order joint trajectory: curves of the joints and the tool's path.

    Example: armctl trajectory --robot lanzhou-4dof --q0 0,60,-30,0 --q1 60,45,-60,60 --duration 2 --deg
    """
    import numpy as np

    from armctl.trajectory import quintic

    known: dict[str, Any] = {end: _configuration(robot, f"--{end}", q, deg) for end, q in ends.items() if q is not None}
    motion = quintic.quintic(known.pop("q0"), known.pop("q1"), duration, **known)
    time_s = np.linspace(0.0, duration, samples)
    curves = quintic.curves(robot.chain, time_s, *motion.sample(time_s))
    if out is not None:
        from armctl.report import kinematics as report

        report.write_trajectory(robot, curves, out)
    # How the tool turns is drawn on the page only.
    result = {key: values.tolist() for key, values in curves._asdict().items() if "angular" not in key}
    output.answer(result, lambda: show_curves(output, result, deg, out))


def show_curves(output: Output, result: dict[str, Any], deg: bool, out: Path | None) -> None:
    import numpy as np

    unit, factor = ("deg", math.degrees(1.0)) if deg else ("rad", 1.0)
    peaks = [factor * np.abs(result[key]).max(axis=0) for key in ("velocity_rad_s", "acceleration_rad_s2")]
    shown = [(str(joint), *(f"{peak:.6f}" for peak in both)) for joint, both in enumerate(zip(*peaks, strict=True), 1)]
    show_table(output.console, "", ("joint", f"peak velocity, {unit}/s", f"peak acceleration, {unit}/s^2"), shown)
    tool_m = result["tool_position_m"]
    output.say(f"tool from {_numbers(tool_m[0])} to {_numbers(tool_m[-1])} m")
    if out is not None:
        output.say(f"drawn: {out}")


def _target(
    xyz: tuple[float, float, float] | None, pose: tuple[float, ...] | None, matrix: tuple[float, ...] | None, deg: bool
) -> Target:
    import numpy as np

    from armctl.kinematics.target import point_target, pose_target
    from armctl.kinematics.transform import pose_from_xyz_rpy

    if sum(given is not None for given in (xyz, pose, matrix)) != 1:
        raise click.UsageError("give one of --xyz, --pose and --T")
    if xyz is not None:
        return point_target(xyz)
    if pose is not None:
        return pose_target(pose_from_xyz_rpy(*pose[:3], *(map(math.radians, pose[3:]) if deg else pose[3:])))
    return pose_target(np.array(matrix).reshape(4, 4))


def _configuration(robot: Robot, option: str, values: tuple[float, ...], deg: bool) -> FloatArray:
    """One number a joint [rad], shape (n,).

    Raises:
        ConfigError: another count of numbers.
    """
    import numpy as np

    if len(values) != robot.chain.n:
        raise ConfigError(robot.name, option, f"{len(values)} numbers", f"this robot has {robot.chain.n} joints")
    return np.radians(values) if deg else np.array(values)


def _matrix(rows: list[list[float]]) -> str:
    """A matrix of up to six columns within 80 characters."""
    return "\n".join("  ".join(f"{value:11.8f}" for value in row) for row in rows)


def _numbers(values: list[float], digits: int = 6) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def _angles(values: Any, deg: bool) -> str:
    return f"{_numbers([*map(math.degrees, values)], 5)} deg" if deg else f"{_numbers([*values])} rad"
