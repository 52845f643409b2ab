"""Every effect of the library through the same checks: nothing at its null, exact slopes, found where it was simulated.

The campaigns come from the integration in time, which shares no code with the model that is fitted. Sizes are such that
forgetting the effect costs a chi-square of some thousands, of a few hundred thousand where it has many parameters.
"""

import ast
import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

import balance_cli
from balance_cli.campaign.recording.run_file import open_run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.cli import balance
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.estimation.likelihood import count_measured_values, data_chi2
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.io.artefacts import load_artefact, make_provenance, save_artefact
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.model.effects import EFFECTS
from balance_cli.model.placed_effects import add_effects, declared_effects, without_effects
from balance_cli.simulation import CampaignPlan, SweepPlan, true_rig
from balance_cli.simulation.extensions.base import Extension
from balance_cli.simulation.preset_plans import HIGH_SWEEP_LEVELS, static_plans
from balance_cli.simulation.rig import apply_effects
from balance_cli.steps.identify import identified_effects
from tests.support.effect_checks import (
    KNOWN_MASS_RIG,
    RIG,
    SPIN,
    TrueEffect,
    campaign,
    check_change,
    check_derivatives,
    check_likelihood_derivatives,
    check_null,
    check_recovery,
    check_same_system,
    recover_effect,
    response_difference,
)

PLACED = [(effect, where) for effect in EFFECTS for where in dict.fromkeys(effect.places(RIG)[i] for i in (0, -1))]
IDS = [f"{effect.name}@{','.join(where)}" for effect, where in PLACED]


@pytest.mark.parametrize(("effect", "where"), PLACED, ids=IDS)
def test_nothing_at_the_null(effect, where):
    check_null(effect, where)


@pytest.mark.parametrize(("effect", "where"), PLACED, ids=IDS)
def test_slopes_are_the_derivatives(effect, where):
    check_derivatives(effect, where)


@pytest.mark.parametrize(("effect", "where"), PLACED, ids=IDS)
def test_slopes_of_the_likelihood_are_the_derivatives(effect, where):
    check_likelihood_derivatives(effect, where)


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_it_does_something_away_from_its_null(effect):
    check_change(effect, effect.places(RIG)[0])


def test_no_effect_is_named_outside_its_file():
    """A search, a test of the data or a command that needs an effect finds it by its hints."""
    package = Path(balance_cli.__file__).parent
    files = {path.relative_to(package).as_posix(): path.read_text(encoding="utf-8") for path in package.rglob("*.py")}
    names = {effect.name for effect in EFFECTS}
    for name, text in files.items():
        if name.startswith(("model/effects/", "simulation/extensions/")) or not any(map(text.__contains__, names)):
            continue
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                assert node.value.split("@")[0] not in names, f"{name} names the effect {node.value}"


# ---- found in simulated campaigns ------------------------------------------------------------------------------------


def together(period=2.0, periods=8):
    """Two static runs and one sweep of all components, each on lines of its own: quicker than a sweep of each."""
    levels = {"excited": COMPONENTS, "level": tuple(HIGH_SWEEP_LEVELS[name] for name in COMPONENTS)}
    return CampaignPlan(runs=(*static_plans(), SweepPlan(run="sweep", period=period, periods=periods, **levels)))


def truth(name, where=(), *, plan=None, geometry=RIG, spin=0.0, bias=0.0, **parameters):
    """The effect of the simulation that has the same name; a choice is declared to begin with."""
    true = DeclaredEffect(name=name, where=where, parameters=parameters)
    plan = plan or (campaign(spinning=True) if spin else together())
    words = {name: value for name, value in parameters.items() if isinstance(value, str)}
    return TrueEffect(where, parameters, lambda rig: apply_effects(rig, [true]), plan, spin, geometry, words, bias)


@dataclass(frozen=True)
class Pendulum(Extension):
    """Something of `mass` [kg] that hangs on the hub and swings along x at `frequency` [Hz]: no effect of the library.

    It moves by s along x, and what holds it pulls at the hub.
    """

    name: ClassVar[str] = "pendulum"
    mass: float = 0.02
    frequency: float = 90.0
    damping_ratio: float = 0.02

    def mechanics(self, mechanics, geometry, rotor_speed):
        wide = mechanics.with_coordinates(("pendulum",))
        row = np.zeros((1, wide.size))
        row[0, -1] = -1.0
        row += wide.plate_displacement(geometry.hub)[:1]
        rate = 2 * np.pi * self.frequency
        wide.mass[-1, -1] = self.mass
        damping = wide.damping + 2 * self.damping_ratio * rate * self.mass * row.T @ row
        return replace(wide, damping=damping).with_springs(row, np.array([self.mass * rate**2]))


TRUTHS = {
    "support-flexibility": truth(
        "support-flexibility", ("x", "y"), mass=300.0, compliance_x=2e-9, compliance_y=3e-9, damping_ratio=0.03
    ),
    "mast-bending": truth(
        "mast-bending", ("x", "y"), mass=10.0, compliance_x=4e-9, compliance_y=6e-9, damping_ratio=0.02
    ),
    # With tolerances on the metric side an added mass is only another metric side: hardly any direction is left to it.
    "added-mass": truth("added-mass", mass=0.4, x=0.4, y=-0.3, z=0.6, geometry=KNOWN_MASS_RIG),
    "gyroscopic-coupling": truth("gyroscopic-coupling", polar_inertia=0.01, spin=SPIN),
    "gravity-stiffness": truth("gravity-stiffness", stiffness=900.0),
    "parallel-stiffness": truth(
        "parallel-stiffness", x=0.3, y=-0.2, z=0.2, stiffness_x=2e3, stiffness_y=1e3, stiffness_z=4e3, damping_time=1e-3
    ),
    "parallel-dashpot": truth("parallel-dashpot", x=0.3, y=-0.2, z=0.2, damping_x=20.0, damping_y=10.0, damping_z=30.0),
    "cell-misalignment": truth("cell-misalignment", ("z1",), angle_1=2e-4, angle_2=-3e-4),
    "cell-position": truth("cell-position", ("z1",), plan=together(), offset_1=2e-4, offset_2=-3e-4),
    "transverse-stiffness": truth("transverse-stiffness", ("all",), stiffness=500.0),
    "cell-dashpot": truth("cell-dashpot", ("z1",), damping=25.0),
    "viscous-damping": truth("viscous-damping", ("z1",), damping_time=2e-6),
    "structural-damping": truth("structural-damping", ("all",), loss_factor=6e-4, causality=1.0),
    "cubic-stiffness": truth("cubic-stiffness", ("x",), k3=3e11, side="inside"),
    "quadratic-stiffness": truth("quadratic-stiffness", ("z1",), k2=-3e8, side="beside"),
    "free-play": truth("free-play", ("x",), plan=campaign(periods=8), stiffness=2e4, gap=2e-6),
    # The elongations at which a contact turns round are read with noise: its force is off by 0.1 to 1 %, depending on
    # the record. Its sigma, which knows of the noise on the lines alone, is 0.05 to 0.08 % here.
    "dry-friction": truth(
        "dry-friction", ("x",), plan=campaign(periods=8), force=0.5, stick_stiffness=1.5e6, bias=0.005
    ),
    "stribeck-friction": truth(
        *("stribeck-friction", ("x",)),
        plan=campaign(periods=8),
        force=0.4,
        static_force=0.8,
        speed=1e-3,
        stick_stiffness=1.5e6,
        bias=0.005,
    ),
    "asymmetric-friction": truth(
        "asymmetric-friction",
        ("x",),
        plan=campaign(periods=8),
        force=0.5,
        asymmetry=0.3,
        stick_stiffness=1.5e6,
        bias=0.005,
    ),
    "quadratic-damping": truth("quadratic-damping", ("x",), plan=together(), c2=1000.0),
    "asymmetric-damping": truth("asymmetric-damping", ("x",), plan=together(), difference=20.0),
    "extra-mode": TrueEffect(
        ("Fx",),
        {},
        lambda rig: rig.with_extensions(Pendulum()),
        campaign("Fx"),
        declared={"frequency": 89.0},
        only_better=True,
    ),
    "channel-gain": truth("channel-gain", ("x.strain",), gain=1.001),
    "low-pass": truth("low-pass", ("x.strain",), cutoff=2e4),
    "high-pass": truth("high-pass", ("x.piezo",), cutoff=0.03),
    "time-delay": truth("time-delay", ("z1.piezo",), delay=1e-6),
    "crosstalk": truth("crosstalk", ("x.strain", "z1.strain"), fraction=1e-3),
    "saturation": truth("saturation", ("x.strain",), plan=together(), compression=0.08),
    "channel-nonlinearity": truth("channel-nonlinearity", ("x.strain",), plan=together(), quadratic=-0.02),
    "exciter-low-pass": truth("exciter-low-pass", ("Fy",), cutoff=2e4, natural_period=2e-4),
    "exciter-mass": truth("exciter-mass", ("Fz",), plan=campaign(), mass=0.02),
    "exciter-stiffness": truth("exciter-stiffness", ("Fz", "Fx"), plan=campaign(), stiffness=3e3),
    "load-gain": truth("load-gain", ("Fx",), gain=1.0005),
    "load-delay": truth("load-delay", ("Fy",), delay=-2e-6),
    "exciter-misalignment": truth("exciter-misalignment", ("Fz", "Fx"), fraction=2e-4),
    "exciter-position": truth("exciter-position", ("all",), x=2e-4, y=-3e-4, z=2.5e-4),
    "weight-misalignment": truth("weight-misalignment", ("Fz", "Fx"), fraction=2e-3),
    "load-offset": truth("load-offset", ("Fz",), offset=-1.5),
    "mains-pickup": truth("mains-pickup", ("x.strain",), amplitude=5e-4, frequency=50.0),
    "channel-offset": truth("channel-offset", ("z2.strain",), offset=0.004),
}
NAMES = tuple(effect.name for effect in EFFECTS)
CAUSES = [name for name in NAMES if name in TRUTHS and not TRUTHS[name].only_better]
"""Effects that something of the same name in the simulation is."""


@cache
def recovery(name):
    """The recovery of one effect, made once for all tests."""
    return recover_effect(name, TRUTHS[name], seed=1)


def test_every_effect_has_a_truth():
    assert sorted(TRUTHS) == sorted(NAMES)


@pytest.mark.parametrize("name", CAUSES)
def test_it_is_found_in_a_simulated_campaign(name):
    check_recovery(recovery(name))


@pytest.mark.parametrize("name", ["dry-friction", "mains-pickup", "channel-offset", "load-offset"])
def test_what_no_response_shows_is_known_to_a_tenth_and_explains_the_rest(name):
    model, true = recovery(name).found, TRUTHS[name].parameters
    (effect,) = identified_effects(model)
    assert all(item.sigma < 0.1 * abs(true[item.name]) for item in effect.parameters)
    # What turns round is read with noise: see the truth of dry friction.
    assert model.quality.chi2_per_dof < (1.15 if name == "dry-friction" else 1.02)


@pytest.mark.parametrize("name", [name for name in NAMES if name in TRUTHS and TRUTHS[name].only_better])
def test_what_has_no_cause_in_the_library_is_described(name):
    found = recovery(name)
    assert found.found.converged
    assert found.found.quality.chi2_per_dof < 0.25 * found.without.quality.chi2_per_dof


@pytest.mark.parametrize("name", [name for name in NAMES if name in TRUTHS])
def test_a_saved_model_is_the_same_system(name, tmp_path):
    model, path = recovery(name).found, tmp_path / "model.h5"
    save_artefact(path, "balance-model/1", model, make_provenance("test", {}, ()))
    loaded = load_artefact(path, {"balance-model/1": IdentifiedModel}).content
    check_same_system(model, loaded)


# ---- declared, and simulated by the command --------------------------------------------------------------------------

# The simulation realises a loss factor by a Maxwell chain: within some per cent of its damping.
CHAIN_ERROR = 1e-3


def simulated_as_declared(name, folder, period, *noise):
    """The geometry with the effect of a truth, and the sweep that `balance simulate` makes of it."""
    known = TRUTHS[name]
    declared = DeclaredEffect(name=name, where=known.where, parameters=known.parameters)
    geometry = RIG.model_copy(update={"effects": (declared,)})
    run = {
        "run": "s",
        "kind": "sweep",
        "excited": list(HIGH_SWEEP_LEVELS),
        "level": list(HIGH_SWEEP_LEVELS.values()),
        "rotor_speed": known.spin,
    }
    (folder / "geometry.yaml").write_text(yaml.safe_dump(json.loads(geometry.model_dump_json(exclude_none=True))))
    (folder / "plan.yaml").write_text(yaml.safe_dump({"runs": [{**run, "period": period, "periods": 8}]}))
    words = ["simulate", "-g", folder / "geometry.yaml", "--plan", folder / "plan.yaml", "-o", folder / "out", *noise]
    result = CliRunner().invoke(balance, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return geometry, open_run(folder / "out" / "s.h5")


IN_RESPONSE = [effect.name for effect in EFFECTS if effect.name in CAUSES and not effect.needs_mean]


@pytest.mark.parametrize("name", IN_RESPONSE)
def test_simulate_takes_it_as_declared(name, tmp_path):
    geometry, run = simulated_as_declared(name, tmp_path, 3.0, "--noise", "0", "--float64")
    error = response_difference(balance_model(geometry).system(), run, 3.0, TRUTHS[name].spin)
    assert error < (CHAIN_ERROR if name == "structural-damping" else 1e-5)


@pytest.mark.parametrize("name", [name for name in CAUSES if name not in IN_RESPONSE])
def test_simulate_takes_what_no_response_shows_as_declared(name, tmp_path):
    """Nothing but noise is left of the run under the model as declared, and more than noise without the effect."""
    geometry, run = simulated_as_declared(name, tmp_path, 1.0)
    spectra = measured_spectra([run], geometry)
    lines = stack_runs(spectra.lines, (), geometry.channel_names)
    declared, without = (data_chi2(lines, balance_model(one).system()) for one in (geometry, without_effects(geometry)))
    assert declared < 1.1 * count_measured_values(lines)
    assert without > declared + 50.0


def test_what_has_no_cause_is_not_simulated(tmp_path):
    geometry = add_effects(RIG, ["extra-mode@Fx"])
    with pytest.raises(UserError, match="no effect `extra-mode` to simulate"):
        apply_effects(true_rig(geometry), geometry.effects)


# ---- declared --------------------------------------------------------------------------------------------------------


def test_unknown_effects_and_places_name_the_nearest():
    with pytest.raises(UserError, match="channel-gain"):
        declared_effects(add_effects(RIG, ["chanel-gain@x.strain"]))
    with pytest.raises(UserError, match=r"x\.strain"):
        declared_effects(add_effects(RIG, ["channel-gain@x.strian"]))


def test_the_order_of_declaration_does_not_matter():
    one = add_effects(RIG, ["time-delay@x.piezo", "transverse-stiffness@all"])
    other = add_effects(RIG, ["transverse-stiffness@all", "time-delay@x.piezo"])
    assert [item.label for item in declared_effects(one)] == [item.label for item in declared_effects(other)]
