"""The robots of the papers, from the tables of `papers.toml`, and places that the papers name.

How a robot's inverse kinematics is closed, its axes tell (`kinematics/structure.py`). What is wrong in print stands
beside each robot.
"""

import math
import tomllib
from importlib import resources
from typing import Any

from armctl.kinematics.chain import DHRow, SerialChain
from armctl.kinematics.robots.robot import Robot


def _robot(name: str, table: dict[str, Any]) -> Robot:
    def chain(lengths: dict[str, float]) -> SerialChain:
        at = {"": 0.0, **lengths}
        links = tuple(DHRow(at[a], math.radians(alpha), at[d]) for a, alpha, d in table["rows"])
        return SerialChain(links, table["convention"], tool_m=at[table.get("tool", "")])

    return Robot(name, table["source"], table["lengths_m"], chain, tuple(map(tuple, table.get("ranges_deg", ()))))


_TABLES = tomllib.loads(resources.files(__package__).joinpath("papers.toml").read_text("utf-8"))
ROBOTS = {name: _robot(name, table) for name, table in _TABLES.items()}
XIANG, PUMA, AX12_LINE, LANZHOU, TRANSFER = ROBOTS.values()

# Table 2 of PUMA's paper: the wanted pose, and those that its improved and its standard genetic algorithm reached [m,
# rad].
WANTED_XYZ_RPY = (0.0968, -0.7558, 0.0972, -2.7913, 2.1047, -1.6016)
IMPROVED_XYZ_RPY = (0.0922, -0.7533, 0.0963, -2.7902, 2.1027, -1.6005)
STANDARD_XYZ_RPY = (0.07484, -0.3022, 0.05, -2.6551, 2.0468, -1.6058)
# Of LANZHOU.
LANZHOU_RANGES_DEG = LANZHOU.ranges_deg
FIG_5_DEG = (0.0, 0.0, -90.0, 90.0)
QZ_DEG = (60.0, 45.0, -90.0, 90.0)
# Of TRANSFER.
INITIAL_DEG = (90.0, -90.0, 0.0, 0.0, 0.0, 0.0)
