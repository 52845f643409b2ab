"""An effect beside a residual that no effect explains is doubtful where parts of the records disagree on it."""

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.selection.doubt import doubtful_effects
from balance_cli.diagnosis.selection.fit import fit_all_lines
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import balance_model
from balance_cli.model.modes import modes
from tests.support.model_lines import model_lines
from tests.support.rigs import two_degrees_of_freedom

RIG = two_degrees_of_freedom()
CHANNEL = RIG.channel_names[0]
LOWEST = float(modes(balance_model(RIG).system(balance_model(RIG).parameters.value)).frequency.min())
SUPPORT = DeclaredEffect(
    name="support-flexibility",
    where=("z",),
    parameters={
        "mass": 3.0 * RIG.bodies[0].mass,
        "compliance_z": 0.03 / sum(cell.stiffness for cell in RIG.cells),
        "damping_ratio": 0.02,
    },
)


def fit_with(effect, *true_effects, noise=1e-4):
    """The fit of the rig with one effect to sweeps of the rig with others, and the lines."""
    truth, rng = balance_model(RIG.model_copy(update={"effects": true_effects})), np.random.default_rng(3)
    frequency = np.linspace(0.1, 2.0, 200) * LOWEST
    runs = [model_lines(truth, name, i, frequency, noise, rng) for name, i in (("Fz", 2), ("My", 4))]
    batches = stack_runs(runs, (), RIG.channel_names)
    model = balance_model(RIG.model_copy(update={"effects": (effect,)}))
    return fit_all_lines(model.at(), batches, DEFAULT_SETTINGS.fit), batches


def delay(periods):
    return DeclaredEffect(name="time-delay", where=(CHANNEL,), parameters={"delay": periods / LOWEST})


def gain(value):
    return DeclaredEffect(name="channel-gain", where=(CHANNEL,), parameters={"gain": value})


@pytest.mark.parametrize(("effect", "null"), [(delay(0.05), delay(0.0)), (gain(1.2), gain(1.0))])
def test_an_effect_that_is_there_is_not_doubted_beside_a_support_that_nobody_fits(effect, null):
    fit, batches = fit_with(null, SUPPORT, effect)
    assert fit.minimum.data.chi2 > 50.0 * sum(batch.lines.count.sum() for batch in batches)
    assert doubtful_effects(fit, {effect.name + "@" + CHANNEL}, batches, DEFAULT_SETTINGS.selection) == ()


@pytest.mark.parametrize("null", [delay(0.0), gain(1.0)])
def test_an_effect_that_takes_up_a_residual_is_doubted(null):
    """By its own sigma, which takes the model for right, it is hundreds of sigma off its null."""
    fit, batches = fit_with(null, SUPPORT)
    label = f"{null.name}@{CHANNEL}"
    name = f"{label}.{next(iter(null.parameters))}"
    departure = fit.theta[fit.model.parameters.index(name)] - next(iter(null.parameters.values()))
    free = [
        item for item, is_free in zip(fit.model.parameters.names, fit.model.parameters.free, strict=True) if is_free
    ]
    sigma = np.linalg.inv(fit.minimum.total.information)[free.index(name), free.index(name)] ** 0.5
    assert abs(departure) > 10.0 * sigma
    assert doubtful_effects(fit, {label}, batches, DEFAULT_SETTINGS.selection) == (label,)


def test_an_effect_of_a_model_that_fits_is_not_doubted():
    fit, batches = fit_with(delay(0.0), delay(0.05))
    assert doubtful_effects(fit, {f"time-delay@{CHANNEL}"}, batches, DEFAULT_SETTINGS.selection) == ()
