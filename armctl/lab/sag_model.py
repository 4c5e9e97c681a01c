"""What keeps a joint behind its goal, as far as gravity, friction and speed tell it: identified from a few lines.

    lag = goal - position = sum_k g_k * reach_k(q) + f * h + d * velocity + c        (one equation a joint)

`reach_k` is the horizontal lever of link k about the joint's axis: through the servo's compliance slope, gravity on it
bends the joint in proportion. `h` in [-1, 1] is the side on which friction pushes: the direction of the joint's last
motion, which a reversal turns over within `TURN_RAD` (Dahl's model). The position is the potentiometer's, on the
output shaft: sag and play are seen; zero offsets, bending and the potentiometer's own nonlinearity are not.

The model of an arm is kept in NAME.sag.json beside its calibration file NAME.yaml.
"""

import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from armctl.config import ArmConfig, Config, Frozen, Name, validate
from armctl.dynamixel.ax12a import LOAD_MAX, NO_LOAD_SPEED_RAD_S, STALL_TORQUE_NM, TICK_RAD, compliance_slope
from armctl.errors import ConfigError
from armctl.files import find_arm_file, read_text
from armctl.kinematics.chain import SerialChain, link_frames
from armctl.kinematics.transform import FloatArray

TURN_RAD = 0.5 * TICK_RAD
# An AX-12A with its bracket, and a light tool: what an arm nobody has measured is taken to weigh.
SERVO_KG, TOOL_KG = 0.075, 0.08
FRICTION_NM = 0.12
# How far, as a share, an arm's coefficients may be from those of the nominal one: the ridge pulls towards the nominal
# arm as strongly as one sample with an error of a tick.
SPREAD = 0.5
CONSTANT_RAD = TICK_RAD
GRAVITY_M_S2 = 9.81

_log = logging.getLogger(__name__)

Row = Annotated[tuple[float, ...], Field(strict=False)]


class SagModel(Frozen):
    """Coefficients of one arm, a row a joint; stored beside its calibration."""

    arm_id: Name
    calibration_hash: str = Field(max_length=64)
    # Of each downstream link [rad/m], shape (n, n).
    gravity_rad_m: tuple[Row, ...] = Field(strict=False)
    friction_rad: Row
    damping_s: Row
    constant_rad: Row
    # Standard deviation of what the equation leaves, one encoder reading's noise included.
    residual_tick: Row
    # How many it was identified from; 0: it is the nominal arm's.
    lines: int = Field(ge=0)


def directions(q: FloatArray, before: FloatArray) -> FloatArray:
    """On which side friction pushes along a motion.

    Args:
        q: Joint positions [rad], shape (m, n).
        before: How each joint came to the first one: displacement [rad], shape (n,).
    Returns:
        h, shape (m, n).
    """
    h = np.empty_like(q)
    h[0] = np.sign(before) * -np.expm1(-np.abs(before) / TURN_RAD)
    for i, step in enumerate(np.diff(q, axis=0), start=1):
        side = np.sign(step)
        h[i] = side + (h[i - 1] - side) * np.exp(-np.abs(step) / TURN_RAD)
    return h


def regressors(chain: SerialChain, q: FloatArray, before: FloatArray, period_s: float) -> FloatArray:
    """The quantities that explain each joint's lag, along a motion that is sampled every `period_s`.

    Args:
        q: Joint positions the arm is to have [rad], shape (m, n).
        before: As `directions`.
    Returns:
        Shape (n, m, n + 3): reach of each link [m] (0 upstream), h, velocity [rad/s], 1.
    """
    m, n = q.shape
    T = link_frames(chain, q)
    axes = T[:, :-1] if chain.convention == "standard" else T[:, 1:]
    links = np.diff(T[:, :, :3, 3], axis=1)
    X = np.zeros((n, m, n + 3))
    for i in range(n):
        z = axes[:, i, :3, 2]
        X[i, :, i:n] = z[:, None, 0] * links[:, i:, 1] - z[:, None, 1] * links[:, i:, 0]
    X[:, :, n] = directions(q, before).T
    X[:, :, n + 1] = np.gradient(q, period_s, axis=0).T
    X[:, :, n + 2] = 1.0
    return X


def nominal(arm: ArmConfig, chain: SerialChain) -> SagModel:
    """The model of an arm of new AX-12A servos, from the data sheet: it is used before anything is measured.

    A servo's output climbs over its compliance slope from `punch` to full; a torque bends it by torque / stiffness.
    """
    n = chain.n
    joints = arm.joints[:n]
    # Servos sit on the axes, those beyond the chain halfway along its last link.
    further_kg = SERVO_KG * (len(arm.joints) - n)
    carried = SERVO_KG * np.arange(n - 1, -1, -1) + further_kg + TOOL_KG
    carried[-1] -= further_kg / 2.0
    slope = np.array([compliance_slope(joint.compliance.slope) for joint in joints])
    punch = np.array([joint.compliance.punch for joint in joints]) / LOAD_MAX
    softness = slope * TICK_RAD / ((1.0 - punch) * STALL_TORQUE_NM)
    # A servo carries what is further out than its own joint.
    gravity = np.triu(np.outer(GRAVITY_M_S2 * softness, carried))
    others = (FRICTION_NM * softness, STALL_TORQUE_NM / NO_LOAD_SPEED_RAD_S * softness, np.zeros(n))
    return _model(arm, np.column_stack([gravity, *others]), np.zeros(n), 0)


def fitted(arm: ArmConfig, chain: SerialChain, lags: Sequence[FloatArray], rows: Sequence[FloatArray]) -> SagModel:
    """The model that explains measured lags best: least squares, with a weak ridge penalty towards the nominal model.

    Args:
        lags: Goal less position [rad] of each calibration line, shape (m, n).
        rows: Its `regressors`, shape (n, m, n + 3).
    """
    lag, X = np.concatenate(lags), np.concatenate(rows, axis=1)
    n = lag.shape[1]
    prior = _coefficients(nominal(arm, chain))
    coefficients, residual = np.empty((n, n + 3)), np.empty(n)
    for i in range(n):
        scale = SPREAD * np.abs(prior[i])
        scale[-1] = CONSTANT_RAD
        S, rest = X[i] * scale, lag[:, i] - X[i] @ prior[i]
        normal = S.T @ S + TICK_RAD**2 * np.eye(n + 3)
        coefficients[i] = prior[i] + scale * np.linalg.solve(normal, S.T @ rest)
        residual[i] = (lag[:, i] - X[i] @ coefficients[i]).std() / TICK_RAD
    return _model(arm, coefficients, residual, len(lags))


def predict(model: SagModel, X: FloatArray) -> FloatArray:
    """Lag [rad], shape (m, n), from `regressors`."""
    return np.asarray(np.einsum("imk,ik->mi", X, _coefficients(model)))


def heaviest_rad(model: SagModel, chain: SerialChain, q: FloatArray) -> FloatArray:
    """Largest lag of each joint by gravity and friction along a motion [rad], shape (n,); q [rad], shape (m, n)."""
    n = chain.n
    X = regressors(chain, q, np.zeros(n), 1.0)
    sag = np.einsum("imk,ik->mi", X[:, :, :n], np.array(model.gravity_rad_m)) + np.array(model.constant_rad)
    return np.asarray(np.abs(sag).max(axis=0) + np.abs(model.friction_rad))


def path_of(config: Config) -> Path:
    """Where the model of the configured arm lies."""
    return find_arm_file(config.arm).with_suffix(".sag.json")


def load(config: Config, arm: ArmConfig) -> SagModel | None:
    """The model of this arm and calibration; None where there is none, or it is of another calibration.

    Raises:
        ConfigError: the file is no sag model.
    """
    if not (path := path_of(config)).exists():
        return None
    try:
        data = json.loads(read_text(path, "sag model"))
    except ValueError as error:
        raise ConfigError(str(path), "", f"not JSON: {error}", "identify it again") from None
    model = validate(SagModel, data, str(path))
    if (model.arm_id, model.calibration_hash) != (arm.arm_id, arm.calibration_hash):
        _log.warning(
            "%s: of calibration %s, the arm has %s; not used", path, model.calibration_hash, arm.calibration_hash
        )
        return None
    return model


def save(config: Config, model: SagModel) -> Path:
    """Write the model beside the calibration.

    Raises:
        ConfigError: it cannot be written there.
    """
    path = path_of(config)
    try:
        path.write_text(json.dumps(model.model_dump(mode="json"), indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError(str(path), "", f"cannot write the sag model: {error.strerror}") from None
    return path


def _coefficients(model: SagModel) -> FloatArray:
    """A row a joint, in the order of `regressors`, shape (n, n + 3)."""
    return np.column_stack([model.gravity_rad_m, model.friction_rad, model.damping_s, model.constant_rad])


def _model(arm: ArmConfig, coefficients: FloatArray, residual_tick: FloatArray, lines: int) -> SagModel:
    """The model of such `_coefficients`."""
    n = len(coefficients)
    friction, damping, constant = coefficients[:, n:].T.tolist()
    return SagModel(
        arm_id=arm.arm_id,
        calibration_hash=arm.calibration_hash,
        gravity_rad_m=tuple(map(tuple, coefficients[:, :n].tolist())),
        friction_rad=tuple(friction),
        damping_s=tuple(damping),
        constant_rad=tuple(constant),
        residual_tick=tuple(residual_tick.tolist()),
        lines=lines,
    )
