"""The checks that every effect must pass, the library's own and one that a reader of the manual has just written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache

import numpy as np

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import DeclaredEffect, Geometry
from balance_cli.campaign.rig.identity_cache import cached_by_identity
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.identified_model import IdentifiedModel, identified_system
from balance_cli.estimation.likelihood import data_chi2, data_curvature
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import BalanceModel, balance_model
from balance_cli.model.effects import Effect
from balance_cli.model.exciter_loads import true_load_derivatives, true_loads
from balance_cli.model.placed_effects import declared_effects, needs_mean
from balance_cli.model.response_jacobian import output_jacobian
from balance_cli.model.system import System
from balance_cli.model.system_response import response, solve
from balance_cli.simulation import (
    NO_NOISE,
    CampaignPlan,
    SweepPlan,
    TrueRig,
    draw_rig,
    short_plan,
    simulate_campaign,
    simulate_run,
    true_rig,
)
from balance_cli.simulation.preset_plans import HIGH_SWEEP_LEVELS, static_plans
from balance_cli.steps.identify import identified_effects, identify
from tests.support.exciter_response import exciter_response
from tests.support.rigs import rotor_balance


def _rig():
    """The rotor balance with piezos that forget sooner: their own start is gone before so short a record is used."""
    geometry = rotor_balance()
    channels = (
        c if c.time_constant is None else c.model_copy(update={"time_constant": 0.3}) for c in geometry.channels
    )
    return geometry.model_copy(update={"channels": tuple(channels)})


RIG = _rig()
KNOWN_MASS_RIG = RIG.model_copy(
    update={"tolerances": RIG.tolerances.model_copy(update={"mass": 0.0, "centre_of_gravity": 0.0, "inertia": 0.0})}
)
"""The same with a metric side of which mass, center of gravity and inertia are known."""
SPIN = 17.5
FREQUENCY = np.linspace(3.0, 149.0, 37)

# ---- at the null, and slopes -----------------------------------------------------------------------------------------


def model_with_effect(effect, where, at_null):
    """The rig with the effect, its parameters at their nulls or a good way from them."""
    parameters = {}
    for one in effect.parameters(RIG, where):
        fitted = one.fitted_start if one.nuisance else one.fitted_null + (0.0 if at_null else one.fitted_scale)
        value = one.physical_value(fitted)
        if np.isfinite(value):
            parameters[one.name] = float(value)
    declared = DeclaredEffect(name=effect.name, where=where, parameters=parameters)
    return balance_model(RIG.model_copy(update={"effects": (declared,)})).free_all_parameters()


def measured_response(system):
    return exciter_response(system, solve(system, FREQUENCY, SPIN))


def own_parameters(model: BalanceModel, effect: Effect) -> list[int]:
    """Which of the model's parameters are the effect's."""
    own = [i for i, name in enumerate(model.parameters.names) if name.startswith(effect.name)]
    assert own
    return own


@cache
def batches() -> tuple[Batch, ...]:
    """Two sweeps and a static run of the rig as declared, with noise, means and waveforms."""
    selected = short_plan().select_runs(["sweep-Fx", "sweep-Fz", "static-trim"])
    # Fewer steps do not tell the noise of the rows.
    steps = (run.model_copy(update={"steps": 5}) if run.kind == "static" else run for run in selected.runs)
    runs, _ = simulate_campaign(true_rig(RIG), selected.model_copy(update={"runs": tuple(steps)}), seed=2)
    spectra = measured_spectra(runs, RIG, means=True)
    return stack_runs(spectra.lines, spectra.statics, RIG.channel_names)


def check_null(effect, where):
    """At its null the effect leaves every response, and the likelihood of measured lines, as it is."""
    rigid, null = balance_model(RIG).system(), model_with_effect(effect, where, True).system()
    np.testing.assert_allclose(measured_response(null), measured_response(rigid), rtol=1e-8, atol=1e-14)
    np.testing.assert_allclose(data_chi2(batches(), null), data_chi2(batches(), rigid), rtol=1e-6)


def check_change(effect, where):
    """Away from its null it does not: one or the other is changed."""
    rigid, changed = balance_model(RIG).system(), model_with_effect(effect, where, False).system()
    one, other = measured_response(rigid), measured_response(changed)
    in_response = np.abs(other - one).max() > 1e-6 * np.abs(one).max()
    assert in_response or abs(data_chi2(batches(), changed) - data_chi2(batches(), rigid)) > 0.1


def check_derivatives(effect, where):
    """Slopes of the response by all of its parameters, and by some of the rig's, are the derivatives."""
    model = model_with_effect(effect, where, False)
    theta, scale = model.parameters.value, model.parameters.scale
    system = model.system(theta)
    rng = np.random.default_rng(0)
    loads = rng.standard_normal((len(FREQUENCY), 6)) + 1j * rng.standard_normal((len(FREQUENCY), 6))
    solution = solve(system, FREQUENCY, SPIN)
    recorded = (system, solution, np.arange(len(FREQUENCY)), loads, np.ones((len(FREQUENCY), 6), bool))
    slopes = output_jacobian(system, solution, np.arange(len(FREQUENCY)), true_loads(*recorded))
    of_loads = true_load_derivatives(*recorded)
    if of_loads is not None:
        acting, change = of_loads
        slopes[:, :, acting] += response(system, solution) @ change
    rigid = [model.parameters.index("stiffness.z1"), model.parameters.index("centre_of_gravity.z")]
    for i in [*own_parameters(model, effect), *rigid]:
        step = 1e-5 * scale[i] * np.eye(len(theta))[i]
        above, below = (
            np.einsum("kcj,kj->kc", measured_response(model.system(theta + s)), loads) for s in (step, -step)
        )
        numerical = (above - below) / (2e-5 * scale[i])
        size = max(np.abs(numerical).max(), 1e-9 * np.abs(above).max() / scale[i])
        np.testing.assert_allclose(slopes[:, :, i], numerical, atol=1e-4 * size, err_msg=model.parameters.names[i])


def check_likelihood_derivatives(effect, where):
    """The same of the likelihood of measured lines."""
    model = model_with_effect(effect, where, False)
    theta, scale = model.parameters.value, model.parameters.scale
    gradient = 2.0 * data_curvature(batches(), model.system(theta)).gradient
    for i in [*own_parameters(model, effect), model.parameters.index("stiffness.z1")]:
        step = 1e-4 * scale[i] * np.eye(len(theta))[i]
        above, below = (data_chi2(batches(), model.system(theta + s)) for s in (step, -step))
        numerical, name = (above - below) / 2e-4, model.parameters.names[i]
        np.testing.assert_allclose(gradient[i] * scale[i], numerical, rtol=1e-2, atol=1e-5 * above, err_msg=name)


# ---- recovery from simulated campaigns -------------------------------------------------------------------------------


def campaign(*components, spinning=False, periods=14, period=1.0):
    """Two static runs and a sweep of each of the components (all); `spinning`: two more with the rotor turning."""
    length = {"period": period, "periods": periods}
    sweeps = [
        SweepPlan(run=f"sweep-{name}", excited=(name,), level=(HIGH_SWEEP_LEVELS[name],), **length)
        for name in components or COMPONENTS
    ]
    if spinning:
        turning = {**length, "rotor_speed": SPIN}
        sweeps += [
            SweepPlan(run=f"spin-{n}", excited=(n,), level=(HIGH_SWEEP_LEVELS[n],), **turning) for n in ("Mx", "My")
        ]
    return CampaignPlan(runs=(*static_plans(), *sweeps))


@dataclass(frozen=True)
class TrueEffect:
    """An effect that a rig truly has: parameters as the simulation knows them, and how the rig gets it.

    `declared` is what a user declares of the effect to begin with; `bias`: the share of each parameter by which the
    estimate is known to be off, besides its sigma.

    `only_better`: the fitted effect is a description of what the rig has, so its parameters have no true values.
    """

    where: tuple[str, ...]
    parameters: dict[str, float | str]
    rig: Callable[[TrueRig], TrueRig]
    plan: CampaignPlan = field(default_factory=campaign)
    spin: float = 0.0
    geometry: Geometry = RIG
    declared: dict[str, float | str] = field(default_factory=dict)
    bias: float = 0.0
    only_better: bool = False


@dataclass(frozen=True)
class EffectRecovery:
    """What identification makes of a simulated campaign, without and with the effect."""

    truth: TrueEffect
    without: IdentifiedModel
    found: IdentifiedModel
    response_error: float

    @property
    def gain(self) -> float:
        """By how much the effect lowers chi-square."""
        return self.without.quality.chi2 - self.found.quality.chi2

    @property
    def normalized_errors(self) -> dict[str, float]:
        """Error of each parameter over its sigma, the known bias added to that; infinite where there is no sigma."""
        (effect,) = identified_effects(self.found)
        true = {item.name: float(self.truth.parameters.get(item.name, 0.0)) for item in effect.parameters}
        (placed,) = declared_effects(self.found.geometry)
        held = {item.name for item in placed.parameters if item.held}
        return {
            item.name: (item.value - true[item.name]) / np.hypot(item.sigma, self.truth.bias * true[item.name])
            if item.sigma
            else np.inf
            for item in effect.parameters
            if item.name not in held
        }


def recover_effect(name: str, truth: TrueEffect, seed: int) -> EffectRecovery:
    """Draw a rig, give it the effect, simulate, and identify the rig without and with it."""
    geometry, rigid = truth.geometry, drawn_rig(truth.geometry, seed)
    rig = truth.rig(rigid)
    runs, _ = simulate_campaign(rig, truth.plan, seed=seed)
    effect = DeclaredEffect(name=name, where=truth.where, parameters=truth.declared)
    with_effect = geometry.model_copy(update={"effects": (effect,)})
    spectra = measured_spectra(runs, with_effect)
    found = identify(spectra, with_effect)
    error = response_error(found, rig if shows_in_response(with_effect) else rigid, truth.spin)
    return EffectRecovery(truth, identify(spectra, geometry), found, error)


@cached_by_identity
def drawn_rig(geometry: Geometry, seed: int) -> TrueRig:
    """A rig without any effect."""
    rig = draw_rig(geometry, np.random.default_rng(seed))
    # A mode of a tenth of a per cent would ring through the whole of so short a record.
    damping = {"damping_ratios": np.maximum(rig.damping_ratios, 0.008)}
    return replace(rig, **damping, torque_damping_ratio=np.maximum(rig.torque_damping_ratio, 0.008))


def shows_in_response(geometry: Geometry) -> bool:
    """Whether the declared effects are in the response; others leave it that of the rig without them."""
    return not needs_mean(geometry)


@lru_cache(maxsize=1)
def _hold_out_plan() -> SweepPlan:
    levels = tuple(HIGH_SWEEP_LEVELS[name] for name in COMPONENTS)
    return SweepPlan(run="held-out", excited=COMPONENTS, level=levels, period=3.0, periods=8)


def response_error(model: IdentifiedModel, rig: TrueRig, spin: float) -> float:
    """Relative error from 5 to 150 Hz on a further run without noise, all components at once, each on lines of its own.

    Its last period is steady: what is recorded there is the rig's true response, whatever effect it has.
    """
    return response_difference(identified_system(model), _hold_out_run(rig, spin), _hold_out_plan().period, spin)


@cached_by_identity
def _hold_out_run(rig: TrueRig, spin: float) -> Run:
    """The further run: effects that no response shows have that of the same rig without any."""
    return simulate_run(rig, _hold_out_plan().model_copy(update={"rotor_speed": spin}), NO_NOISE)[0]


def response_difference(system: System, run: Run, period: float, spin: float) -> float:
    """What the last period of a run without noise and the system's own response differ by, relative, 5 to 150 Hz."""
    block, samples = run.read(), round(period * run.sample_rate)
    Y, U = (np.fft.rfft(signals[-samples:], axis=0) for signals in (block.channels, block.loads))
    frequency = np.fft.rfftfreq(samples, 1 / run.sample_rate)
    lines = np.flatnonzero((frequency >= 5) & (frequency <= 150))
    T = exciter_response(system, solve(system, frequency[lines], spin))
    error = Y[lines] - np.einsum("kcu,ku->kc", T, U[lines])
    return float(np.linalg.norm(error) / np.linalg.norm(Y[lines]))


def check_recovery(found: EffectRecovery, response_limit: float = 4e-4):
    """The effect explains the campaign, and its parameters are found within their sigma."""
    assert found.found.converged
    assert found.gain > 300.0
    assert 0.9 < found.found.quality.chi2_per_dof < 1.15
    assert found.response_error < response_limit
    assert set(found.normalized_errors) >= {
        name for name, value in found.truth.parameters.items() if not isinstance(value, str)
    }
    assert all(np.isfinite(departure) for departure in found.normalized_errors.values()), found.normalized_errors
    assert all(abs(departure) < 4.0 for departure in found.normalized_errors.values()), found.normalized_errors


def check_same_system(model: IdentifiedModel, loaded: IdentifiedModel, spin: float = SPIN):
    """A model that was saved and loaded answers as before."""
    one, other = (identified_system(each) for each in (model, loaded))
    assert one.channel_names == other.channel_names
    for system in (one, other):
        assert np.all(np.isfinite(exciter_response(system, solve(system, FREQUENCY, spin))))
    np.testing.assert_array_equal(*(exciter_response(s, solve(s, FREQUENCY, spin)) for s in (one, other)))
