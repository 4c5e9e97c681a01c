"""Robots by name, those of the papers, and robots of arms' own tables."""

from dataclasses import replace

from armctl.config import ArmConfig, ChainTable
from armctl.errors import ConfigError
from armctl.kinematics.robots.papers import ROBOTS
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.robots.table import robot_of


def names() -> tuple[str, ...]:
    """Every robot's name."""
    return tuple(ROBOTS)


def get(name: str | ChainTable, lengths_m: dict[str, float] | None = None) -> Robot:
    """The robot of that name, or of a table, with some of its lengths replaced.

    Raises:
        ConfigError: no such robot, or no such length; the message lists the valid names.
    """
    if isinstance(name, ChainTable):
        return robot_of(name, name.urdf or "table").with_lengths(lengths_m or {})
    if name not in ROBOTS:
        raise ConfigError("robot", name, "no such robot", f"known: {', '.join(ROBOTS)}")
    return ROBOTS[name].with_lengths(lengths_m or {})


def of(arm: ArmConfig) -> Robot:
    """The robot that an arm is, with the joint ranges of its own file.

    Raises:
        ConfigError: no such robot or length, or fewer joints than the robot has.
    """
    named = get(arm.robot, arm.lengths_m)
    if (n := named.chain.n) > len(arm.joints):
        raise ConfigError("arm", "joints", f"{arm.robot} has {n} joints, not {len(arm.joints)}", "give one entry each")
    return replace(named, name=arm.robot_name, ranges_deg=tuple(joint.limits_deg for joint in arm.joints[:n]))
