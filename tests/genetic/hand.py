"""Synthetic recordings of a hand guiding the limp arm along a line."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from armctl.config import ArmConfig
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import jacobian
from armctl.kinematics.inverse import solve_position
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray

REFUSALS = Path(__file__).with_name("refusals.yaml")
A = np.array([0.18, -0.125, 0.10])
B = np.array([0.18, 0.125, 0.10])
POSTURE = (-0.6, 1.2, -1.6, -0.6, 0.0)
# Two ways to hold the arm at A: elbow up, and bent the other way.
FLIPPED = (-0.6, 0.4, 0.9, -1.9, -0.9)


@cache
def arm() -> ArmConfig:
    return load_arm("ax12-line")


@cache
def robot() -> Robot:
    return robots.get(arm().robot, arm().lengths_m)


def changed(original: ArmConfig, joint: int | None = None, **changes: Any) -> ArmConfig:
    """The arm, or one of its joints, with other settings."""
    data = original.model_dump()
    (data if joint is None else data["joints"][joint]).update(changes)
    return ArmConfig.model_validate(data)


def refusals(of: str) -> list[tuple[dict[str, Any], str]]:
    """What is changed so that it is refused, and what is said of it."""
    return [tuple(row) for row in yaml.safe_load(REFUSALS.read_text(encoding="utf-8"))[of]]


@cache
def joint_line(posture: tuple[float, ...] = POSTURE) -> FloatArray:
    """Joint positions along the line AB, shape (65, 5)."""
    limits = np.array([joint.limits_rad for joint in arm().joints])[: robot().chain.n]
    q, rows = np.array(posture), []
    for share in np.linspace(0.0, 1.0, 65):
        q = solve_position(robot().chain, A + share * (B - A), q, limits)
        rows.append(q)
    return np.array(rows)


# Standard deviations: of the tool off the line in y and z, and of its progress; of a take's own posture.
WOBBLE_M, POSTURE_RAD = 0.008, 0.06


def recording(rng: np.random.Generator, posture: tuple[float, ...]) -> FloatArray:
    """One take at 10 Hz, shape (samples, 6): dead time, uneven speed, a smooth wobble off the line, whole ticks.

    Each take has its own posture, which does not move the tool.
    """
    dead = rng.integers(5, 15, 2)
    moving = int(rng.integers(50, 90))
    pace = np.cumsum(np.interp(np.linspace(0, 5, moving), range(6), rng.uniform(0.4, 1.6, 6)))
    share = np.concatenate([np.zeros(dead[0]), pace / pace[-1], np.ones(dead[1])])
    samples = len(share)
    line = np.stack([np.interp(share * 64.0, range(65), joint) for joint in joint_line(posture).T], axis=1)

    knots = max(4, samples // 8)

    def smooth(width: int) -> FloatArray:
        at = np.linspace(0.0, knots - 1.0, samples)
        return np.stack([np.interp(at, range(knots), rng.standard_normal(knots)) for _ in range(width)], axis=1)

    J = jacobian(robot().chain, line)[:, :3]
    inverse = np.linalg.pinv(J)
    null = np.eye(5) - inverse @ J
    held = POSTURE_RAD * (rng.standard_normal(5) + 0.2 * smooth(5))
    q = line + (inverse @ (WOBBLE_M * smooth(3))[..., None])[..., 0] + (null @ held[..., None])[..., 0]
    raw = np.concatenate([q, 0.3 + 0.02 * smooth(1)], axis=1)
    ticks = np.stack([np.round([joint.tick(x) for x in raw[:, i]]) for i, joint in enumerate(arm().joints)], axis=1)
    return np.stack([[joint.position_rad(t) for t in ticks[:, i]] for i, joint in enumerate(arm().joints)], axis=1)


def recordings(count: int, seed: int, posture: tuple[float, ...] = POSTURE) -> list[FloatArray]:
    rng = np.random.default_rng(seed)
    return [recording(rng, posture) for _ in range(count)]
