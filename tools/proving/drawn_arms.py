"""Arms that nobody has built: chains of 3 to 7 joints drawn at random, each written as an arm's file.

Every chain begins with a waist and is straight up at zero. Then come joints that pitch (`p`) and joints that roll about
the link (`r`), with links, offsets and, in a URDF, axes that are a little askew and frames turned anyhow. The first
three are always a waist with two pitch joints, as a table alone, six joints with an offset wrist and seven, as URDFs
alone.

Where the tool is, is known here by itself: the product of what was drawn, before it was written down.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from proving.reading import TICK_DEG, TICK_MAX

FloatArray = NDArray[np.float64]

KINDS = ("dh", "urdf")
ALWAYS = (("wpp", "dh"), ("wpprpr", "urdf"), ("wpprppr", "urdf"))
# What other chains look like: a table has its pitch joints in one plane.
TABLES = ("wpp", "wppp", "wpppp", "wpppr", "wppr")
URDFS = ("wpp", "wppp", "wppr", "wpppr", "wpprp", "wpppp", "wpprpr", "wpppr", "wprprpr", "wpprppr", "wppprpr")
# From the shoulder to the tool [m], and a link between two joints at least: what a motor of this kind lifts.
REACH_M, LEAST_M = (0.23, 0.30), 0.035
HEIGHT_M, FORWARD_M, ASIDE_M = (0.05, 0.10), 0.02, 0.015
ASKEW_RAD = math.radians(5.0)
LIMITS_DEG = {"w": 145.0, "p": 120.0, "r": 140.0}
# How much of it may be missing at either end.
NARROWER = 0.15
FILE, URDF = "arm.yaml", "arm.urdf"


@dataclass(frozen=True, eq=False)
class DrawnArm:
    """One arm: its files, and what they have to mean."""

    kind: str
    # By name; `FILE` describes the arm.
    files: dict[str, str]
    # For each joint its frame in the one before, all of them at zero, shape (4, 4), and its axis in that frame.
    links: tuple[tuple[FloatArray, FloatArray], ...]
    # In the last joint's frame.
    tool: FloatArray
    # Shape (n, 2).
    limits_rad: FloatArray

    @property
    def n(self) -> int:
        return len(self.links)

    def tool_pose(self, q: FloatArray) -> FloatArray:
        """Tool poses of joint positions [rad], shape (m, n or more) -> (m, 4, 4)."""
        return self._frames(q)[-1]

    def tool_m(self, q: FloatArray) -> FloatArray:
        """Tool points [m], shape (m, 3)."""
        return np.asarray(self.tool_pose(q)[:, :3, 3])

    def axes(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where the joints stand and last the tool [m], shape (m, n + 1, 3), and about what they turn, (m, n, 3)."""
        *frames, tool = self._frames(q)
        about = [T[:, :3, :3] @ axis for T, (_, axis) in zip(frames, self.links, strict=True)]
        return np.stack([T[:, :3, 3] for T in (*frames, tool)], axis=1), np.stack(about, axis=1)

    def _frames(self, q: FloatArray) -> list[FloatArray]:
        """The frames that the joints turn, and the tool's, each (m, 4, 4)."""
        frames = [np.broadcast_to(np.eye(4), (len(q), 4, 4))]
        for (before, axis), angles in zip(self.links, np.asarray(q).T, strict=False):
            frames.append(frames[-1] @ before @ turned(axis, angles))
        return [*frames[1:], frames[-1] @ self.tool]

    def write(self, folder: Path) -> Path:
        """Its files into a folder; the path of the arm's."""
        for name, text in self.files.items():
            (folder / name).write_text(text, encoding="utf-8")
        return folder / FILE

    def resting(self, rest_deg: list[float]) -> "DrawnArm":
        """The same arm with another rest pose."""
        told = yaml.safe_load(self.files[FILE])
        for joint, rest in zip(told["joints"], rest_deg, strict=False):
            joint["rest_deg"] = rest
        files = self.files | {FILE: yaml.safe_dump(told, sort_keys=False)}
        return DrawnArm(self.kind, files, self.links, self.tool, self.limits_rad)


def drawn(seed: int, number: int) -> DrawnArm:
    """The arm of that number."""
    rng = np.random.default_rng((seed, number, 31))
    shape, kind = ALWAYS[number] if number < len(ALWAYS) else ("", KINDS[int(rng.integers(2))])
    shape = shape or str(rng.choice(TABLES if kind == "dh" else URDFS))
    limits_deg = np.array([_limits(letter, rng) for letter in shape])
    lengths = _lengths(shape, rng)
    if kind == "dh":
        robot, links, tool = _table(shape, lengths, rng)
        files = {}
    else:
        askew = bool(rng.random() < 0.5)
        robot = {"urdf": URDF, "tool": "tool_link"}
        links, tool = _frames(shape, lengths, rng, askew)
        files = {URDF: _urdf(links, tool, limits_deg)}
        kind = "urdf, askew" if askew else kind
    joints = _joints(limits_deg, rng, named=kind == "dh")
    told: dict[str, Any] = {"arm_id": f"drawn-{number}", "robot": robot, "link_radius_m": 0.015, "joints": joints}
    if rng.random() < 0.5:
        told["gripper"] = {
            "servo_id": int(max(j["servo_id"] for j in joints)) + 1,
            "open_tick": 400,
            "closed_tick": 600,
        }
    files[FILE] = yaml.safe_dump(told, sort_keys=False)
    return DrawnArm(f"{shape}, {kind}", files, links, tool, np.radians(limits_deg))


def turned(axis: FloatArray, angles: FloatArray) -> FloatArray:
    """Rotations about a unit vector (Rodrigues), shape (m, 4, 4)."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    T = np.tile(np.eye(4), (len(angles), 1, 1))
    T[:, :3, :3] += np.sin(angles)[:, None, None] * K + (1.0 - np.cos(angles))[:, None, None] * (K @ K)
    return T


def _limits(letter: str, rng: np.random.Generator) -> tuple[float, float]:
    most = LIMITS_DEG[letter]
    low, high = most * (1.0 - rng.uniform(0.0, NARROWER, 2))
    return -round(float(low), 1), round(float(high), 1)


def _lengths(shape: str, rng: np.random.Generator) -> FloatArray:
    """Of what follows each joint but the waist [m]; the last ends at the tool."""
    shares = rng.uniform(0.6, 1.4, len(shape) - 1) * np.where(np.array(list(shape[1:])) == "r", 0.6, 1.0)
    return np.asarray(np.maximum(LEAST_M, rng.uniform(*REACH_M) * shares / shares.sum()))


def _joints(limits_deg: FloatArray, rng: np.random.Generator, *, named: bool) -> list[dict[str, Any]]:
    """Servos in any order and mounted either way; limits where the links do not have them."""
    ids = rng.permutation(len(limits_deg)) + 1
    joints = []
    for i, (low, high) in enumerate(limits_deg.tolist()):
        direction = int(rng.choice((-1, 1)))
        ends = sorted((-direction * low / TICK_DEG, -direction * high / TICK_DEG))
        zero = rng.uniform(math.ceil(ends[1]), math.floor(TICK_MAX + ends[0]))
        told = {
            "name": f"joint{i + 1}",
            "servo_id": int(ids[i]),
            "direction": direction,
            "zero_tick": round(float(zero), 2),
        }
        joints.append(told | ({"limits_deg": [low, high]} if named else {}))
    return joints


# ---------------------------------------------------------------------------------------------------------- a table


def _table(shape: str, lengths: FloatArray, rng: np.random.Generator) -> tuple[dict[str, Any], Any, FloatArray]:
    """A table of Denavit and Hartenberg, of either convention, and the same as frames and axes."""
    height, forward = float(rng.uniform(*HEIGHT_M)), float(rng.uniform(0.0, FORWARD_M))
    standard, rolls = bool(rng.random() < 0.5), shape.endswith("r")
    links = [round(float(length), 4) for length in lengths]
    # Links that lie along x of a pitch joint's frame; a rolling hand takes the last two together, along its z.
    along = [*links[:-2], 0.0] if rolls else links
    rows: list[dict[str, float]] = [{"d_m": round(height, 4)}, *({} for _ in along)]
    rows[1]["theta_deg"] = 90
    if standard:
        rows[0] |= {"a_m": round(forward, 4), "alpha_deg": 90}
        for row, length in zip(rows[1:], along, strict=True):
            row["a_m"] = length
        if rolls:
            rows[-1] |= {"alpha_deg": 90, "theta_deg": rows[-1].get("theta_deg", 0) + 90}
    else:
        rows[1] |= {"a_m": round(forward, 4), "alpha_deg": 90}
        for row, length in zip(rows[2:], along, strict=False):
            row["a_m"] = length
        if rolls:
            rows[-1]["theta_deg"] = rows[-1].get("theta_deg", 0) + 90
    if rolls:
        rows.append({"d_m": round(sum(links[-2:]), 4)} | ({} if standard else {"alpha_deg": 90}))
    tool_m = [0.0 if standard or rolls else along[-1], 0.0, 0.0]
    robot = {"convention": "standard" if standard else "modified", "dh": rows, "tool_m": tool_m}
    frames, after = [], np.eye(4)
    for row in rows:
        turn = along_z(row.get("theta_deg", 0.0), row.get("d_m", 0.0))
        twist = along_x(row.get("alpha_deg", 0.0), row.get("a_m", 0.0))
        frames.append((after @ turn if standard else twist @ turn, np.array([0.0, 0.0, 1.0])))
        after = twist if standard else np.eye(4)
    after[:3, 3] += tool_m
    return robot, tuple(frames), after


def along_z(deg: float, along_m: float) -> FloatArray:
    T = turned(np.array([0.0, 0.0, 1.0]), np.radians([deg]))[0]
    T[2, 3] = along_m
    return np.asarray(T)


def along_x(deg: float, along_m: float) -> FloatArray:
    T = turned(np.array([1.0, 0.0, 0.0]), np.radians([deg]))[0]
    T[0, 3] = along_m
    return np.asarray(T)


# ----------------------------------------------------------------------------------------------------------- a URDF


def _frames(
    shape: str, lengths: FloatArray, rng: np.random.Generator, askew: bool
) -> tuple[tuple[tuple[FloatArray, FloatArray], ...], FloatArray]:
    """Frames turned anyhow, in which the axes are what the shape says, or a little askew."""
    axes = {"w": np.array([0.0, 0.0, 1.0]), "p": np.array([0.0, 1.0, 0.0]), "r": np.array([0.0, 0.0, 1.0])}
    place, before, links = np.zeros(3), np.eye(4), []
    steps = [0.0, rng.uniform(*HEIGHT_M), *lengths]
    for i, letter in enumerate(shape):
        aside = rng.uniform(-ASIDE_M, ASIDE_M) if i > 3 or (i == 3 and askew) else 0.0
        place = place + np.array([rng.uniform(0.0, FORWARD_M) if i == 1 else 0.0, aside, steps[i]])
        axis = axes[letter] * rng.choice((-1.0, 1.0))
        if askew:
            axis = axis + rng.uniform(-1.0, 1.0, 3) * math.sin(ASKEW_RAD) / 2.0
            axis = axis / np.linalg.norm(axis)
        frame = np.eye(4)
        frame[:3, :3] = _any_rotation(rng)
        frame[:3, 3] = place
        links.append((np.linalg.inv(before) @ frame, frame[:3, :3].T @ axis))
        before = frame
    tool = np.eye(4)
    tool[:3, 3] = place + np.array([0.0, 0.0, steps[-1]])
    return tuple(links), np.linalg.inv(before) @ tool


def _any_rotation(rng: np.random.Generator) -> FloatArray:
    """Half of them upright, since most people's are."""
    if rng.random() < 0.5:
        return np.eye(3)
    Q, R = np.linalg.qr(rng.standard_normal((3, 3)))
    Q = Q * np.sign(np.diag(R))
    return np.asarray(Q * np.linalg.det(Q))


def _urdf(links: tuple[tuple[FloatArray, FloatArray], ...], tool: FloatArray, limits_deg: FloatArray) -> str:
    """With what a chain has beside it: a camera, and fingers that slide."""
    names = ["base_link", *(f"link{i + 1}" for i in range(len(links))), "tool_link", "camera", "left", "right"]
    text = [f'<link name="{name}"/>' for name in names]
    for i, ((frame, axis), (low, high)) in enumerate(zip(links, np.radians(limits_deg), strict=True)):
        turn = f'<axis xyz="{_told(axis)}"/><limit lower="{low:.17g}" upper="{high:.17g}" effort="1.5" velocity="6"/>'
        text.append(_joint(f"joint{i + 1}", "revolute", names[i], names[i + 1], frame, turn))
    text.append(_joint("tool", "fixed", names[len(links)], "tool_link", tool))
    text.append(_joint("eye", "fixed", "link1", "camera", np.eye(4)))
    slide = '<axis xyz="0 1 0"/><limit lower="0" upper="0.02" effort="1" velocity="1"/>'
    text.append(_joint("finger", "prismatic", "tool_link", "left", np.eye(4), slide))
    text.append(_joint("mirror", "prismatic", "tool_link", "right", np.eye(4), slide + '<mimic joint="finger"/>'))
    return "\n".join(['<robot name="drawn">', *text, "</robot>"])


def _joint(name: str, kind: str, parent: str, child: str, frame: FloatArray, more: str = "") -> str:
    R = frame[:3, :3]
    pitch = math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0]))
    rpy = np.array([math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])])
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{_told(frame[:3, 3])}" rpy="{_told(rpy)}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{more}</joint>'


def _told(numbers: FloatArray) -> str:
    return " ".join(f"{number:.17g}" for number in numbers)
