"""The kinematics commands: their JSON keys, and what wrong input gets."""

import math
from pathlib import Path

import numpy as np
import pytest

from armctl.files import find_arm_file
from armctl.kinematics import robots
from tests.cli.conftest import Answer, Typed
from tests.words import missing

POSE = "0.0968,-0.7558,0.0972,-2.7913,2.1047,-1.6016"


def test_robots_lists_the_five(answer: Answer) -> None:
    rows = answer("robots")["robots"]
    assert [row["name"] for row in rows] == list(robots.names())
    assert all(row.keys() == {"name", "joints", "convention", "source"} for row in rows)


def test_fk_gives_the_pose_of_degrees_and_of_changed_lengths(answer: Answer) -> None:
    found = answer("fk", "--robot", "lanzhou-4dof", "--q", "0,0,-90,90", "--deg")
    assert found.keys() == {"T", "position_m", "rpy_rad"}
    np.testing.assert_allclose(found["position_m"], [0.219, 0.042, 0.097], atol=1e-12)
    assert np.array(found["T"]).shape == (4, 4)
    longer = answer("fk", "--robot", "lanzhou-4dof", "--q", "0,0,-90,90", "--deg", "--set", "a5=0.2")
    assert longer["position_m"][0] == pytest.approx(0.286, abs=1e-12)


@pytest.mark.parametrize("method", ["closed", "numeric"])
def test_ik_answers_a_pose(method: str, answer: Answer) -> None:
    found = answer("ik", "--robot", "puma560", "--pose", POSE, "--all", "--method", method)
    assert found.keys() == {"reachable", "least_position_error_m", "solutions"}
    assert found["reachable"] is True
    assert len(found["solutions"]) == (8 if method == "closed" else 1)
    for one in found["solutions"]:
        assert one.keys() == {"q_rad", "position_error_m", "orientation_error_rad", "within_limits"}
        assert one["position_error_m"] < 1e-12
        back = answer("fk", "--robot", "puma560", "--q", ",".join(map(repr, one["q_rad"])))
        np.testing.assert_allclose(back["position_m"], [0.0968, -0.7558, 0.0972], atol=1e-12)


def test_ik_takes_a_matrix_as_it_takes_a_pose(answer: Answer) -> None:
    T = answer("fk", "--robot", "transfer-6dof", "--q", "0.1,-1,0.4,0.2,0.7,0.3")["T"]
    numbers = ",".join(repr(value) for row in T for value in row)
    found = answer("ik", "--robot", "transfer-6dof", "--T", numbers, "--near", "0.1,-1,0.4,0.2,0.7,0.3")
    np.testing.assert_allclose(found["solutions"][0]["q_rad"], [0.1, -1.0, 0.4, 0.2, 0.7, 0.3], atol=1e-12)


def test_ik_of_a_point_out_of_reach_says_so_with_the_distance(answer: Answer, typed: Typed) -> None:
    far = ("ik", "--robot", "xiang-6dof", "--xyz", "0.30,0.30,0.10")
    found = answer(*far)
    assert found["reachable"] is False
    assert found["least_position_error_m"] == pytest.approx(math.hypot(0.3, 0.3, 0.001) - 0.416, abs=1e-12)
    assert found["solutions"][0]["position_error_m"] == pytest.approx(found["least_position_error_m"], abs=1e-9)
    assert "out of reach by 8.26525 mm" in typed(*far).out


def test_jacobian_gives_rank_and_manipulability(answer: Answer) -> None:
    found = answer("jacobian", "--robot", "transfer-6dof", "--q", "0,-60,20,0,0,0", "--deg")
    assert (found["rank"], np.array(found["J"]).shape) == (5, (6, 6))
    assert found["manipulability"] < 1e-12


def test_workspace_and_trajectory_answer_and_draw(tmp_path: Path, answer: Answer) -> None:
    page = tmp_path / "page.html"
    found = answer("workspace", "--robot", "lanzhou-4dof", "--samples", "500", "--grid", "5", "--out", page)
    assert found["extent_m"].keys() == found["monte_carlo_extent_m"].keys() == {"x", "y", "z"}
    for axis in "xyz":
        (low, high), (inner_low, inner_high) = found["extent_m"][axis], found["monte_carlo_extent_m"][axis]
        assert low <= inner_low < inner_high <= high
    drawn = ("Workspace in 3D", "Projection on xy", "Projection on yz", "Reachability")
    assert not missing(page.read_text(encoding="utf-8"), *drawn)
    ends = ("--q0", "0,60,-30,0", "--q1", "60,45,-60,60", "--duration", "2", "--deg")
    found = answer("trajectory", "--robot", "lanzhou-4dof", *ends, "--samples", "11", "--out", page)
    keys = ("time_s", "position_rad", "velocity_rad_s", "acceleration_rad_s2", "tool_position_m")
    assert [len(found[key]) for key in keys] == [11] * 5
    np.testing.assert_allclose(np.degrees(found["position_rad"][-1]), [60, 45, -60, 60], atol=1e-9)
    np.testing.assert_allclose(found["velocity_rad_s"][-1], 0.0, atol=1e-12)
    assert "Tool acceleration" in page.read_text(encoding="utf-8")


def test_arms_lists_what_a_name_finds(answer: Answer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = tmp_path / "armctl" / "calibration"
    own.mkdir(parents=True)
    (own / "mine.yaml").write_text("# Mine, of spare parts. It is small.\narm_id: mine\nrobot: hal\njoints: []\n")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    found = {row["name"]: row for row in answer("arms")["arms"]}
    pincher = found["phantomx-pincher"]
    assert (pincher["joints"], pincher["servos"], pincher["gripper"], pincher["source"]) == (4, 5, "gripper", "shipped")
    assert (found["phantomx-reactor"]["joints"], found["phantomx-reactor"]["servos"]) == (4, 8)
    assert found["mine"]["title"].startswith("cannot be read: joints")
    assert found["mine"]["source"] == str(own)


@pytest.mark.parametrize("arm", ["ax12-line", "crane-plus-v2", "crustcrawler", "phantomx-pincher", "phantomx-reactor"])
def test_a_shipped_arm_is_judged_good_and_drawn(arm: str, answer: Answer) -> None:
    found = answer("arm", "check", arm)
    assert (found["ok"], found["problems"]) == (True, [])
    assert found["picture"].count("x") == 1


def test_every_problem_of_a_file_is_told_by_its_key(answer: Answer, tmp_path: Path) -> None:
    bad = tmp_path / "bad.yaml"
    bad.write_text("arm_id: bad\nrobot: {convention: craig, dh: [{a_m: 105}]}\njoints: [{name: a, servo_id: 300}]\n")
    found = answer("arm", "check", bad, status=1)
    keys = {problem["key"] for problem in found["problems"]}
    assert keys >= {"robot.convention", "robot.dh.0.a_m", "joints.0.servo_id", "joints.0.limits_deg"}
    assert (found["ok"], found["picture"]) == (False, "")


def test_an_arm_that_lies_in_the_floor_is_told(answer: Answer, tmp_path: Path) -> None:
    arm = tmp_path / "low.yaml"
    arm.write_text(find_arm_file("phantomx-pincher").read_text().replace("rest_deg: -60", "rest_deg: 120"))
    [problem, *_] = answer("arm", "check", arm, status=1)["problems"]
    assert problem["key"] == "joints.rest_deg"
    assert "mm in the floor" in problem["text"]


def test_kinematics_take_the_file_of_an_arm_for_a_robot(answer: Answer) -> None:
    up = answer("fk", "--robot", "phantomx-pincher", "--q", "0,0,0,0")
    by_file = answer("fk", "--robot", find_arm_file("phantomx-pincher"), "--q", "0,0,0,0")
    assert up == by_file
    assert up["position_m"] == pytest.approx([0.0, 0.0, 0.3845])
    found = answer("ik", "--robot", "crane-plus-v2", "--xyz", "0.15,0.05,0.1")
    assert found["reachable"]
    assert found["solutions"][0]["within_limits"]
