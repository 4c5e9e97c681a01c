"""What keeps a joint behind its goal, as far as gravity, friction and speed tell it.

    lag = goal - position = sum_k g_k * reach_k(q) + f * h + d * velocity + c        (one equation a joint)

`reach_k` is the horizontal lever of link k about the joint's axis: through the servo's compliance slope, gravity on it
bends the joint in proportion. `h` in [-1, 1] is the side on which friction pushes: the direction of the joint's last
motion, which a reversal turns over within `TURN_RAD` or so (Dahl's model). The position is the potentiometer's, on the
output shaft: sag and play are seen; zero offsets, bending and the potentiometer's own nonlinearity are not.

`lags_rad` foresees it for the control step, so its sums and products are written out; the rest is for whole motions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from armctl.config import ArmConfig
from armctl.dynamixel.ax12a import LOAD_MAX, TICK_RAD, compliance_slope
from armctl.dynamixel.servos import MODELS
from armctl.kinematics.chain import SerialChain, frames_of_one, link_frames
from armctl.kinematics.transform import FloatArray
from armctl.messages import LagModel

TURN_RAD = 0.5 * TICK_RAD
# From here on the side of a joint's friction is known.
KNOWN_SIDE = 0.9
# An AX-12A with its bracket, and a light tool: what an arm nobody has measured is taken to weigh.
SERVO_KG, TOOL_KG = 0.075, 0.08
FRICTION_NM = 0.12
# How far, as a share, an arm's coefficients may be from those of the nominal one: the ridge pulls towards the nominal
# arm as strongly as one sample with an error of a tick.
SPREAD = 0.5
CONSTANT_RAD = TICK_RAD
GRAVITY_M_S2 = 9.81


def side_after(side: float, way_rad: float) -> float:
    """On which side friction pushes once a joint has gone a way, from -1 to 1: (1 + x / 8)^-8 stands for e^-x."""
    if way_rad == 0.0:
        return side
    x = 1.0 + abs(way_rad) / (8.0 * TURN_RAD)
    x *= x
    x *= x
    toward = 1.0 if way_rad > 0.0 else -1.0
    return toward + (side - toward) / (x * x)


def lags_rad(
    model: LagModel, chain: SerialChain, q: Sequence[float], side: Sequence[float], velocity_rad_s: Sequence[float]
) -> list[float]:
    """By how much each joint of the chain stays behind its goal, at one instant [rad]."""
    n = chain.n
    frames = frames_of_one(chain, q[:n])
    turning = chain.turning(frames)
    at = [P for _, _, _, P in (*turning, frames[-1])]
    found = []
    for i, (row, (_, _, (zx, zy, _), _)) in enumerate(zip(model.rows, turning, strict=True)):
        lag = row[n] * side[i] + row[n + 1] * velocity_rad_s[i] + row[n + 2]
        for k in range(i, n):
            lag += row[k] * (zx * (at[k + 1][1] - at[k][1]) - zy * (at[k + 1][0] - at[k][0]))
        found.append(lag)
    return found


def sides(q: FloatArray, side: Sequence[float]) -> FloatArray:
    """On which side friction pushes along a motion.

    Args:
        q: Joint positions [rad], shape (m, n).
        side: Where it pushes at the begin, shape (n,).
    Returns:
        h, shape (m, n).
    """
    h = [side]
    for step in np.diff(q, axis=0).tolist():
        h.append([side_after(last, way) for last, way in zip(h[-1], step, strict=True)])
    return np.array(h)


def regressors(chain: SerialChain, q: FloatArray, before: FloatArray, period_s: float) -> FloatArray:
    """The quantities that explain each joint's lag, along a motion that is sampled every `period_s`.

    Args:
        q: Joint positions the arm is to have [rad], shape (m, n).
        before: How each joint came to the first one: displacement [rad], shape (n,).
    Returns:
        Shape (n, m, n + 3): reach of each link [m] (0 upstream), h, velocity [rad/s], 1.
    """
    m, n = q.shape
    T = link_frames(chain, q)
    axes = T[:, chain.first_axis : chain.first_axis + n]
    # From each joint to the next, and from the last one to the tool: what `lags_rad` sums.
    links = np.diff(np.concatenate([axes, T[:, -1:]], axis=1)[:, :, :3, 3], axis=1)
    X = np.zeros((n, m, n + 3))
    for i in range(n):
        z = axes[:, i, :3, 2]
        X[i, :, i:n] = z[:, None, 0] * links[:, i:, 1] - z[:, None, 1] * links[:, i:, 0]
    X[:, :, n] = sides(q, [side_after(0.0, float(way)) for way in before]).T
    X[:, :, n + 1] = np.gradient(q, period_s, axis=0).T
    X[:, :, n + 2] = 1.0
    return X


def nominal(arm: ArmConfig, chain: SerialChain) -> LagModel:
    """The model of an arm of new AX-12A servos, from the data sheet: it is used before anything is measured.

    A servo's output climbs over its compliance slope from `punch` to full; a torque bends it by torque / stiffness.
    """
    n = chain.n
    # Servos sit on the axes, those beyond the chain halfway along its last link.
    servos = [joint.servo_count for joint in arm.joints]
    further_kg = SERVO_KG * sum(servos[n:])
    carried = [SERVO_KG * sum(servos[i + 1 : n]) + further_kg + TOOL_KG for i in range(n)]
    carried[-1] -= further_kg / 2.0
    rows = []
    for i, joint in enumerate(arm.joints[:n]):
        punch = joint.compliance.punch / LOAD_MAX
        stall_Nm, free_rad_s = MODELS[joint.model].stall_torque_Nm, MODELS[joint.model].no_load_speed_rad_s
        stall_Nm *= servos[i]
        softness = compliance_slope(joint.compliance.slope) * TICK_RAD / ((1.0 - punch) * stall_Nm)
        # A servo carries what is further out than its own joint.
        gravity = [GRAVITY_M_S2 * softness * kg if k >= i else 0.0 for k, kg in enumerate(carried)]
        rows.append((*gravity, servos[i] * FRICTION_NM * softness, stall_Nm / free_rad_s * softness, 0.0))
    return LagModel(arm.arm_id, arm.calibration_hash, tuple(rows))


@dataclass(frozen=True, eq=False)
class Summary:
    """What samples tell of each joint's equation, however many: least squares needs no more than these sums."""

    # Of regressors by regressors, shape (n, n + 3, n + 3), and by lag, shape (n, n + 3).
    XX: FloatArray
    Xy: FloatArray
    # Of lag by lag [rad^2], shape (n,), and how many samples there are, shape (n,).
    yy: FloatArray
    count: FloatArray

    def __add__(self, other: Self) -> Self:
        return type(self)(*[a + b for a, b in zip(vars(self).values(), vars(other).values(), strict=True)])

    def squares(self, rows: FloatArray) -> FloatArray:
        """What coefficients, shape (n, n + 3), leave of each joint's lag: the sum of squares [rad^2], shape (n,)."""
        explained = np.einsum("ik,ikl,il->i", rows, self.XX, rows)
        return np.asarray(np.maximum(self.yy - 2.0 * (rows * self.Xy).sum(axis=1) + explained, 0.0))

    def rms_rad(self, rows: FloatArray) -> FloatArray:
        """The same as a root mean square [rad], shape (n,); 0 where there is no sample."""
        return np.asarray(np.sqrt(self.squares(rows) / np.maximum(self.count, 1.0)))


def summary(lags: FloatArray, X: FloatArray, heard: NDArray[np.bool_] | None = None) -> Summary:
    """The sums over one motion.

    A sample counts where it is known on which side the joint's friction pushes, that is, once the joint has gone a way:
    what holds one that stands is anything up to its friction.

    Args:
        lags: Goal less position [rad], shape (m, n).
        X: Its `regressors`, shape (n, m, n + 3).
        heard: Which samples there are, shape (m, n); None: all.
    """
    y = lags.T
    counts = np.abs(X[:, :, -3]) >= KNOWN_SIDE
    weight = (counts if heard is None else counts & heard.T).astype(float)
    W = X * weight[..., None]
    XX, Xy = np.einsum("imk,iml->ikl", W, X), np.einsum("imk,im->ik", W, y)
    return Summary(XX, Xy, (weight * y * y).sum(axis=1), weight.sum(axis=1))


def total(motions: Sequence[Summary]) -> Summary:
    """The sums over all of some motions."""
    return sum(motions[1:], motions[0])


def model_of(arm: ArmConfig, rows: FloatArray, motions: Sequence[Summary]) -> LagModel:
    """The model with these coefficients, shape (n, n + 3), and what it leaves of the motions it is from."""
    residual = total(motions).rms_rad(rows) / TICK_RAD
    found = tuple(map(tuple, rows.tolist()))
    return LagModel(arm.arm_id, arm.calibration_hash, found, tuple(residual.tolist()), len(motions))


def fitted(arm: ArmConfig, chain: SerialChain, motions: Sequence[Summary]) -> LagModel:
    """The model that explains motions best: least squares, with a weak ridge penalty towards the nominal model."""
    whole, n = total(motions), chain.n
    prior = np.array(nominal(arm, chain).rows)
    coefficients = np.empty((n, n + 3))
    for i in range(n):
        scale = SPREAD * np.abs(prior[i])
        scale[-1] = CONSTANT_RAD
        normal = scale[:, None] * whole.XX[i] * scale + TICK_RAD**2 * np.eye(n + 3)
        coefficients[i] = prior[i] + scale * np.linalg.solve(normal, scale * (whole.Xy[i] - whole.XX[i] @ prior[i]))
    return model_of(arm, coefficients, motions)


def predict(model: LagModel, X: FloatArray) -> FloatArray:
    """Lag [rad], shape (m, n), from `regressors`."""
    return np.asarray(np.einsum("imk,ik->mi", X, np.array(model.rows)))


def heaviest_rad(model: LagModel, chain: SerialChain, q: FloatArray, period_s: float) -> FloatArray:
    """Largest lag of each joint along a motion [rad], shape (n,); q [rad], shape (m, n), every `period_s`.

    Friction counts as if it always added to gravity and speed.
    """
    n, rows = chain.n, np.array(model.rows)
    X = regressors(chain, q, np.zeros(n), period_s)
    X[:, :, n] = 0.0
    return np.asarray(np.abs(predict(model, X)).max(axis=0) + np.abs(rows[:, n]))
