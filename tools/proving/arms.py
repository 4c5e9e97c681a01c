"""The arms that episodes are played on: every shipped one, as it is or mounted otherwise.

A variation draws what differs between two arms of one kind: which way round a servo is mounted, what it reads at joint
position 0, how far a joint may go, in which order the servos have their ids. It is written as an arm's file, which the
package reads in its way and the judge in another.
"""

import math
from typing import Any

import numpy as np
import yaml

from armctl.config import ArmConfig, parse_yaml, validate
from armctl.files import find_arm_file, read_text
from proving.reading import TICK_DEG, TICK_MAX

SHIPPED = ("ax12-line", "lanzhou-4dof", "transfer-6dof", "xiang-6dof")
# How much of a joint's range a variation takes away, at most, at either end.
NARROWER = 0.12
# A joint keeps so much around its rest pose: an arm that lies there is supported, and sags when it is lifted.
REST_ROOM_DEG = 4.0
# Of so many arms one is as it is shipped.
AS_SHIPPED = 6
HIGHEST_ID = 253


def arm_text(name: str) -> str:
    """The file of an arm given by name or path."""
    return read_text(find_arm_file(name), "calibration")


def arm_of(text: str) -> ArmConfig:
    """The arm that a file describes, as the package has it."""
    return validate(ArmConfig, parse_yaml(text, "a varied arm"), "a varied arm")


def varied(text: str, rng: np.random.Generator) -> str:
    """Another arm of the same kind."""
    arm: dict[str, Any] = yaml.safe_load(text)
    ids = rng.choice(np.arange(1, 20 if rng.random() < 0.7 else HIGHEST_ID), len(arm["joints"]), replace=False)
    for joint, servo_id in zip(arm["joints"], ids.tolist(), strict=True):
        low, high = joint["limits_deg"]
        rest, room = joint.get("rest_deg", 0.0), NARROWER * (high - low)
        low = min(round(low + rng.uniform(0.0, room), 2), max(joint["limits_deg"][0], rest - REST_ROOM_DEG))
        high = max(round(high - rng.uniform(0.0, room), 2), min(joint["limits_deg"][1], rest + REST_ROOM_DEG))
        direction = int(rng.choice((-1, 1)))
        # Every position of the joint is one of the servo's.
        ends = sorted((-direction * low / TICK_DEG, -direction * high / TICK_DEG))
        zero = rng.uniform(math.ceil(max(-1023.0, ends[1])), math.floor(min(2046.0, TICK_MAX + ends[0])))
        joint |= {"servo_id": servo_id, "direction": direction, "zero_tick": round(float(zero), 2),
                  "limits_deg": [low, high]}  # fmt: skip
        if rng.random() < 0.2:
            joint["speed_limit_deg_s"] = round(float(rng.uniform(35.0, 90.0)), 1)
    _vary_pairs(arm, rng)
    if "joint" in arm.get("gripper", {}):
        low, high = next(j["limits_deg"] for j in arm["joints"] if j["name"] == arm["gripper"]["joint"])
        arm["gripper"] |= {"open_deg": max(0.0, low), "closed_deg": min(90.0, high)}
    return yaml.safe_dump(arm, sort_keys=False)


def _vary_pairs(arm: dict[str, Any], rng: np.random.Generator) -> None:
    """Other ids for second servos, and for a gripper's own; some pairs are measured, and off what is on paper."""
    own = [arm["gripper"]] if "servo_id" in arm.get("gripper", {}) else []
    rows = [*arm["joints"], *own]
    paired, taken = [row for row in rows if "pair" in row], {joint["servo_id"] for joint in arm["joints"]}
    free = [int(servo_id) for servo_id in range(1, 30) if servo_id not in taken] if paired or own else []
    for one in (*own, *(row["pair"] for row in paired)):
        one["servo_id"] = free.pop(int(rng.integers(len(free))))
    for joint in paired:
        if "limits_deg" in joint and rng.random() < 0.5:
            ends = [joint["zero_tick"] + joint["direction"] * limit / TICK_DEG for limit in joint["limits_deg"]]
            off = float(rng.uniform(-15.0, 15.0))
            off = min(max(off, max(ends) - TICK_MAX), min(ends))  # both read 0 to 1023
            joint["pair"]["table"] = [[round(tick, 1), round(TICK_MAX - tick + off, 1)] for tick in sorted(ends)]


def drawn(seed: int, episode: int, arm: str = "") -> str:
    """The file of the arm on which an episode is played; every shipped one comes in its turn, or one by its name."""
    rng = np.random.default_rng((seed, episode, 11))
    text = arm_text(arm or SHIPPED[episode % len(SHIPPED)])
    return text if rng.integers(AS_SHIPPED) == 0 else varied(text, rng)
