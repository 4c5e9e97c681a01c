"""A URDF, read: the chain from its root to a tool link as the table of an arm's file.

Rules.
1. Only what lies between root and tool counts; fingers and cameras beside it may be anything.
2. A joint of the chain turns: `revolute` or `continuous`. Fixed ones are taken into the next row.
3. A frame of the table stands where the URDF has the joint, and its z is the joint's axis. The base frame is the root
   link's, whichever way the arm stands or hangs; the base column begins at the link that carries the first joint that
   turns.
4. The text is data: no entities, nothing is fetched or run. Masses and shapes are not read.
"""

import math
from functools import partial
from typing import Any, NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from armctl.errors import ConfigError
from armctl.kinematics.chain import DHRow
from armctl.kinematics.robots.table import row_of
from armctl.kinematics.transform import FloatArray, pose_from_xyz_rpy, rpy_from_matrix
from armctl.links import LONGEST_LINK_M

MOST_BYTES = 2**20
TURNING = ("revolute", "continuous")
# Origins that are as long as this in all are not in metres.
MM = 0.001


class UrdfChain(NamedTuple):
    """What a URDF says of a chain."""

    # For `robot` of an arm's file, see `ChainTable`.
    table: dict[str, Any]
    joint_names: tuple[str, ...]
    # Lowest and highest position of each joint, None where it has none.
    limits_deg: tuple[tuple[float, float] | None, ...]
    # Files of shapes, each with the link that names it.
    meshes: tuple[tuple[str, str], ...]


def read(text: str, tool: str, file: str) -> UrdfChain:
    """The chain from the root to the link `tool`.

    Args:
        file: Its name, for errors.
    Raises:
        ConfigError: not a URDF, or its chain is none that servos can turn; names the joint or link and what to do.
    """
    return _Reader(text, file).chain(tool)


class _Reader:
    """One URDF; what is wrong with it is told with the file's name."""

    def __init__(self, text: str, file: str) -> None:
        self._wrong = partial(ConfigError, file)
        if len(text) > MOST_BYTES:
            raise self._wrong("", f"larger than {MOST_BYTES} characters", "give a URDF without embedded meshes")
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise self._wrong("", "has a DOCTYPE or entities, which are not read", "remove them")
        try:
            self._root = root = ElementTree.fromstring(text)
        except (ElementTree.ParseError, ValueError) as error:
            raise self._wrong("", f"not XML: {error}", "check it with `check_urdf`") from None
        if root.tag != "robot":
            raise self._wrong(f"<{root.tag}>", "a URDF begins with <robot>", "give a URDF; expand a xacro first")
        if any("xacro" in element.tag for element in root.iter()):
            raise self._wrong("xacro", "has macros", "name it .xacro, or expand it: xacro FILE > arm.urdf")

    def chain(self, tool: str) -> UrdfChain:
        rows: list[DHRow] = []
        names, limits = [], []
        # From the frame of the last row to the joint that comes next.
        G = np.eye(4)
        base_m = G[:3, 3]
        for joint in self._path(tool):
            base_m = base_m if rows else G[:3, 3]
            G = G @ self._origin(joint)
            if joint.get("type") == "fixed":
                continue
            turn = _onto(self._axis(joint))
            G[:3, :3] = G[:3, :3] @ turn
            rows.append(row_of(G[:3, :3], G[:3, 3]))
            names.append(str(joint.get("name")))
            limits.append(self._limits_deg(joint))
            G = np.eye(4)
            G[:3, :3] = turn.T
        if not rows:
            raise self._wrong(f"link {tool}", "no joint turns between the root and this link", "name the tool's link")
        table = {
            "convention": "modified",
            "dh": [table_row(row) for row in rows],
            "tool_m": G[:3, 3].round(12).tolist(),
            "base_m": base_m.round(12).tolist(),
            "tool_rpy_deg": [math.degrees(angle) for angle in rpy_from_matrix(G[:3, :3])],
        }
        shapes = ((link, mesh) for link in self._root.findall("link") for mesh in link.iter("mesh"))
        meshes = tuple((str(link.get("name")), str(mesh.get("filename", ""))) for link, mesh in shapes)
        return UrdfChain(table, tuple(names), tuple(limits), meshes)

    def _path(self, tool: str) -> list[Element]:
        """The joints from the root to the tool link."""
        above: dict[str, Element] = {}
        for joint in self._root.findall("joint"):
            name, child = joint.get("name"), self._link(joint, "child")
            self._link(joint, "parent")
            if child in above:
                text = f"has two parents, joints {above[child].get('name')} and {name}: a loop"
                raise self._wrong(f"link {child}", text, "an arm is a chain: remove one of the joints")
            above[child] = joint
        links = {str(link.get("name")) for link in self._root.findall("link")}
        if tool not in links:
            ends = sorted(links - {self._link(joint, "parent") for joint in above.values()})
            raise self._wrong(f"link {tool!r}", "no such link to be the tool", f"ends of chains: {', '.join(ends)}")
        path: list[Element] = []
        while tool in above:
            joint = above[tool]
            if joint in path:
                text = "the joints come back to where they began: a loop"
                raise self._wrong(f"joint {joint.get('name')}", text, "an arm is a chain: remove one of them")
            self._refuse(joint)
            path.insert(0, joint)
            tool = self._link(joint, "parent")
        return path

    def _refuse(self, joint: Element) -> None:
        """What no servo of the chain can do."""
        where, kind = f"joint {joint.get('name')}", joint.get("type")
        if kind not in (*TURNING, "fixed"):
            text = f"is {kind}; between base and tool joints turn or are fixed"
            raise self._wrong(where, text, "name a tool link before it, or describe it as a gripper")
        if (mimic := joint.find("mimic")) is not None:
            text = f"mimics {mimic.get('joint')}; a joint of the chain has a servo of its own"
            raise self._wrong(where, text, "remove the mimic, or name a tool link before it")

    def _link(self, joint: Element, end: str) -> str:
        found = joint.find(end)
        if found is None or not found.get("link"):
            raise self._wrong(f"joint {joint.get('name')}", f"names no {end} link", f'add <{end} link="..."/>')
        return str(found.get("link"))

    def _numbers(self, text: str, count: int, where: str) -> list[float]:
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            values = []
        if len(values) != count or not all(map(math.isfinite, values)):
            raise self._wrong(where, f"{text!r} is not {count} finite numbers", "correct it")
        return values

    def _origin(self, joint: Element) -> FloatArray:
        """Pose of the joint in its parent's frame, shape (4, 4)."""
        where, origin = f"joint {joint.get('name')}: origin", joint.find("origin")
        told = {} if origin is None else origin.attrib
        xyz, rpy = (self._numbers(told.get(key, "0 0 0"), 3, f"{where} {key}") for key in ("xyz", "rpy"))
        if max(map(abs, xyz)) > LONGEST_LINK_M:
            text = f"{max(xyz, key=abs):g} m from its parent, at most {LONGEST_LINK_M:g} m make sense"
            raise self._wrong(f"{where} xyz", text, f"a URDF is in metres: if these are mm, multiply by {MM:g}")
        return pose_from_xyz_rpy(*xyz, *rpy)

    def _axis(self, joint: Element) -> FloatArray:
        """Unit vector of the joint's axis in its own frame."""
        axis, where = joint.find("axis"), f"joint {joint.get('name')}: axis"
        vector = np.array(self._numbers("1 0 0" if axis is None else axis.get("xyz", "1 0 0"), 3, where))
        length = float(np.linalg.norm(vector))
        if not length > 1e-6:
            raise self._wrong(where, "has no direction", 'give a unit vector, such as xyz="0 0 1"')
        return np.asarray(vector / length)

    def _limits_deg(self, joint: Element) -> tuple[float, float] | None:
        limit, where = joint.find("limit"), f"joint {joint.get('name')}: limit"
        if limit is None or joint.get("type") == "continuous":
            return None
        lower, upper = (self._numbers(limit.get(end, "0"), 1, where)[0] for end in ("lower", "upper"))
        if lower >= upper:
            raise self._wrong(where, f"lower {lower:g} is not below upper {upper:g} rad", "exchange them")
        return math.degrees(lower), math.degrees(upper)


def _onto(axis: FloatArray) -> FloatArray:
    """The rotation, shape (3, 3), that takes z to a unit vector: exact for the axes of a frame."""
    x, y, z = axis.tolist()
    level = math.hypot(x, y)
    if level < 1e-12:
        return np.diag([1.0, -1.0, -1.0]) if z < 0.0 else np.eye(3)
    across = np.array([-y / level, x / level, 0.0])
    return np.stack([np.cross(across, axis), across, axis], axis=1)


def table_row(row: DHRow) -> dict[str, Any]:
    """A row as an arm's file has it, without what is 0."""
    lengths = {"a_m": round(row.a, 12), "b_m": round(row.b, 12), "d_m": round(row.d, 12)}
    angles = {"alpha_deg": row.alpha, "beta_deg": row.beta, "theta_deg": row.offset, "bend_deg_m": row.bend}
    told = lengths | {key: math.degrees(angle) for key, angle in angles.items()}
    waves = {"waves_deg": [math.degrees(share) for share in row.waves]} if any(row.waves) else {}
    return {key: value for key, value in told.items() if value != 0.0} | waves
