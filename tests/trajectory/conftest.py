"""What tests of trajectories share: the arm of the straight line."""

import numpy as np

from tests.genetic import hand

ARM, ROBOT = hand.arm(), hand.robot()
CHAIN = ROBOT.chain
REST = [joint.rest_rad for joint in ARM.joints]
# Of the chain's joints, shape (n, 2).
LIMITS = np.array([joint.limits_rad for joint in ARM.joints[: CHAIN.n]])
