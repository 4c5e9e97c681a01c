"""Cosine and sine against exact ones, and the same for one angle as for many."""

import math
from decimal import Decimal, localcontext

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from armctl.kinematics.sine import FEW, LARGEST_RAD, cos_sin, cos_sin_of_all

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
