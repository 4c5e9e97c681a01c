"""The tool pose in plain floats has the bits of the one in arrays."""

import numpy as np
import pytest

from armctl.kinematics import robots
from armctl.kinematics.chain import forward_kinematics, tool_pose
from armctl.kinematics.transform import quaternion_from_columns, quaternion_from_matrix


@pytest.mark.parametrize("name", robots.names())
def test_plain_floats_give_the_bits_of_forward_kinematics(name: str) -> None:
    chain = robots.get(name).chain
    rng = np.random.default_rng(7)
    for q in rng.uniform(-np.pi, np.pi, (200, chain.n)):
        T = forward_kinematics(chain, q)
        columns = tool_pose(chain, q.tolist())
        np.testing.assert_array_equal(np.array(columns).T, T[:3])
        assert quaternion_from_columns(*columns[:3]) == quaternion_from_matrix(T[:3, :3])
