"""Arms of small URDFs that do not stand on the origin of their root link: one hangs, one stands beside it."""

import math
from pathlib import Path

import yaml

# Of each: where its base is on the root link, and its rest pose.
MOUNTED = {
    "hanging": (f'<origin xyz="0 0 0.5" rpy="{math.pi!r} 0 0"/>', (0, -50, -115, -40)),
    "beside": ('<origin xyz="0.6 -0.4 0.02" rpy="0 0 2.5"/>', (0, -60, -130, -60)),
}
LIMIT = '<limit lower="-{0}" upper="{0}" effort="1" velocity="1"/>'
# Name, height over the joint before, axis, farthest position of each.
JOINTS = (
    ("pan", 0.05, "0 0 1", 2.4),
    ("shoulder", 0.04, "0 1 0", 1.9),
    ("elbow", 0.106, "0 -1 0", 2.4),
    ("wrist", 0.106, "0 -1 0", 1.7),
)


def mounted_urdf(name: str) -> str:
    """The text of its URDF."""
    placed = [("mount", "fixed", MOUNTED[name][0])]
    for joint, high, axis, most in JOINTS:
        placed.append((joint, "revolute", f'<origin xyz="0 0 {high}"/><axis xyz="{axis}"/>{LIMIT.format(most)}'))
    placed.append(("hand", "fixed", '<origin xyz="0 0 0.1"/>'))
    links = ["world", "base", "column", "upper", "fore", "wrist_link", "tool"]
    text = "".join(f'<link name="{link}"/>' for link in links)
    for (joint, kind, told), parent, child in zip(placed, links, links[1:], strict=False):
        ends = f'<parent link="{parent}"/><child link="{child}"/>'
        text += f'<joint name="{joint}" type="{kind}">{ends}{told}</joint>'
    return f'<robot name="{name}">{text}</robot>'


def mounted(folder: Path, name: str) -> str:
    """The path of its file, written to a folder."""
    (folder / f"{name}.urdf").write_text(mounted_urdf(name), encoding="utf-8")
    joints = [
        {"name": joint, "servo_id": number, "rest_deg": rest_deg}
        for number, ((joint, *_), rest_deg) in enumerate(zip(JOINTS, MOUNTED[name][1], strict=True), start=1)
    ]
    told = {"arm_id": name, "robot": {"urdf": f"{name}.urdf", "tool": "tool"}, "joints": joints}
    (folder / f"{name}.yaml").write_text(yaml.safe_dump(told), encoding="utf-8")
    return str(folder / f"{name}.yaml")
