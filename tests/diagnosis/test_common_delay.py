"""A delay of all channels is told to look the same as loads that are early: they differ in wind-on loads alone."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.alike_effects import alike_in_all
from balance_cli.diagnosis.common_delay import judge_common_delay
from balance_cli.diagnosis.result import EXPLAINED, PARTLY_EXPLAINED, FoundEffect
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.model.fitted_effects import FittedParameter
from balance_cli.model.placed_effects import place_effect
from balance_cli.model.system_response import load_response
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.steps.identify import IdentifyOptions, identify
from tests.support.diagnosis_content import delay_effect, diagnosis
from tests.support.rigs import one_degree_of_freedom, rotor_balance, two_degrees_of_freedom


def strain_only() -> Geometry:
    content = rotor_balance().model_dump(mode="json", exclude_none=True)
    content["channels"] = [channel for channel in content["channels"] if "strain" in channel["name"]]
    del content["torque_meter"]
    return Geometry.model_validate(content)


@pytest.mark.parametrize(
    ("geometry", "name", "place", "is_common"),
    [
        (rotor_balance(), "time-delay", "all", True),
        (strain_only(), "time-delay", "strain", True),
        (rotor_balance(), "time-delay", "strain", False),
        (rotor_balance(), "time-delay", "x.piezo", False),
        (rotor_balance(), "channel-gain", "strain", False),
        (rotor_balance(), "exciter-low-pass", "all", True),
        (rotor_balance(), "exciter-low-pass", "Fx", False),
        (rotor_balance(), "low-pass", "all", True),
    ],
)
def test_a_delay_of_all_channels_may_be_one_of_the_loads(
    geometry: Geometry, name: str, place: str, is_common: bool
) -> None:
    """Loads 3 ms late were a delay of -3 ms of all channels, which turns 1/rev by 20 deg, without an alternative."""
    alike = alike_in_all(place_effect(name, (place,), geometry), geometry)
    assert (alike is not None) is is_common
    if alike is not None:
        name, place = alike.label.split("@")
        assert place_effect(name, (place,), geometry).label == alike.label and alike.label in alike.separated_by


def delayed_model(place: str) -> IdentifiedModel:
    """The declared balance, whose channels at a place are 0.5 ms early."""
    effect = {"name": "time-delay", "where": [place], "parameters": {"delay": -5e-4}}
    content = strain_only().model_dump(mode="json", exclude_none=True) | {"effects": [effect]}
    rig, nothing = Geometry.model_validate(content), Spectra((), (), {}, {})
    model = identify(nothing, rig, IdentifyOptions(method="computed"))
    free = np.array([1e-3 if name.endswith(".delay") else 0.0 for name in model.parameters.names])
    return replace(model, parameters=replace(model.parameters, declared_sigma=free))


def test_where_not_all_is_explained_an_effect_of_all_cells_may_be_one_of_the_loads() -> None:
    """Exciters that lag differently were a low-pass of all cells, but not of the torque meter, beside a large error.

    The sweeps of the exciter that had this lag were described; its wind-on loads were 11 sigma off, unflagged.
    """
    content = rotor_balance().model_dump(mode="json", exclude_none=True)
    content["channels"] = [channel for channel in content["channels"] if "piezo" not in channel["name"]]
    for geometry, is_common in ((rotor_balance(), False), (Geometry.model_validate(content), True)):
        placed = place_effect("low-pass", ("strain",), geometry)
        assert alike_in_all(placed, geometry) is None
        assert (alike_in_all(placed, geometry, is_good=False) is not None) is is_common


@pytest.mark.parametrize(
    ("place", "is_doubt", "misfit"), [("strain", True, 1.0), ("x.strain", False, 1.0), ("strain", True, 400.0)]
)
def test_a_delay_that_loads_may_have_is_in_sigma_of_wind_on_loads(place: str, is_doubt: bool, misfit: float) -> None:
    """Loads 0.5 ms late made wind-on loads 7000 sigma off, of which nothing but the text of the diagnosis told.

    With a model that does not fit, whose variances are enlarged, the difference had been enlarged, too.
    """
    effect = replace(delay_effect(), where=(place,), parameters=(FittedParameter("delay", -5e-4, 3e-8, "s"),))
    model = delayed_model(place)
    model = replace(model, iterations=1, quality=replace(model.quality, chi2=misfit, dof=1.0))
    judged, updated = judge_common_delay(replace(diagnosis(EXPLAINED), effects=(effect,)), model)
    assert judged.verdict == (PARTLY_EXPLAINED if is_doubt else EXPLAINED)
    assert any(f"{effect.label} may as well be load-delay@all" in note for note in judged.notes) is is_doubt
    f, loads = np.array([20.0]), np.array([[0.0, 0.0, 3.0, 0.0, 4.0, 0.0]], complex)
    before, after = (ModelSource(item).covariance(f, 0.0, loads)[0] for item in (model, updated))
    read = load_response(ModelSource(model).system, f)[0] @ loads[0]
    turned = 2.0 * np.pi * 20.0 * 5e-4 * np.abs(np.concatenate([read.imag, read.real]))
    assert np.sqrt(np.diag(after - before)) == pytest.approx(turned * is_doubt, abs=1e-9)


def test_a_low_pass_of_exciters_that_channels_may_have_is_in_sigma_of_wind_on_loads() -> None:
    """Channels that lag instead read H T f of loads f: those of the model are H f, off by 1 - 1/H of themselves."""
    declared = {"name": "exciter-low-pass", "where": ["all"], "parameters": {"cutoff": 30.0, "natural_period": 0.02}}
    content = strain_only().model_dump(mode="json", exclude_none=True) | {"effects": [declared]}
    model = identify(Spectra((), (), {}, {}), Geometry.model_validate(content), IdentifyOptions(method="computed"))
    effect = FoundEffect("exciter-low-pass", ("all",), (), delay_effect().evidence)
    judged, updated = judge_common_delay(replace(diagnosis(EXPLAINED), effects=(effect,)), model)
    assert judged.verdict == PARTLY_EXPLAINED and "may as well be low-pass@all" in judged.notes[-1]
    f, loads = np.array([20.0]), np.array([[0.0, 0.0, 3.0, 0.0, 4.0, 0.0]], complex)
    before, after = (ModelSource(item).covariance(f, 0.0, loads)[0] for item in (model, updated))
    off = (1j * 20.0 / 30.0 - (20.0 * 0.02) ** 2) * load_response(ModelSource(model).system, f)[0] @ loads[0]
    assert np.sqrt(np.diag(after - before)) == pytest.approx(np.abs(np.concatenate([off.real, off.imag])), rel=1e-6)


def test_a_delay_of_the_only_load_may_be_one_of_the_channels() -> None:
    """On a rig of one component it had been a cause, and loads by it 6317 standard deviations wrong."""
    rig = one_degree_of_freedom()
    for name in ("load-delay", "exciter-low-pass"):
        assert alike_in_all(place_effect(name, ("Fz",), rig), rig) is not None
    both = two_degrees_of_freedom()
    assert alike_in_all(place_effect("load-delay", ("Fz",), both), both) is None


def test_a_delay_of_the_only_load_that_was_swept_may_be_one_of_the_channels() -> None:
    """It had been a cause on rigs of several components. Channels that lag turn loads that no sweep applied, too."""
    rig = two_degrees_of_freedom()
    placed = place_effect("load-delay", ("Fz",), rig)
    assert alike_in_all(placed, rig, swept={"Fz"}) is not None
    assert alike_in_all(placed, rig, swept={"Fz", "Fx", "My"}) is None and alike_in_all(placed, rig, swept=()) is None
    content = strain_only().model_dump(mode="json", exclude_none=True)
    content |= {"effects": [{"name": "load-delay", "where": ["Fz"], "parameters": {"delay": 5e-4}}]}
    model = identify(Spectra((), (), {}, {}), Geometry.model_validate(content), IdentifyOptions(method="computed"))
    effect = FoundEffect("load-delay", ("Fz",), (), delay_effect().evidence)
    found = replace(diagnosis(EXPLAINED), effects=(effect,))
    judged, updated = judge_common_delay(found, model, {"Fz"})
    assert judged.verdict == PARTLY_EXPLAINED and "may as well be time-delay@all" in judged.notes[-1]
    assert judge_common_delay(found, model, {"Fz", "Fx"})[0].verdict == EXPLAINED
    f, loads = np.array([20.0]), np.array([[3.0, 0.0, 0.0, 0.0, 0.0, 0.0]], complex)
    before, after = (ModelSource(item).covariance(f, 0.0, loads)[0] for item in (model, updated))
    read = load_response(ModelSource(model).system, f)[0] @ loads[0]
    off = (np.exp(-2j * np.pi * 20.0 * 5e-4) - 1.0) * read
    assert np.sqrt(np.diag(after - before)) == pytest.approx(np.abs(np.concatenate([off.real, off.imag])), rel=1e-6)
