"""The judge's own reading of arms, and that it shares no code with what it judges."""

import ast
import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from armctl.kinematics import robots
from armctl.sim.arm import SimulatedArm
from armctl.sim.faults import Fault, Faults
from armctl.trajectory.collision import link_points
from proving import reading
from proving.arms import SHIPPED, arm_of, arm_text, drawn, varied
from proving.episode import Episode
from proving.motions import MotionJudge
from proving.soak import drawn_by

TOOLS = Path(reading.__file__).parent
JUDGING = (
    "invariants",
    "goals",
    "torque",
    "standing",
    "shafts",
    "duties",
    "excuses",
    "evidence",
    "reading",
    "motions",
    "rules",
    "watch",
    "pairs",
    "readings",
)
# The simulated arm, on which all is judged: its planned faults, its servos, its line and its clock.
ALLOWED = {
    "armctl.sim.faults",
    "armctl.sim.arm",
    "armctl.sim.bus",
    "armctl.sim.gravity",
    "armctl.sim.loopback",
    "armctl.clock",
}


@pytest.mark.parametrize("module", JUDGING)
def test_what_judges_imports_the_simulator_and_nothing_else_of_the_package(module: str) -> None:
    tree = ast.parse((TOOLS / f"{module}.py").read_text())
    froms = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    assert {name for name in froms | names if name.startswith("armctl")} <= (ALLOWED if module == "watch" else
                                                                             {"armctl.sim.faults"})  # fmt: skip
    assert {name for name in froms if name.startswith("proving")} <= {f"proving.{other}" for other in JUDGING}


@pytest.mark.parametrize("episode", range(40))
def test_the_judge_and_the_package_read_the_same_arm(episode: int) -> None:
    text = drawn(7, episode)
    ours, theirs = reading.read(text), arm_of(text)
    assert (ours.floor_m, ours.temperature_limit_degC, ours.voltage_V) == (
        theirs.floor_m, theirs.temperature_limit_degC, theirs.voltage_V)  # fmt: skip
    for mine, joint in zip(ours.joints, theirs.joints, strict=True):
        assert (mine.name, mine.servo_id, mine.low, mine.high) == (joint.name, joint.servo_id, *joint.limits_tick)
        assert mine.rest_tick == pytest.approx(joint.tick(joint.rest_rad))
        assert mine.speed_deg_s == joint.speed_limit_deg_s
        assert 0 <= mine.low < mine.high <= 1023


def test_every_shipped_arm_has_its_turn_with_its_servos_any_way_round_and_their_ids_in_any_order() -> None:
    folder = Path(__file__).parents[2] / "calibration"
    # The soak does not play the first ones yet: one is a URDF, and both have grippers that turn differently. Those with
    # pairs it plays by their names.
    unplayed = {"crane-plus-v2", "phantomx-pincher", "crustcrawler", "phantomx-reactor"}
    assert {path.stem for path in folder.glob("*.yaml")} == {*SHIPPED, *unplayed}
    arms = [arm_of(drawn(1, episode)) for episode in range(40)]
    assert {arm.arm_id for arm in arms} == set(SHIPPED)
    joints = [joint for arm in arms for joint in arm.joints]
    assert {joint.direction for joint in joints} == {-1, 1}
    assert any(list(arm.servo_ids) != sorted(arm.servo_ids) for arm in arms)
    assert len({joint.zero_tick for joint in joints}) > 100


def test_a_variation_keeps_the_rest_pose_and_goes_beyond_no_limit() -> None:
    text = arm_text("xiang-6dof")
    before = arm_of(text)
    for number in range(30):
        after = arm_of(varied(text, np.random.default_rng(number)))
        for was, joint in zip(before.joints, after.joints, strict=True):
            assert joint.rest_deg == was.rest_deg
            assert was.limits_deg[0] <= joint.limits_deg[0] < joint.limits_deg[1] <= was.limits_deg[1]


@pytest.mark.parametrize("name", [*SHIPPED, "crustcrawler", "phantomx-reactor"])
def test_links_are_where_the_package_has_them(name: str) -> None:
    arm = arm_of(arm_text(name))
    chain = robots.get(arm.robot, arm.lengths_m).chain
    q = np.random.default_rng(1).uniform(-2.0, 2.0, (20, chain.n))
    ours = MotionJudge(reading.read(arm_text(name)), chain).points(q)
    np.testing.assert_allclose(ours, link_points(chain, q), atol=1e-12)


def judged(rows: list[list[float]], period_s: float = 2.0) -> str:
    arm = arm_of(arm_text("ax12-line"))
    judge = MotionJudge(reading.read(arm_text("ax12-line")), robots.get(arm.robot, arm.lengths_m).chain)
    return "; ".join(judge.against(np.radians(rows).tolist(), period_s))


UP = [0.0, 90.0, 0.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("rows", "period_s", "found"),
    [
        ([UP, [40.0, *UP[1:]], UP], 2.0, ""),
        ([UP, [150.0, *UP[1:]], UP], 9.0, "base goes from 0.0 to 150.0 deg (bounds -145 to 145)"),
        ([UP, [*UP[:5], 100.0], UP], 1.0, "roll turns at 100 deg/s (bound 60)"),
        ([UP, [0.0, 0.0, *UP[2:]], UP], 2.0, "its tool reaches"),
        ([UP, [0.0, -9.0, -40.0, 0.0, 0.0, 0.0], UP], 9.0, "below the floor"),
        ([UP, [0.0, 90.0, 140.0, 105.0, 0.0, 0.0], UP], 9.0, "into each other"),
    ],
)
def test_a_motion_is_judged_between_its_ends(rows: list[list[float]], period_s: float, found: str) -> None:
    said = judged(rows, period_s)
    assert found in said
    assert bool(found) == bool(said)


def test_what_is_not_finite_is_plainly_wrong() -> None:
    arm = arm_of(arm_text("ax12-line"))
    judge = MotionJudge(reading.read(arm_text("ax12-line")), robots.get(arm.robot, arm.lengths_m).chain)

    class Motion:
        period_s = 0.1
        positions_rad = ((0.0,) * 6, (math.nan,) * 6)

    assert judge.plainly_wrong(Motion()) == "not every number of it is finite"


def test_a_file_tells_all_that_is_left_out_by_what_the_manual_says() -> None:
    told = {"joints": [{"name": "a", "servo_id": 3, "limits_deg": [-10, 10]}]}
    arm = reading.read(yaml.safe_dump(told))
    assert (arm.floor_m, arm.temperature_limit_degC, arm.voltage_V, arm.link_radius_m) == (
        0.0,
        65.0,
        (9.0, 13.0),
        0.025,
    )
    assert (arm.joints[0].low, arm.joints[0].high, arm.joints[0].full_limit) == (478, 546, 1023)


@pytest.mark.parametrize("cut", [3, 4, 20])
def test_a_reply_behind_the_rest_of_a_broken_one_is_heard(cut: int) -> None:
    on, story = drawn_by(1, 0)
    watch = Episode(story, on).watch
    servo_id = on.arm.servo_ids[1]
    body = [servo_id, reading.STATUS_SIZE + 2, *range(reading.STATUS_SIZE + 1)]
    reply = bytes([0xFF, 0xFF, *body, ~sum(body) & 0xFF])
    watch.before(bytes([0xFF, 0xFF, servo_id, 4, reading.READ, reading.STATUS_BEGIN, 0, 0]), 10**9)
    watch.received += reply[:cut] + reply
    watch.hear(10**9)
    assert watch.replies[1].data == reply[5:-1]


@pytest.mark.parametrize("asked_ms", [0.0, 0.4])
@pytest.mark.parametrize("off_ms", [-1.2, -0.5, -0.3, 0.0, 0.3, 0.5, 0.7, 1.2])
@pytest.mark.parametrize("edge", ["begins", "ends"])
def test_a_reply_is_heard_where_the_world_did_not_echo_its_request(
    asked_ms: float, off_ms: float, edge: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It goes on in whole milliseconds, and an echo begins or ends with the next one."""
    on, story = drawn_by(1, 0)
    judge = (watch := Episode(story, on).watch)._judge
    begin_s = 1.0 + (asked_ms + off_ms) / 1e3 - (0.3 if edge == "ends" else 0.0)
    fault = Fault(kind="echo", begin_s=begin_s, duration_s=0.3)
    judge._duties.plan(fault)
    world = SimulatedArm(on.arm, faults=Faults())
    world.advance(1_000_000_000)
    world.faults.begin(fault, 0.0)
    monkeypatch.setattr(judge, "_told", told := dict[int, int]())
    servo_id, asked_ns = on.arm.servo_ids[1], 2_000_000_000 + round(asked_ms * 1e6)
    body = [servo_id, reading.STATUS_SIZE + 2, *range(reading.STATUS_SIZE + 1)]
    watch.before(bytes([0xFF, 0xFF, servo_id, 4, reading.READ, reading.STATUS_BEGIN, 0, 0]), asked_ns)
    watch.received += bytes([0xFF, 0xFF, *body, ~sum(body) & 0xFF])
    watch.hear(asked_ns + 900_000)
    world.advance(asked_ns)
    assert bool(told) is (world.faults.in_force("echo") is None)
