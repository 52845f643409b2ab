"""Every effect of the library through the same checks: nothing at its null, exact slopes, found in a simulated campaign.

The campaigns come from the integration in time, which shares no code with the model that is fitted. Sizes are such that
forgetting the effect costs a chi-square of some thousands, of a few hundred thousand where it has many parameters.
"""

from functools import cache

import numpy as np
import pytest
from effect_checks import (
    FREQUENCY,
    RIG,
    SPIN,
    Truth,
    campaign,
    check_change,
    check_null,
    check_recovery,
    check_same_system,
    check_slopes,
    recovered,
)

from balance_cli.artefacts import load_artefact, provenance_now, save_artefact
from balance_cli.effects import EFFECTS
from balance_cli.errors import UserError
from balance_cli.geometry import DeclaredEffect
from balance_cli.identified import IdentifiedModel
from balance_cli.model.placed_effects import add_effects, declared_effects
from balance_cli.simulation.extensions import apply_effects

PLACED = [(effect, where) for effect in EFFECTS for where in dict.fromkeys(effect.places(RIG)[i] for i in (0, -1))]
IDS = [f"{effect.name}@{','.join(where)}" for effect, where in PLACED]


@pytest.mark.parametrize(("effect", "where"), PLACED, ids=IDS)
def test_nothing_at_the_null(effect, where):
    check_null(effect, where)


@pytest.mark.parametrize(("effect", "where"), PLACED, ids=IDS)
def test_slopes_are_the_derivatives(effect, where):
    check_slopes(effect, where)


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_it_does_something_away_from_its_null(effect):
    check_change(effect, effect.places(RIG)[0])


# ---- found in simulated campaigns ------------------------------------------------------------------------------------


def truth(name, where=(), *, plan=None, spin=0.0, **parameters):
    """The effect of the simulation that has the same name."""
    declared = DeclaredEffect(name=name, where=where, parameters=parameters)
    plan = plan or campaign(spinning=spin > 0)
    return Truth(where, parameters, lambda rig: apply_effects(rig, [declared]), plan, spin)


def hidden_mast():
    """A light hub on a soft mast, which the fitted model is told nothing about: it looks for a mode without a cause."""
    declared = DeclaredEffect(
        name="mast-bending", where=("x",), parameters={"mass": 1.0, "compliance_x": 3e-6, "damping_ratio": 0.02}
    )
    return Truth(("Fx",), {}, lambda rig: apply_effects(rig, [declared]), only_better=True)


TRUTHS = {
    "support-flexibility": truth(
        "support-flexibility", ("x", "y"), mass=300.0, compliance_x=2e-8, compliance_y=3e-8, damping_ratio=0.03
    ),
    "mast-bending": truth(
        "mast-bending", ("x", "y"), mass=10.0, compliance_x=4e-9, compliance_y=6e-9, damping_ratio=0.02
    ),
    "added-mass": truth("added-mass", mass=0.4, x=0.4, y=-0.3, z=0.6),
    "gyroscopic-coupling": truth("gyroscopic-coupling", polar_inertia=0.01, spin=SPIN),
    "parallel-stiffness": truth(
        "parallel-stiffness", x=0.3, y=-0.2, z=0.2, stiffness_x=2e4, stiffness_y=1e4, stiffness_z=4e4, damping_time=1e-4
    ),
    "cell-misalignment": truth("cell-misalignment", ("z1",), angle_1=2e-4, angle_2=-3e-4),
    "transverse-stiffness": truth("transverse-stiffness", ("all",), stiffness=500.0),
    "structural-damping": truth("structural-damping", ("all",), loss_factor=6e-4),
    "extra-mode": hidden_mast(),
    "channel-gain": truth("channel-gain", ("x.strain",), gain=1.001),
    "low-pass": truth("low-pass", ("x.strain",), cutoff=2e4),
    "high-pass": truth("high-pass", ("x.piezo",), cutoff=0.02),
    "time-delay": truth("time-delay", ("z1.piezo",), delay=1e-6),
    "crosstalk": truth("crosstalk", ("x.strain", "z1.strain"), fraction=1e-3),
    "exciter-misalignment": truth("exciter-misalignment", ("Fz", "Fx"), fraction=2e-4),
}
NAMES = tuple(effect.name for effect in EFFECTS)


@cache
def recovery(name):
    """The recovery of one effect, made once for all tests."""
    return recovered(name, TRUTHS[name], seed=1)


def test_every_effect_has_a_truth():
    assert sorted(TRUTHS) == sorted(NAMES)


@pytest.mark.parametrize("name", [name for name in NAMES if name in TRUTHS and not TRUTHS[name].only_better])
def test_it_is_found_in_a_simulated_campaign(name):
    check_recovery(recovery(name))


@pytest.mark.parametrize("name", [name for name in NAMES if name in TRUTHS and TRUTHS[name].only_better])
def test_what_has_no_cause_in_the_library_is_described(name):
    found = recovery(name)
    assert found.found.converged
    assert found.found.quality.chi2_per_dof < 0.05 * found.without.quality.chi2_per_dof


@pytest.mark.parametrize("name", [name for name in NAMES if name in TRUTHS])
def test_a_saved_model_is_the_same_system(name, tmp_path):
    model, path = recovery(name).found, tmp_path / "model.h5"
    save_artefact(path, "balance-model/1", model, provenance_now("test", {}, ()))
    loaded = load_artefact(path, {"balance-model/1": IdentifiedModel}).content
    check_same_system(model, loaded)


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
