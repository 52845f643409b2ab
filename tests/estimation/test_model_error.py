"""With the model error of a run its chi-square equals its degrees of freedom, wherever the search begins."""

import numpy as np
import pytest

from balance_cli.estimation.fit_quality import fit_quality
from balance_cli.estimation.measurements import stack_runs
from balance_cli.estimation.model_error import add_model_error, estimate_model_error
from balance_cli.model.balance import balance_model
from tests.support.model_lines import model_lines
from tests.support.rigs import two_degrees_of_freedom

NOISE = 1e-4


@pytest.fixture(scope="module")
def lines():
    """A model whose error in heave is hardly above the noise, and in pitch far above it; its lines and system."""
    rig = two_degrees_of_freedom()
    model = balance_model(rig)
    rng, frequency = np.random.default_rng(3), np.linspace(2.0, 80.0, 80)
    runs = [model_lines(model, name, i, frequency, NOISE, rng) for name, i in (("Fz", 2), ("My", 4))]
    theta = model.parameters.value.copy()
    for i, name in enumerate(model.parameters.names):
        theta[i] *= {"mass": 1.0 + 1e-5, "inertia.yy": 1.001}.get(name, 1.0)
    return stack_runs(runs, (), model.geometry.channel_names), model.system(theta)


@pytest.mark.parametrize("start", [None, {"sweep-Fz": 1e-5, "sweep-My": 1.0}, {"sweep-Fz": 0.5, "sweep-My": 1e-5}])
def test_chi_square_equals_its_degrees_of_freedom(lines, start):
    batches, system = lines
    before = fit_quality(batches, system, 0.0, (0.0, 100.0)).runs
    assert 1.02 < before["sweep-Fz"].chi2 / before["sweep-Fz"].dof < 2.0
    assert before["sweep-My"].chi2 / before["sweep-My"].dof > 100.0
    shares = estimate_model_error(batches, system, start)
    after = fit_quality(add_model_error(batches, shares), system, 0.0, (0.0, 100.0)).runs
    for run in before:
        assert after[run].chi2 / after[run].dof == pytest.approx(1.0, abs=0.01)
