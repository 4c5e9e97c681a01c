"""The URDF and the frames in it against the chain it is made from."""

import math
from xml.etree import ElementTree

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import DHRow, SerialChain, forward_kinematics, link_frames
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray, pose_from_xyz_rpy
from armctl.kinematics.urdf import BASE, TOOL, fixed_frames, moving_frames, moving_links, urdf
from tests.kinematics.conftest import screw

ARM = load_arm("ax12-line")
LINE = robots.get(ARM.robot)
ROWS = (
    DHRow(a=0.05, alpha=math.pi / 2, d=0.1, offset=0.3),
    DHRow(a=0.2, alpha=-0.7, d=-0.03),
    DHRow(a=0.0, alpha=-math.pi / 2, d=0.2, offset=-math.pi / 2),
    DHRow(a=0.1, alpha=math.pi, d=0.0),
    DHRow(a=-0.04, alpha=0.2, d=0.06, offset=1.0),
    DHRow(d=0.05),
)
MODIFIED = Robot("modified", "", {}, lambda _: SerialChain(ROWS, "modified"))
STANDARD = Robot("standard", "", {}, lambda _: SerialChain(ROWS, "standard"))
ANGLES = st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6).map(np.array)


def _transform(xyz: str, rpy: str) -> FloatArray:
    return pose_from_xyz_rpy(*map(float, xyz.split()), *map(float, rpy.split()))


def poses(text: str, q: dict[str, float]) -> dict[str, FloatArray]:
    """Pose of every link in the base frame, as a URDF reader computes them."""
    found = {BASE: np.eye(4)}
    for joint in ElementTree.fromstring(text).findall("joint"):
        parts = {part.tag: part.attrib for part in joint}
        T = found[parts["parent"]["link"]] @ _transform(**parts["origin"])
        if joint.attrib["type"] == "revolute":
            x, y, z = map(float, parts["axis"]["xyz"].split())
            T = T @ screw((x, y, z), q[joint.attrib["name"]])
        found[parts["child"]["link"]] = T
    return found


@given(st.sampled_from([LINE, MODIFIED, STANDARD]), ANGLES)
@settings(max_examples=90)
def test_urdf_link_frames_are_the_denavit_hartenberg_frames(robot: Robot, q: FloatArray) -> None:
    found = poses(urdf(ARM, robot), dict(zip(ARM.joint_names, q.tolist(), strict=True)))
    n = robot.chain.n
    moving = [*zip(moving_links(ARM)[:n], link_frames(robot.chain, q[:n])[1:], strict=True)]
    moving += zip(moving_links(ARM), moving_frames(ARM, robot, q), strict=True)
    for link, T in (*moving, (TOOL, forward_kinematics(robot.chain, q[:n]))):
        np.testing.assert_allclose(found[link], T, atol=1e-12)
    for parent, child, T in fixed_frames(ARM, robot):
        np.testing.assert_allclose(found[child], found[parent] @ T, atol=1e-12)


def test_every_link_has_a_frame_in_tf_or_tf_static() -> None:
    links = {link.attrib["name"] for link in ElementTree.fromstring(urdf(ARM, LINE)).findall("link")}
    assert links == {BASE, *moving_links(ARM), *(child for _, child, _ in fixed_frames(ARM, LINE))}


def test_joints_have_the_names_and_limits_of_the_calibration() -> None:
    joints = [j for j in ElementTree.fromstring(urdf(ARM, LINE)).findall("joint") if j.attrib["type"] == "revolute"]
    assert tuple(joint.attrib["name"] for joint in joints) == ARM.joint_names
    for joint, config in zip(joints, ARM.joints, strict=True):
        (limit,) = (part.attrib for part in joint.findall("limit"))
        assert (float(limit["lower"]), float(limit["upper"])) == config.limits_rad


def test_a_roll_beyond_the_chain_does_not_move_the_tool() -> None:
    text = urdf(ARM, LINE)
    q = dict.fromkeys(ARM.joint_names, 0.2)
    np.testing.assert_array_equal(poses(text, q)[TOOL], poses(text, {**q, "roll": 1.5})[TOOL])


def test_rods_reach_from_one_frame_to_the_next() -> None:
    text = urdf(ARM, LINE)
    found = poses(text, dict.fromkeys(ARM.joint_names, 0.4))
    for link in ElementTree.fromstring(text).findall("link"):
        horn = link.attrib["name"]
        for visual in link.findall("visual"):
            for cylinder in visual.findall("geometry/cylinder"):
                (origin,) = visual.findall("origin")
                T = found[horn] @ _transform(**origin.attrib)
                end = T @ [0.0, 0.0, float(cylinder.attrib["length"]) / 2.0, 1.0]
                np.testing.assert_allclose(end[:3], found[horn.replace("horn", "link")][:3, 3], atol=1e-12)
