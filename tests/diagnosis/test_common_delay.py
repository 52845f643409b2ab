"""A delay of all channels is told to look the same as loads that are early: they differ in wind-on loads alone."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.common_delay import judge_common_delay
from balance_cli.diagnosis.conclusions import alike_in_all
from balance_cli.diagnosis.result import EXPLAINED, PARTLY_EXPLAINED
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.model.fitted_effects import FittedParameter
from balance_cli.model.placed_effects import place_effect
from balance_cli.model.system_response import load_response
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.steps.identify import IdentifyOptions, identify
from tests.support.diagnosis_content import delay_effect, diagnosis
from tests.support.rigs import rotor_balance


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


@pytest.mark.parametrize(("place", "is_doubt"), [("strain", True), ("x.strain", False)])
def test_a_delay_that_loads_may_have_is_in_sigma_of_wind_on_loads(place: str, is_doubt: bool) -> None:
    """Loads 0.5 ms late made wind-on loads 7000 sigma off, of which nothing but the text of the diagnosis told."""
    effect = replace(delay_effect(), where=(place,), parameters=(FittedParameter("delay", -5e-4, 3e-8, "s"),))
    model = delayed_model(place)
    judged, updated = judge_common_delay(replace(diagnosis(EXPLAINED), effects=(effect,)), model)
    assert judged.verdict == (PARTLY_EXPLAINED if is_doubt else EXPLAINED)
    assert any(f"{effect.label} may as well be load-delay@all" in note for note in judged.notes) is is_doubt
    f, loads = np.array([20.0]), np.array([[0.0, 0.0, 3.0, 0.0, 4.0, 0.0]], complex)
    before, after = (ModelSource(item).covariance(f, 0.0, loads)[0] for item in (model, updated))
    read = load_response(ModelSource(model).system, f)[0] @ loads[0]
    turned = 2.0 * np.pi * 20.0 * 5e-4 * np.abs(np.concatenate([read.imag, read.real]))
    assert np.sqrt(np.diag(after - before)) == pytest.approx(turned * is_doubt, abs=1e-9)
