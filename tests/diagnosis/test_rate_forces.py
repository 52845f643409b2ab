"""Forces that depend on the rate of a cell: two rigs integrated by code of their own, at two scales of time."""

from dataclasses import replace
from functools import cache

import pytest

from balance_cli.diagnosis.result import EXPLAINED
from balance_cli.diagnosis.search.candidates import candidates
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.model.effects import EFFECTS
from balance_cli.model.placed_effects import add_effects
from balance_cli.steps.diagnose import diagnose
from balance_cli.steps.free_simulation import simulation_error
from balance_cli.steps.identify import identified_effects, identify
from tests.support.integrated_rigs import Law, heaving_rig, pitching_rig, steady_records
from tests.support.scaled import Scale

RIGS = {"heaving": heaving_rig(), "pitching": pitching_rig()}
SCALES = {"as it is": Scale(1.0, 1.0, 1.0), "slower, stronger, smaller": Scale(10.0, 1000.0, 0.1)}
TRUTH = {
    "quadratic-damping": {"c2": 300.0},
    "asymmetric-damping": {"difference": 20.0},
    "stribeck-friction": {"force": 0.8, "static_force": 2.0, "speed": 0.02, "stick_stiffness": 2e5},
    "asymmetric-friction": {"force": 1.5, "asymmetry": 0.3, "stick_stiffness": 2e5},
}
LAWS = {
    "quadratic-damping": Law(c2=300.0),
    "asymmetric-damping": Law(difference=20.0),
    "stribeck-friction": Law(stick=2e5, limit=2.0, fast=0.4, speed=0.02),
    "asymmetric-friction": Law(stick=2e5, limit=1.5, asymmetry=0.3),
}


@cache
def records(rig):
    return steady_records(RIGS[rig], LAWS, (1.0, 0.4), seed=3)


def scaled(rig, name, scale):
    """Geometry and runs in other units."""
    return scale.geometry(RIGS[rig].geometry), [scale.run(run) for run in records(rig)[name]]


def label(rig, name):
    return f"{name}@{RIGS[rig].geometry.cells[0].name}"


@pytest.mark.parametrize("name", TRUTH)
@pytest.mark.parametrize("rig", RIGS)
def test_parameters_are_the_true_ones_at_every_scale(rig, name):
    found = []
    for scale in SCALES.values():
        geometry, runs = scaled(rig, name, scale)
        linear = identify(measured_spectra(runs, geometry, means=True), geometry)
        with_effect = add_effects(geometry, [label(rig, name)])
        model = identify(measured_spectra(runs, with_effect), with_effect)
        assert model.converged
        assert 0.85 < model.quality.chi2_per_dof < 1.15 < 0.1 * linear.quality.chi2_per_dof
        (effect,) = identified_effects(model)
        for item in effect.parameters:
            truth = TRUTH[name][item.name] * scale.of(item.unit)
            assert abs(item.value - truth) < min(3.0 * item.sigma, 0.02 * abs(truth)), item.name
        if not found:
            errors = [simulation_error(runs[0], each, SETTINGS.free_simulation) for each in (linear, model)]
            assert errors[1] < 0.1 * errors[0]
        found.append([item.value / scale.of(item.unit) for item in effect.parameters])
    assert found[1] == pytest.approx(found[0], rel=1e-3)


@pytest.mark.parametrize(("rig", "scale"), list(zip(RIGS, SCALES, strict=True)))
def test_a_damper_that_nobody_declared_is_found(rig, scale):
    geometry, runs = scaled(rig, "quadratic-damping", SCALES[scale])
    spectra = measured_spectra(runs, geometry, means=True)
    diagnosis, updated = diagnose(identify(spectra, geometry), spectra)
    assert diagnosis.verdict == EXPLAINED
    (effect,) = diagnosis.effects
    assert effect.label == label(rig, "quadratic-damping")
    (c2,) = effect.parameters
    assert abs(c2.value - 300.0 * SCALES[scale].of(c2.unit)) < 3.0 * c2.sigma
    assert updated.quality.chi2_per_dof < 1.15


def test_effects_on_request_are_found_where_they_are_suspected_alone():
    rig, name = "heaving", "asymmetric-damping"
    on_request = {effect.name for effect in EFFECTS if effect.search.on_request}
    assert name in on_request
    geometry, runs = scaled(rig, name, SCALES["as it is"])
    assert not on_request & {candidate.effect.name for candidate in candidates(geometry)}
    spectra = measured_spectra(runs, geometry, means=True)
    suspected = replace(SETTINGS, suspected=(label(rig, name),))
    diagnosis, _ = diagnose(identify(spectra, geometry), spectra, settings=suspected)
    assert [effect.label for effect in diagnosis.effects] == [label(rig, name)]
    assert diagnosis.verdict == EXPLAINED
