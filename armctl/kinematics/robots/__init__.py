"""Robots by name. One file a robot: its table, its source, what is wrong in print."""

from armctl.errors import ConfigError
from armctl.kinematics.robots import ax12_line, lanzhou_4dof, puma560, transfer_6dof, xiang_6dof
from armctl.kinematics.robots.robot import Robot

_ROBOTS = {
    robot.name: robot
    for robot in (xiang_6dof.ROBOT, puma560.ROBOT, ax12_line.ROBOT, lanzhou_4dof.ROBOT, transfer_6dof.ROBOT)
}


def names() -> tuple[str, ...]:
    """Every robot's name."""
    return tuple(_ROBOTS)


def get(name: str, lengths_m: dict[str, float] | None = None) -> Robot:
    """The robot of that name, with some of its lengths replaced.

    Raises:
        ConfigError: no such robot, or no such length; the message lists the valid names.
    """
    if name not in _ROBOTS:
        raise ConfigError("robot", name, "no such robot", f"known: {', '.join(_ROBOTS)}")
    return _ROBOTS[name].with_lengths(lengths_m or {})
