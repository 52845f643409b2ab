import numpy as np
import pytest

from balance_cli.signals.rotor.joint_regression import JointRegression


def _sums(others):
    """Products of five columns with themselves and with further ones, and of all with two signals."""
    rng = np.random.default_rng(3)
    design = np.hstack([rng.normal(size=(200, 5)), others(rng)])
    signals = rng.normal(size=(200, 2))
    gram = design.T @ design
    return design, signals, JointRegression(gram[:5, :5], gram[5:]), design.T @ signals


def test_the_coefficients_and_their_variances_are_those_of_the_whole_regression():
    design, signals, joint, moment = _sums(lambda rng: 1e-4 * rng.normal(size=(200, 3)).cumsum(axis=0))
    np.testing.assert_allclose(joint.solve(moment), np.linalg.lstsq(design, signals, rcond=None)[0][:5], rtol=1e-9)
    whole, alone = (np.diag(np.linalg.inv(X.T @ X)) for X in (design, design[:, :5]))
    np.testing.assert_allclose(joint.variance_inflation(), whole[:5] / alone, rtol=1e-9)


@pytest.mark.parametrize("copies", [2, 5])
def test_equal_columns_count_once(copies):
    design, signals, joint, moment = _sums(lambda rng: np.repeat(rng.normal(size=(200, 1)), copies, axis=1))
    np.testing.assert_allclose(joint.solve(moment), np.linalg.lstsq(design, signals, rcond=None)[0][:5], rtol=1e-9)
    once = JointRegression(joint.own, joint.border[:1, :6])
    np.testing.assert_allclose(joint.variance_inflation(), once.variance_inflation(), rtol=1e-9)
