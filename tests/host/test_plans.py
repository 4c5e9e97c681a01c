from pathlib import Path

import pytest

from armctl.errors import RequestRefused
from armctl.host import plans
from armctl.trajectory.plan import plan_to_text
from tests.host.doubles import refused
from tests.trajectory.test_plan import make_plan

PLAN = make_plan()


def test_a_plan_is_kept_and_never_overwritten(tmp_path: Path) -> None:
    plans.save(tmp_path / "plans", "line-via0", plan_to_text(PLAN))
    assert plans.load(tmp_path / "plans", "line-via0") == PLAN
    with refused("EXISTS", "exists"):
        plans.save(tmp_path / "plans", "line-via0", "other")
    assert plans.load(tmp_path / "plans", "line-via0") == PLAN


def test_the_list_leaves_out_what_is_no_plan(tmp_path: Path) -> None:
    plans.save(tmp_path, "good", plan_to_text(PLAN))
    (tmp_path / "bad.json").write_text("{")
    [found] = plans.listing(tmp_path)["plans"]
    assert (found["name"], found["via"], found["predicted_mean_error_mm"]) == ("good", 2, 0.2)
    assert plans.listing(tmp_path / "none") == {"plans": []}


def test_a_missing_plan_is_said_so(tmp_path: Path) -> None:
    for act in (plans.load, plans.delete):
        with pytest.raises(RequestRefused, match="no plan nothing"):
            act(tmp_path, "nothing")


@pytest.mark.parametrize("name", ["../plan", "", ".hidden", "a/b", "x" * 65])
def test_a_name_cannot_leave_the_folder(tmp_path: Path, name: str) -> None:
    with pytest.raises(RequestRefused, match="is no name"):
        plans.save(tmp_path, name, "x")
