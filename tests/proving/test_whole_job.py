"""The proof of arms: a small one for real, defects that it must see, and what it draws."""

from typing import Any

import numpy as np
import pytest
import yaml

from armctl.errors import RequestRefused
from proving import whole_job
from proving.drawn_arms import ALWAYS, FILE, DrawnArm, drawn, turned
from proving.hosted_arm import HostedArm
from proving.whole_job import STEPS

SEED = 1


def proved(arms: int = 1) -> dict[str, Any]:
    return whole_job.prove(SEED, lambda _: None, arms=arms, workers=1)


def test_three_joints_of_which_there_is_but_a_table_do_the_whole_job() -> None:
    result = proved()
    assert (result["runs"], result["violations"], result["seed"]) == (1, [], SEED)
    [arm] = result["arms"]
    assert (arm["arm"], arm["held"]) == ("wpp, dh", list(STEPS))
    assert 0.0 < arm["run mean"] < whole_job.RUN_MM[0]


def test_a_tool_that_stands_elsewhere_than_the_file_says_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    pose = DrawnArm.tool_pose
    aside = np.array([[0.0, 0.0, 0.0, 1e-6], *np.zeros((3, 4))])
    monkeypatch.setattr(DrawnArm, "tool_pose", lambda arm, q: pose(arm, q) + aside)
    [violation] = proved()["violations"]
    assert "arm 0 (wpp, dh): file: the tool is off by 1e-06" in violation


def test_an_arm_that_goes_elsewhere_than_it_was_sent_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    asks = HostedArm.ask

    async def aside(arm: HostedArm, method: str, **params: Any) -> dict[str, Any]:
        if method == "move":
            x, y, z = params["point_m"]
            params["point_m"] = (x, y + 0.006, z)
        return await asks(arm, method, **params)

    monkeypatch.setattr(HostedArm, "ask", aside)
    violations = proved()["violations"]
    assert violations
    assert all("move: move" in one for one in violations)


@pytest.mark.parametrize(("code", "counts"), [("TOO_HEAVY", True), ("NO_ANSWER", False)])
def test_a_refused_line_is_drawn_again_and_told_but_nothing_else_is(
    monkeypatch: pytest.MonkeyPatch, code: str, counts: bool
) -> None:
    async def refuses(arm: HostedArm, method: str, **params: Any) -> dict[str, Any]:
        raise RequestRefused(code, "made up")

    monkeypatch.setattr(HostedArm, "ask", refuses)
    monkeypatch.setattr(whole_job, "MOST_REFUSED", 2)
    result = proved()
    assert result["arms"][0]["refused"] == (["teach: TOO_HEAVY"] * 2 if counts else [])
    [violation] = result["violations"]
    assert ("2 lines refused, the last: made up" if counts else "teach: NO_ANSWER: made up") in violation


def test_every_length_of_chain_is_drawn_as_table_and_urdf_and_each_by_its_number_alone() -> None:
    arms = [drawn(SEED, number) for number in range(40)]
    assert {arm.n for arm in arms} == {3, 4, 5, 6, 7}
    assert {arm.kind.partition(", ")[2] for arm in arms} == {"dh", "urdf", "urdf, askew"}
    assert [arm.kind.split(", ")[:2] for arm in arms[:3]] == [list(pair) for pair in ALWAYS]
    assert len({arm.files[FILE] for arm in arms}) == len(arms)
    assert drawn(SEED, 7).files == arms[7].files
    for arm in arms:
        assert ("gripper" in (told := yaml.safe_load(arm.files[FILE]))) is (len(told) == 5)
        # Straight up, at zero, but for offsets.
        [place] = arm.tool_m(np.zeros((1, arm.n)))
        assert place[2] > 0.25
        assert np.hypot(place[0], place[1]) < 0.08


def test_a_turn_is_about_its_axis_by_its_angle() -> None:
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    R = turned(axis, np.array([0.7]))[0, :3, :3]
    np.testing.assert_allclose(R @ axis, axis, atol=1e-15)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    assert np.trace(R) == pytest.approx(1.0 + 2.0 * np.cos(0.7))
