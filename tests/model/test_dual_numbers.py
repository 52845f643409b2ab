"""Dual numbers against numerical derivatives."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from balance_cli.model.mechanics.dual_numbers import (
    MANY_VALUES,
    Dual,
    block_diagonal,
    concatenate,
    constant,
    stack,
    variables,
)

vectors = arrays(float, 3, elements=st.floats(0.5, 2.0))


def pieces(theta):
    """Every rule of the calculus in one small matrix function."""
    a, b, c = (theta[i] for i in range(3))
    ones = np.ones((2, 2))
    A = stack([stack([a, b]), stack([b * c, c + 2.0])])
    B = A @ A.T - 0.3 * A + constant(np.eye(2), 3) * (a * b)
    joined = block_diagonal(B, concatenate([A, ones * c], axis=1)[:, 1:3])
    return joined.insert_axis(0)[0] @ stack([a, b, c, a.sqrt()]) + (2.0 - joined[0]) * b.reciprocal()


def values(x):
    return pieces(variables(x)).value


@given(vectors)
def test_slopes_are_the_derivatives(x):
    dual = pieces(variables(x))
    step = 1e-6
    numerical = [(values(x + step * e) - values(x - step * e)) / (2 * step) for e in np.eye(3)]
    np.testing.assert_allclose(dual.derivative, numerical, rtol=1e-7, atol=1e-7)


@given(vectors)
def test_inverse_undoes_the_matrix(x):
    theta = variables(x)
    A = stack([stack([theta[0] + 3.0, theta[1]]), stack([theta[2], theta[0] + 5.0])])
    product = A @ A.inverse()
    np.testing.assert_allclose(product.value, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(product.derivative, 0.0, atol=1e-12)


def test_numpy_leaves_the_operators_to_the_dual_number():
    theta = variables([1.0, 2.0])
    assert isinstance(np.eye(2) @ theta, Dual)
    assert isinstance(np.array([2.0, 3.0]) * theta, Dual)
    np.testing.assert_array_equal((1.0 - theta).derivative, -np.eye(2))


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="mismatch"):
        variables([1.0, 2.0]) @ np.eye(3)


def test_a_function_of_time_times_a_number_has_the_derivatives_of_its_single_values():
    rng = np.random.default_rng(2)
    history = Dual(rng.normal(size=MANY_VALUES), rng.normal(size=(3, MANY_VALUES)))
    number = Dual(np.array(1.7), np.array([0.0, -0.3, 2.0]))
    for product in (history * number, number * history):
        for i in (0, 7, MANY_VALUES - 1):
            single = history[i] * number
            np.testing.assert_array_equal(product.value[i], single.value)
            np.testing.assert_allclose(product.derivative[:, i], single.derivative, rtol=1e-15)
    np.testing.assert_array_equal((history - history * number).value, (history + (-(history * number))).value)
