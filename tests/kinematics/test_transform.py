"""Rotations; cosine and sine against exact ones, and the same for one angle as for many."""

import math
from decimal import Decimal, localcontext

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from armctl.kinematics import transform
from armctl.kinematics.transform import (
    FEW,
    LARGEST_RAD,
    cos_sin,
    cos_sin_of_all,
    matrix_from_quaternion,
    matrix_from_rpy,
    quaternion_from_matrix,
    rpy_from_matrix,
)
from tests.kinematics.conftest import X, Y, Z, screw

angle = st.floats(-math.pi, math.pi)


def rotation(roll: float, pitch: float, yaw: float) -> transform.FloatArray:
    return np.asarray((screw(Z, yaw) @ screw(Y, pitch) @ screw(X, roll))[:3, :3])


@given(angle, angle, angle)
def test_quaternion_round_trips_the_matrix(roll: float, pitch: float, yaw: float) -> None:
    R = rotation(roll, pitch, yaw)
    q = quaternion_from_matrix(R)
    assert q[3] >= 0.0
    assert math.isclose(sum(c * c for c in q), 1.0, abs_tol=1e-12)
    np.testing.assert_allclose(matrix_from_quaternion(q), R, atol=1e-12)


@given(angle, st.floats(-math.pi / 2, math.pi / 2), angle)
def test_rpy_round_trips_the_matrix(roll: float, pitch: float, yaw: float) -> None:
    R = rotation(roll, pitch, yaw)
    np.testing.assert_allclose(matrix_from_rpy(roll, pitch, yaw), R, atol=1e-15)
    # Near the gimbal lock the angles are ill defined, the matrix is not.
    tolerance = 1e-12 if abs(pitch) <= 1.5 else 1e-9
    np.testing.assert_allclose(matrix_from_rpy(*rpy_from_matrix(R)), R, atol=tolerance)


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2])
def test_gimbal_lock_has_zero_roll(pitch: float) -> None:
    R = rotation(0.4, pitch, 0.9).round(15)
    roll, found, _ = rpy_from_matrix(R)
    assert roll == 0.0
    assert found == pytest.approx(pitch)
    np.testing.assert_allclose(rotation(*rpy_from_matrix(R)), R, atol=1e-12)


@pytest.mark.parametrize("axis", range(3))
def test_half_turns_have_a_quaternion(axis: int) -> None:
    R = -np.eye(3)
    R[axis, axis] = 1.0
    expected = [0.0, 0.0, 0.0, 0.0]
    expected[axis] = 1.0
    np.testing.assert_allclose(np.abs(quaternion_from_matrix(R)), expected, atol=1e-15)


@given(angle, angle, angle, st.floats(0.0, math.pi))
def test_rotation_vector_is_axis_times_angle(x: float, y: float, z: float, angle_rad: float) -> None:
    axis = np.array([x, y, z + 4.0])
    axis /= np.linalg.norm(axis)
    half = math.sin(angle_rad / 2.0)
    R = matrix_from_quaternion((axis[0] * half, axis[1] * half, axis[2] * half, math.cos(angle_rad / 2.0)))
    found = transform.rotation_vector(R)
    if angle_rad > math.pi - 1e-6:
        found = found * np.sign(found @ axis)  # half a turn either way is the same
    np.testing.assert_allclose(found, axis * angle_rad, atol=1e-7 if angle_rad > 3.0 else 1e-12)


def test_rotation_error_turns_one_rotation_into_the_other() -> None:
    rng = np.random.default_rng(0)
    A, B = (np.array([matrix_from_rpy(*rng.uniform(-1.5, 1.5, 3)) for _ in range(20)]) for _ in range(2))
    error = transform.rotation_error(A, B)
    angle = np.linalg.norm(error, axis=-1, keepdims=True)
    half = error / angle * np.sin(angle / 2.0)
    for R, wanted, v, w in zip(A, B, half, np.cos(angle[:, 0] / 2.0), strict=True):
        np.testing.assert_allclose(matrix_from_quaternion((*v.tolist(), float(w))) @ R, wanted, atol=1e-12)


# ------------------------------------------------------------------------------------------------------ cosine and sine


PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459230781640628620899862803482534")
angles = st.floats(-7.0, 7.0) | st.floats(-LARGEST_RAD, LARGEST_RAD)


def exact(angle: float) -> tuple[Decimal, Decimal]:
    """Cosine and sine of a float to some 60 digits, by their series."""
    with localcontext() as context:
        context.prec = 70
        x = Decimal(angle) % (2 * PI)
        terms = [Decimal(1)]
        while abs(terms[-1]) > Decimal("1e-65") or len(terms) < 12:
            terms.append(terms[-1] * x / len(terms))
        cosine = sum(term * (-1) ** k for k, term in enumerate(terms[::2]))
        sine = sum(term * (-1) ** k for k, term in enumerate(terms[1::2]))
        return Decimal(cosine), Decimal(sine)


@settings(max_examples=500)
@given(angles | st.builds(lambda k: k * math.pi / 4.0, st.integers(-1000, 1000)))
@example(0.0)
@example(1e-300)
@example(math.pi / 2.0)
@example(math.pi)
@example(-1e6)
@example(710.0 / 226.0)  # nearly pi
@example(6381956970095103.0 * 2.0**-33)  # among the nearest of all floats to a multiple of pi/2
def test_it_is_as_exact_as_a_float_can_nearly_be(angle: float) -> None:
    for found, true in zip(cos_sin(angle), exact(angle), strict=True):
        error = abs(Decimal(found) - true)
        assert error <= Decimal("1.2e-16")
        assert error <= abs(true) * Decimal(2) ** -52


@given(st.lists(angles | st.sampled_from([0.0, -0.0, 1e7, math.pi]), min_size=1, max_size=3 * FEW), st.integers(1, 5))
def test_one_angle_and_many_give_the_same_bits(few: list[float], rows: int) -> None:
    many = np.array([few] * rows)
    both = np.stack(cos_sin_of_all(many), axis=-1)
    assert both.shape == (*many.shape, 2)
    cos_sin.cache_clear()
    assert both.tobytes() == np.array([[cos_sin(angle) for angle in few]] * rows).tobytes()


@given(angles)
def test_the_cosine_is_even_and_the_sine_odd(angle: float) -> None:
    c, s = cos_sin(angle)
    assert cos_sin(-angle) == (c, -s)


@pytest.mark.parametrize("count", [1, 2 * FEW])
@pytest.mark.parametrize("angle", [1e7, -1e300, math.nan])
def test_beyond_its_range_the_c_library_does(angle: float, count: int) -> None:
    cosines, sines = cos_sin_of_all(np.full(count, angle))
    np.testing.assert_allclose(cosines, math.cos(angle), rtol=0, atol=1e-15)
    np.testing.assert_allclose(sines, math.sin(angle), rtol=0, atol=1e-15)


def test_no_angles_give_none() -> None:
    cosines, sines = cos_sin_of_all(np.empty((5, 0)))
    assert cosines.shape == sines.shape == (5, 0)
