"""What changed since an earlier calibration, against a known change."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.calibration.comparison import compare_calibrations
from balance_cli.calibration.temperature_terms import TemperatureTerms
from balance_cli.calibration.term_choice import LINEAR_TERMS
from balance_cli.campaign.recording.run import MemorySource
from balance_cli.cli.comparison_summary import comparison_summary, comparison_text
from balance_cli.io.errors import UserError
from balance_cli.steps.calibrate import calibrate
from tests.calibration.test_load_residuals import C, geometry, run


def calibrated(seed: int, gain: float = 1.0):
    """A calibration; the first channel reads `gain` times as much."""
    rig = geometry()
    made = run(rig, seed=seed)
    block = made.read()
    source = MemorySource(block.channels * [gain, 1.0, 1.0], block.loads)
    return calibrate([replace(made, source=source)], rig, choice=LINEAR_TERMS)


def test_an_unchanged_balance_has_not_changed() -> None:
    """Ten pairs: no more than one significant coefficient where 0.01 of the pairs have one by chance."""
    changed = [len(compare_calibrations(calibrated(2 * i), calibrated(2 * i + 1)).significant) for i in range(10)]
    assert sum(changed) <= 1


def test_a_changed_gain_is_found_with_its_worth_in_loads() -> None:
    """Channel 1 up 2 %: its N1 coefficient changes by 2 % of 1 mV/V, N1 of the older calibration by as much."""
    comparison = compare_calibrations(calibrated(1, gain=1.02), calibrated(2))
    first = comparison.significant[0]
    assert (first.channel, first.term) == ("B0", "N1")
    assert first.new - first.old == pytest.approx(0.02 * 1e-3, abs=4 * first.sigma)
    assert {change.channel for change in comparison.significant} == {"B0"}
    expected = np.linalg.inv(C) @ np.diag([1.02, 1, 1]) @ C - np.eye(3)
    assert expected[0, 0] > 0.019
    assert comparison.load_change["N1"] == pytest.approx(100 * expected[0, 0], abs=0.3)
    summary = comparison_summary(comparison, "old.h5")
    assert summary["changed"] == len(comparison.significant)
    text = "\n".join(comparison_text(comparison, "old.h5"))
    assert "B0 N1: " in text
    assert "coefficients changed significantly" in text


@pytest.mark.parametrize(
    ("terms", "factor", "is_changed"), [(("N1^2", "|N1^3|"), 1.0, False), (("N1^2", "N1^2"), 0.0, True)]
)
def test_the_choice_between_similar_terms_is_no_change(terms, factor, is_changed) -> None:
    """A coefficient of three times the noise, of another even term or gone; gone at forty times the noise it is one."""
    made = calibrated(1)
    model = made.all_trims.model
    size = np.sqrt(model.residual_covariance[0, 0]) * (40.0 if is_changed else 3.0)
    pair = [with_term(made, term, size * value) for term, value in zip(terms, (1.0, factor), strict=True)]
    changes = {(change.channel, change.term): change.is_significant for change in compare_calibrations(*pair).changes}
    assert changes["B0", terms[0]] == is_changed
    assert sum(changes.values()) == is_changed


def with_term(made, term, coefficient):
    """A calibration whose first channel has one more term, with the variance of its first coefficient."""
    model = made.all_trims.model
    b = np.vstack([model.coefficients, np.r_[coefficient, 0.0, 0.0]])
    covariance = np.pad(model.covariance, ((0, 0), (0, 1), (0, 1)))
    covariance[0, -1, -1] = covariance[0, 0, 0] if coefficient else 0.0
    more = replace(model, terms=(*model.terms, term), coefficients=b, covariance=covariance)
    return replace(made, all_trims=replace(made.all_trims, model=more))


def test_other_balances_are_refused() -> None:
    made = calibrated(1)
    with pytest.raises(UserError, match="no calibration model"):
        compare_calibrations(made, replace(made, all_trims=None))
    model = replace(made.all_trims.model, components=("a", "b", "c"))
    with pytest.raises(UserError, match="has the components a, b, c"):
        compare_calibrations(made, replace(made, all_trims=replace(made.all_trims, model=model)))


def test_sensitivities_are_compared_at_the_temperature_of_the_newer_calibration() -> None:
    """The older one was made 5 K colder; its sensitivity to N1 grows by 0.1 % of 1 mV/V a kelvin."""
    new, old = calibrated(1), calibrated(2)
    model = old.all_trims.model
    k, c = len(model.components), len(model.channel_names)
    drift = np.zeros((1 + k, c))
    drift[1, 0] = 1e-6 / model.calibrated_range[0]
    warm = TemperatureTerms(
        model.channel_names,
        model.components,
        drift,
        np.zeros((c, 1 + k, 1 + k)),
        drift,
        25.0,
        20.0,
        30.0,
        np.full(k, 25.0),
    )
    cold = replace(warm, reference=20.0, under_load=np.full(k, 20.0))
    before = compare_calibrations(new, old).changes
    after = compare_calibrations(replace(new, temperature=warm), replace(old, temperature=cold)).changes
    by_term = {(change.channel, change.term): change for change in before}
    for change in after:
        expected = 5e-6 if (change.channel, change.term) == ("B0", "N1") else 0.0
        assert change.old - by_term[change.channel, change.term].old == pytest.approx(expected, abs=1e-12)
