import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.errors import ConfigError
from armctl.kinematics import robots
from armctl.kinematics.chain import forward_kinematics, tool_position

angles = st.lists(st.floats(-math.pi, math.pi), min_size=5, max_size=5)


@given(angles)
def test_equations_7_to_18_hold_with_their_two_corrections(angles: list[float]) -> None:
    robot = robots.get("ax12-line")
    d1, a2, a3, a4, a56 = (robot.lengths_m[name] for name in ("d1", "a2", "a3", "a4", "a56"))
    t1, t2, t3, t4, t5 = angles
    C1, S1, C2, S2, C4, S4 = (f(t) for t in (t1, t2, t4) for f in (math.cos, math.sin))
    C23, S23, C45, S45 = (f(t) for t in (t2 + t3, t4 + t5) for f in (math.cos, math.sin))
    along, across = a4 * C4 + a56 * C45, a4 * S4 + a56 * S45
    p_x = C1 * (a2 * C2 + a3 * C23) + C1 * C23 * along - C1 * S23 * across  # (eq. 10); print lacks the last term
    p_y = S1 * (a2 * C2 + a3 * C23) + S1 * C23 * along - S1 * S23 * across  # (eq. 14); print has a2 C2 - a3 C23
    p_z = d1 + S23 * along + C23 * across + a2 * S2 + a3 * S23  # (eq. 18)
    expected = [
        [C1 * C23 * C45 - C1 * S23 * S45, -C1 * S23 * C45 - C1 * C23 * S45, S1, p_x],  # (eqs. 7 to 10)
        [S1 * C23 * C45 - S1 * S23 * S45, -S1 * S23 * C45 - S1 * C23 * S45, -C1, p_y],  # (eqs. 11 to 14)
        [S23 * C45 + C23 * S45, C23 * C45 - S23 * S45, 0.0, p_z],  # (eqs. 15 to 18)
    ]
    np.testing.assert_allclose(forward_kinematics(robot.chain, np.array(angles))[:3], expected, atol=1e-12)


def test_lengths_are_replaced_by_name() -> None:
    longer = robots.get("ax12-line", {"a2": 0.205})
    np.testing.assert_allclose(tool_position(longer.chain, np.zeros(5)), [0.48, 0.0, 0.10], atol=1e-15)
    assert robots.get("ax12-line", {}) is robots.get("ax12-line")


def test_unknown_robot_and_unknown_length_name_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"known: .*ax12-line"):
        robots.get("hal")
    with pytest.raises(ConfigError, match="a9: no such length; known: d1, a2, a3, a4, a56"):
        robots.get("ax12-line", {"a9": 1.0})
    assert "ax12-line" in robots.names()
