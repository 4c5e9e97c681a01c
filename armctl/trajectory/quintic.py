"""Fifth-order joint trajectories between two states of position, velocity and acceleration.

With tau = t / duration each joint runs

    q(tau) = c0 + c1 tau + c2 tau^2 + c3 tau^3 + c4 tau^4 + c5 tau^5,

whose six coefficients are fixed by the two states. Velocities and accelerations are per second, not per tau.
"""

from typing import NamedTuple

import numpy as np

from armctl.errors import ConfigError
from armctl.kinematics.chain import SerialChain, tool_position
from armctl.kinematics.differential import tool_acceleration, tool_velocity
from armctl.kinematics.transform import FloatArray

# Of every joint, or the same of all.
Rate = FloatArray | float


class Quintic(NamedTuple):
    """Coefficients of every joint, shape (6, n), over the fraction of the duration [s]."""

    coefficients: FloatArray
    duration_s: float

    def sample(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Position [rad], velocity [rad/s] and acceleration [rad/s^2] at times [s], each of shape (m, n).

        Times outside the trajectory count as its ends.
        """
        tau = np.clip(np.asarray(time_s, dtype=np.float64) / self.duration_s, 0.0, 1.0)[:, None]
        c, T = self.coefficients, self.duration_s
        position = c[0] + tau * (c[1] + tau * (c[2] + tau * (c[3] + tau * (c[4] + tau * c[5]))))
        velocity = c[1] + tau * (2.0 * c[2] + tau * (3.0 * c[3] + tau * (4.0 * c[4] + tau * 5.0 * c[5])))
        acceleration = 2.0 * c[2] + tau * (6.0 * c[3] + tau * (12.0 * c[4] + tau * 20.0 * c[5]))
        return position, velocity / T, acceleration / T**2


class Curves(NamedTuple):
    """A joint trajectory and what the tool does in it, sampled."""

    time_s: FloatArray
    # Of the joints, shape (m, n).
    position_rad: FloatArray
    velocity_rad_s: FloatArray
    acceleration_rad_s2: FloatArray
    # Of the tool in the base frame, shape (m, 3).
    tool_position_m: FloatArray
    tool_velocity_m_s: FloatArray
    tool_acceleration_m_s2: FloatArray
    tool_angular_velocity_rad_s: FloatArray
    tool_angular_acceleration_rad_s2: FloatArray


def quintic(
    q0: FloatArray, q1: FloatArray, duration_s: float, *, v0: Rate = 0.0, v1: Rate = 0.0, a0: Rate = 0.0, a1: Rate = 0.0
) -> Quintic:
    """The trajectory from q0 to q1 [rad], shape (n,), with boundary velocities [rad/s] and accelerations [rad/s^2].

    Raises:
        ConfigError: shapes that do not fit, numbers that are not finite, or a duration that is not above 0.
    """
    q0, q1 = np.asarray(q0, dtype=np.float64), np.asarray(q1, dtype=np.float64)
    if q0.ndim != 1 or q0.shape != q1.shape:
        raise ConfigError("trajectory", "q0, q1", f"shapes {q0.shape} and {q1.shape}", "as many joints in both")
    if not (np.isfinite(duration_s) and duration_s > 0.0):
        raise ConfigError("trajectory", "duration", f"{duration_s} s", "it must be above 0 and finite")
    T = duration_s
    try:
        rates = [np.broadcast_to(np.asarray(value, dtype=np.float64), q0.shape) for value in (v0, v1, a0, a1)]
    except ValueError:
        shapes = ", ".join(str(np.shape(value)) for value in (v0, v1, a0, a1))
        raise ConfigError("trajectory", "v0, v1, a0, a1", f"shapes {shapes}", f"one or {len(q0)} numbers") from None
    if not all(np.isfinite(values).all() for values in (q0, q1, *rates)):
        raise ConfigError("trajectory", "boundary", "holds a number that is not finite")
    V0, V1, A0, A1 = rates[0] * T, rates[1] * T, rates[2] * T**2, rates[3] * T**2
    way = q1 - q0
    c3 = 10.0 * way - 6.0 * V0 - 4.0 * V1 - 1.5 * A0 + 0.5 * A1
    c4 = -15.0 * way + 8.0 * V0 + 7.0 * V1 + 1.5 * A0 - A1
    c5 = 6.0 * way - 3.0 * V0 - 3.0 * V1 - 0.5 * A0 + 0.5 * A1
    return Quintic(np.stack((q0, V0, 0.5 * A0, c3, c4, c5)), duration_s)


def curves(chain: SerialChain, time_s: FloatArray, q: FloatArray, q_rate: FloatArray, q_rate2: FloatArray) -> Curves:
    """Joint and tool curves of a motion sampled at times [s], shape (m,).

    Args:
        q, q_rate, q_rate2: Position, velocity and acceleration of the joints then, as `Quintic.sample` tells them.
    """
    velocity, acceleration = tool_velocity(chain, q, q_rate), tool_acceleration(chain, q, q_rate, q_rate2)
    time_s, tool_m = np.asarray(time_s, dtype=np.float64), tool_position(chain, q)
    linear, angular = (velocity[:, :3], acceleration[:, :3]), (velocity[:, 3:], acceleration[:, 3:])
    return Curves(time_s, q, q_rate, q_rate2, tool_m, *linear, *angular)
