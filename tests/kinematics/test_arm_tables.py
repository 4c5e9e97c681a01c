"""An arm's own table or URDF: its frames, its closed form by structure alone, and what is wrong with a bad one."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.commissioning.arm_file import judged, whole_text
from armctl.config import ArmConfig
from armctl.errors import ConfigError
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import DHRow, SerialChain, forward_kinematics, joint_axes
from armctl.kinematics.robots.table import row_of
from armctl.kinematics.structure import closed_form
from armctl.kinematics.transform import FloatArray, matrix_from_rpy, pose_from_xyz_rpy
from armctl.kinematics.urdf import urdf
from armctl.trajectory.collision import link_points
from armctl.trajectory.preflight import DrivenArm, preflight_motion
from tests.kinematics.conftest import assert_at, rngs, turned
from tests.mounted import MOUNTED, mounted, mounted_urdf

pinocchio = pytest.importorskip("pinocchio")
BAD: dict[str, Any] = yaml.safe_load(Path(__file__).with_name("bad_arms.yaml").read_text(encoding="utf-8"))
OWN = ("crane-plus-v2", "crustcrawler", "phantomx-pincher", "phantomx-reactor")
# A name that says where things are, so that a test can replace it.
GOOD = yaml.safe_dump(BAD["good"])


def pinocchio_tool(text: str, q: FloatArray, tool: str) -> FloatArray:
    """Tool poses of a URDF by pinocchio, shape (m, 4, 4)."""
    model = pinocchio.buildModelFromXML(text)
    data, frame = model.createData(), model.getFrameId(tool)
    found = []
    for one in q:
        pinocchio.framesForwardKinematics(model, data, one)
        found.append(data.oMf[frame].homogeneous.copy())
    return np.array(found)


def random_urdf(rng: np.random.Generator, joints: int) -> str:
    """Joints anywhere, about any axis, with fixed links between them."""

    def number(size: int, low: float) -> str:
        return " ".join(f"{x:.17g}" for x in rng.uniform(low, -low, size))

    links = [f'<link name="l{i}"/>' for i in range(2 * joints + 1)]
    moves = []
    for i in range(2 * joints):
        place = f'<origin xyz="{number(3, -0.2)}" rpy="{number(3, -3.0)}"/>'
        square = rng.choice(["0 0 1", "0 -1 0", "1 0 0", "0 0 -1"]) if rng.random() < 0.5 else number(3, -1.0)
        kind = f'type="revolute"><axis xyz="{square}"/><limit lower="-2" upper="2" effort="1" velocity="1"/>'
        kind = kind if i % 2 == 0 else 'type="fixed">'
        moves.append(f'<joint name="j{i}" {kind}{place}<parent link="l{i}"/><child link="l{i + 1}"/></joint>')
    return f'<robot name="any">{"".join(links + moves)}</robot>'


def written(folder: Path, joints: int, text: str, tool: str) -> ArmConfig:
    """An arm of a URDF, by its files."""
    (folder / "any.urdf").write_text(text)
    told = {
        "arm_id": "any",
        "robot": {"urdf": "any.urdf", "tool": tool},
        "joints": [{"name": f"j{2 * i}", "servo_id": i + 1} for i in range(joints)],
    }
    (folder / "any.yaml").write_text(yaml.safe_dump(told))
    return load_arm(str(folder / "any.yaml"))


@given(st.integers(1, 7), rngs)
@settings(max_examples=25, deadline=None)
def test_any_urdf_gives_the_tool_where_pinocchio_has_it(
    tmp_path_factory: pytest.TempPathFactory, joints: int, rng: np.random.Generator
) -> None:
    text = random_urdf(rng, joints)
    arm = written(tmp_path_factory.mktemp("any"), joints, text, f"l{2 * joints}")
    q = rng.uniform(-2.0, 2.0, (50, joints))
    ours = forward_kinematics(robots.of(arm).chain, q)
    np.testing.assert_allclose(ours, pinocchio_tool(text, q, f"l{2 * joints}"), atol=1e-12)
    assert arm.joints[0].limits_deg == pytest.approx((math.degrees(-2.0), math.degrees(2.0)))


@pytest.mark.parametrize("name", OWN)
def test_a_shipped_arm_is_where_pinocchio_has_its_urdf(name: str) -> None:
    arm = load_arm(name)
    robot = robots.of(arm)
    low, high = robot.limits_rad.T
    q = np.random.default_rng(1).uniform(low, high, (10_000, robot.chain.n))
    whole = np.hstack([q, np.zeros((len(q), len(arm.joints) - robot.chain.n))])
    found = pinocchio_tool(urdf(arm, robot), whole, "tool")
    np.testing.assert_allclose(forward_kinematics(robot.chain, q), found, atol=1e-9)
    # Straight up at zero, by the sums of the lengths that their makers publish.
    place = {
        "crane-plus-v2": (0.0, 0.0454 + 0.026 + 0.083 + 0.0935 + 0.121),
        "crustcrawler": (0.0796 + 0.023, 0.025 + 0.0445 + 0.1815 + 0.07 + 0.0415),
        "phantomx-pincher": (0.0, 0.019 + 0.0415 + 0.324),
        "phantomx-reactor": (0.0385, 0.081 + 0.0265 + 0.1445 + 0.1535 + 0.071 + 0.0702),
    }[name]
    zero = forward_kinematics(robot.chain, np.zeros(robot.chain.n))
    np.testing.assert_allclose(zero, pose_from_xyz_rpy(place[0], 0.0, place[1]), atol=1e-4)


@pytest.mark.parametrize("name", MOUNTED)
def test_an_arm_that_hangs_or_stands_elsewhere_is_where_pinocchio_has_its_urdf(name: str, tmp_path: Path) -> None:
    """Its base frame is the root link's. Its base column is judged where it is, not from the root link to the arm."""
    path = mounted(tmp_path, name)
    arm = load_arm(path)
    robot, text = robots.of(arm), mounted_urdf(name)
    low, high = robot.limits_rad.T
    q = np.random.default_rng(1).uniform(low, high, (10_000, robot.chain.n))
    np.testing.assert_allclose(forward_kinematics(robot.chain, q), pinocchio_tool(text, q, "tool"), atol=1e-9)
    links = ("base", "column", "upper", "fore", "wrist_link", "tool")
    ends = [pinocchio_tool(text, q[:1], link)[0, :3, 3] for link in links]
    np.testing.assert_allclose(link_points(robot.chain, q[0]), ends, atol=1e-9)
    assert judged(path).ok
    # Stretched straight away from what it is mounted on, and along the root's axes.
    straight = forward_kinematics(robot.chain, np.zeros(4))[:3, 3]
    there = (0.0, 0.0, 0.5 - 0.402) if name == "hanging" else (0.6, -0.4, 0.02 + 0.402)
    np.testing.assert_allclose(straight, there, atol=1e-12)
    assert preflight_motion(np.zeros((2, 4)), DrivenArm(arm, robot, 0.1)) == ()


def moved(chain: SerialChain, rng: np.random.Generator) -> SerialChain:
    """The same arm in other words: elsewhere, with other zeros, directions, frames and another rotation of its tool."""
    zeros, signs = rng.uniform(-3.0, 3.0, chain.n), rng.choice((-1.0, 1.0), chain.n)
    axes, _ = joint_axes(chain, zeros[None])
    B = pose_from_xyz_rpy(*rng.uniform(-0.3, 0.3, 3), *rng.uniform(-3.0, 3.0, 3))
    before, rows = np.eye(4), []
    for (z, place), sign in zip(axes, signs, strict=True):
        axis = B[:3, :3] @ z[:, 0] * sign
        side = np.cross(axis, rng.standard_normal(3))
        frame = np.eye(4)
        frame[:3, 0], frame[:3, 2] = side / np.linalg.norm(side), axis
        frame[:3, 1] = np.cross(axis, frame[:3, 0])
        frame[:3, 3] = B[:3, :3] @ place[:, 0] + B[:3, 3] + axis * rng.uniform(-0.2, 0.2)
        G = np.linalg.inv(before) @ frame
        rows.append(row_of(G[:3, :3], G[:3, 3]))
        before = frame
    G = np.linalg.inv(before) @ B @ forward_kinematics(chain, zeros)
    tool = row_of(G[:3, :3] @ matrix_from_rpy(*rng.uniform(-3.0, 3.0, 3)), G[:3, 3])
    return SerialChain(tuple(rows), "modified", tool=tool)


@given(st.sampled_from(robots.names()), rngs)
@settings(max_examples=60, deadline=None)
def test_an_arm_has_its_closed_form_in_whatever_words_it_is_described(name: str, rng: np.random.Generator) -> None:
    chain = moved(robots.get(name).chain, rng)
    form = closed_form(chain)
    assert form is not None
    q = rng.uniform(-2.0, 2.0, chain.n)
    T = forward_kinematics(chain, q)
    found = form.poses(T[None])[0]
    found = found[np.isfinite(found).all(axis=1)]
    assert_at(chain, found, T)
    if chain.n != 5 or name == "xiang-6dof":  # four links leave an angle free
        assert turned(found, q).min() < 1e-6
    points = form.positions(T[None, :3, 3])[0].reshape(-1, chain.n)
    points = points[np.isfinite(points).all(axis=1)][::50]
    np.testing.assert_allclose(
        forward_kinematics(chain, points)[:, :3, 3], np.tile(T[:3, 3], (len(points), 1)), atol=1e-9
    )


@given(rngs, st.integers(3, 7))
@settings(max_examples=30, deadline=None)
def test_an_arm_of_no_such_structure_is_taken_for_none(rng: np.random.Generator, joints: int) -> None:
    rows = tuple(DHRow(*rng.uniform(-0.3, 0.3, 4)) for _ in range(joints))
    assert closed_form(SerialChain(rows, "modified")) is None


@pytest.mark.parametrize("bad", BAD["files"], ids=lambda bad: str(bad["says"]))
def test_a_bad_arm_is_refused_in_a_sentence_with_place_and_remedy(bad: dict[str, Any], tmp_path: Path) -> None:
    arm, links = GOOD, BAD["urdf"]
    for old, new in bad.get("arm", {}).items():
        assert old in arm
        arm = arm.replace(old, new)
    for old, new in bad.get("urdf", {}).items():
        assert old in links
        links = links.replace(old, new.replace("LONG", "long" * 75))
    (tmp_path / "good.urdf").write_text(links)
    (tmp_path / "arm.yaml").write_text(arm)
    with pytest.raises(ConfigError) as refused:
        load_arm(str(tmp_path / "arm.yaml"))
    told = str(refused.value)
    assert bad["says"] in told
    assert told.startswith(str(tmp_path))
    for word in bad.get("and", ()):
        assert word in told


def test_an_arm_of_a_paper_keeps_the_limits_of_its_own_file() -> None:
    for name in ("ax12-line", "lanzhou-4dof", "transfer-6dof", "xiang-6dof"):
        arm = load_arm(name)
        narrow = {"joints": tuple(joint.model_copy(update={"limits_deg": (-9.0, 9.0)}) for joint in arm.joints)}
        robot = robots.of(arm.model_copy(update=narrow))
        assert (robot.name, robot.chain) == (name, robots.get(name, arm.lengths_m).chain)
        assert robot.ranges_deg == ((-9.0, 9.0),) * robot.chain.n


def test_the_good_one_is_taken(tmp_path: Path) -> None:
    (tmp_path / "good.urdf").write_text(BAD["urdf"])
    (tmp_path / "arm.yaml").write_text(GOOD)
    arm = load_arm(str(tmp_path / "arm.yaml"))
    assert [joint.name for joint in arm.joints] == ["waist", "shoulder", "elbow", "hand"]
    assert arm.gripper is not None
    assert arm.gripper.opening_mm(0.0) == 30.0
    assert arm.gripper.opening_mm(arm.joints[3].position_rad(700)) == pytest.approx(0.0)


@pytest.mark.parametrize("name", OWN)
def test_what_a_log_keeps_of_an_arm_is_the_whole_arm(name: str) -> None:
    arm = load_arm(name)
    again = ArmConfig.model_validate(arm.model_dump(mode="json"))
    assert again == arm
    assert again.calibration_hash == arm.calibration_hash
    assert robots.of(again).chain == robots.of(arm).chain


@pytest.mark.parametrize("name", OWN)
def test_an_arm_in_one_text_is_the_same_arm(name: str, tmp_path: Path) -> None:
    """A service has no URDF beside its copy."""
    (tmp_path / "copy.yaml").write_text(whole_text(name))
    assert load_arm(str(tmp_path / "copy.yaml")) == load_arm(name)
