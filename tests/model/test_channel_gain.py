"""The gain of a channel that a fit has driven to its bound, as that of a reversed one."""

import numpy as np

from balance_cli.model.effects.channel_gain import EFFECT
from balance_cli.model.response_jacobian import output_jacobian
from balance_cli.model.system_response import solve
from tests.support.effect_checks import FREQUENCY, RIG, model_with_effect


def test_the_response_has_finite_derivatives_at_the_least_gain():
    """A diagnosis of a reversed strut ended with an internal error: a gain of zero has no relative derivative."""
    model = model_with_effect(EFFECT, EFFECT.places(RIG)[0], at_null=True)
    at_bound = np.array([name.startswith("channel-gain") for name in model.parameters.names])
    system = model.system(np.where(at_bound, model.parameters.lower, model.parameters.value))
    loads = np.ones((len(FREQUENCY), 6), complex)
    jacobian = output_jacobian(system, solve(system, FREQUENCY), np.arange(len(FREQUENCY)), loads)
    assert at_bound.any() and np.isfinite(jacobian).all()
