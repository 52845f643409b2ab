"""An effect whose parameters may be anything is no explanation: a support of 5e7 +- 7e7 kg had been one."""

from dataclasses import replace

import pytest

from balance_cli.diagnosis.data_test_settings import UnidentifiableSettings
from balance_cli.diagnosis.result import EXPLAINED, PARTLY_EXPLAINED
from balance_cli.diagnosis.unidentifiable_effects import judge_unidentifiable_effects
from balance_cli.model.fitted_effects import FittedParameter
from balance_cli.model.placed_effects import place_effect
from tests.support.diagnosis_content import delay_effect, diagnosis, support_effect


@pytest.mark.parametrize(
    ("mass", "sigma", "is_known"),
    [(5e7, 7e7, False), (3e5, 4e5, False), (512.0, 23.0, True), (900.0, 400.0, True), (5e7, 1e6, True)],
)
def test_a_support_of_any_mass_explains_nothing(mass: float, sigma: float, is_known: bool) -> None:
    effect = support_effect()
    parameters = (replace(effect.parameters[0], interval=None), FittedParameter("mass", mass, sigma, "kg"))
    found = replace(diagnosis(EXPLAINED), effects=(replace(effect, parameters=parameters), delay_effect()))
    judged = judge_unidentifiable_effects(found, UnidentifiableSettings())
    assert judged.verdict == (EXPLAINED if is_known else PARTLY_EXPLAINED)
    assert any("do not determine mass" in note for note in judged.notes) is not is_known


def test_the_rule_holds_for_any_effect() -> None:
    """By the scale of its own parameters."""
    found = diagnosis(EXPLAINED)
    effect = delay_effect()
    (delay,) = place_effect(effect.name, effect.where, found.geometry).parameters
    for size, is_known in ((1.0, True), (300.0, False)):
        parameter = FittedParameter("delay", size * delay.scale, size * delay.scale, "s")
        judged = judge_unidentifiable_effects(
            replace(found, effects=(replace(effect, parameters=(parameter,)),)), UnidentifiableSettings()
        )
        assert (judged.verdict == EXPLAINED) is is_known


def test_a_contact_that_slips_all_the_time_needs_no_stiffness() -> None:
    """Its force is told; as measured on a positioning axis, 19.4 +- 2.2 N and 3.3e6 +- 5.6e6 N/m."""
    found = diagnosis(EXPLAINED)
    parameters = (FittedParameter("force", 19.4, 2.2, "N"), FittedParameter("stick_stiffness", 3.3e9, 5.6e9, "N/m"))
    effect = replace(delay_effect(), name="dry-friction", where=("x",), parameters=parameters)
    judged = judge_unidentifiable_effects(replace(found, effects=(effect,)), UnidentifiableSettings())
    assert judged.verdict == EXPLAINED and judged.notes == found.notes
