from pathlib import Path

import numpy as np
import pytest

from armctl.errors import ConfigError, RequestRefused
from armctl.kinematics.chain import tool_position
from armctl.lab import measured_tool
from armctl.recording.recordings import Recording
from tests.genetic import hand

CHAIN = hand.robot().chain


def recording(plan_s: tuple[float, float] | None = (1.0, 6.0)) -> Recording:
    q = np.column_stack([hand.joint_line(), np.zeros(65)])
    time_s = np.linspace(0.0, 6.4, 65)
    return Recording(
        "run", Path("run.mcap"), "a", "h", hand.arm().joint_names, 0, time_s, q, plan_s, True, 0.0 * time_s
    )


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_a_table_of_tool_points_is_read(tmp_path: Path) -> None:
    time_s, tool_m = measured_tool.read(write(tmp_path / "t.csv", "z_m,t_s,x_m,y_m,note\n3,0,1,2,a\n6,0.5,4,5,b\n"))
    np.testing.assert_array_equal(time_s, [0.0, 0.5])
    np.testing.assert_array_equal(tool_m, [[1, 2, 3], [4, 5, 6]])


HEAD = "t_s,x_m,y_m,z_m\n0,1,2,3\n"
NO_TABLES = {
    "t_s,x_m,y_m\n0,1,2\n": "header: no column z_m",
    f"{HEAD}1,1,nan,3\n": "row 3: 'nan' is not a finite number",
    f"{HEAD}1,1\n": "row 3: has 2 cells, the header 4",
    HEAD + "0,1,2,3\n": "times increasing",
    HEAD: "two rows or more",
}


@pytest.mark.parametrize(("text", "match"), NO_TABLES.items())
def test_what_is_no_such_table_is_refused_with_its_place(tmp_path: Path, text: str, match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        measured_tool.read(write(tmp_path / "t.csv", text))


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot read"):
        measured_tool.read(tmp_path / "none.csv")


def test_what_the_encoders_do_not_see_is_the_difference_to_where_they_have_the_tool() -> None:
    run = recording()
    time_s = np.linspace(0.0, 5.0, 120)
    tool_m = tool_position(CHAIN, run.positions_rad[:, :5])
    by_encoder = np.stack([np.interp(time_s + 1.0, run.time_s, column) for column in tool_m.T], axis=1)
    unseen = measured_tool.unseen_m(time_s, by_encoder + np.array([0.001, -0.002, 0.003]), run, CHAIN)
    np.testing.assert_allclose(unseen, np.tile([0.001, -0.002, 0.003], (measured_tool.EVEN, 1)), atol=2e-5)


def test_a_measurement_of_no_plan_or_half_of_one_is_refused() -> None:
    time_s, tool = np.linspace(0.0, 5.0, 20), np.zeros((20, 3))
    with pytest.raises(RequestRefused, match="no executed plan"):
        measured_tool.unseen_m(time_s, tool, recording(None), CHAIN)
    with pytest.raises(RequestRefused, match="measure all of it"):
        measured_tool.unseen_m(time_s / 2.0, tool, recording(), CHAIN)
