"""Effects at larger places than needed: their needless motions are removed together, by one refit."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.selection import effect_selection
from balance_cli.diagnosis.selection.effect_selection import narrow_places, refit_without_effect
from balance_cli.diagnosis.selection.effect_statistics import effect_wald_statistic
from balance_cli.diagnosis.selection.fit import fit_all_lines
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from balance_cli.estimation.identifiability import covariance_from_information
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import balance_model
from balance_cli.model.placed_effects import declared_effects
from tests.estimation.test_likelihood import noisy_lines
from tests.support.rigs import rotor_balance

COMPLIANCE = 4e-8


def _support(*motions: str, **compliances: float) -> DeclaredEffect:
    values = {"mass": 200.0, "damping_ratio": 0.02, **{f"compliance_{name}": v for name, v in compliances.items()}}
    return DeclaredEffect(name="support-flexibility", where=motions, parameters=values)


@pytest.fixture(scope="module")
def wide():
    """Three motions of a support fitted to the lines of a rig of which one is flexible; few steps."""
    rig = rotor_balance()
    truth = rig.model_copy(update={"effects": (_support("z", z=COMPLIANCE),)})
    rng = np.random.default_rng(3)
    lines = [
        replace(noisy_lines(truth, rng, components), run=components[0]) for components in (("Fx", "My"), ("Fz", "Mx"))
    ]
    batches = stack_runs(lines, [], rig.channel_names)
    model = balance_model(rig.model_copy(update={"effects": (_support("x", "y", "z", x=1e-9, y=1e-9, z=COMPLIANCE),)}))
    return fit_all_lines(model.at(), batches, SETTINGS.fit, 4), batches


def test_needless_motions_are_removed_by_one_refit(wide, monkeypatch):
    fit, batches = wide
    refits = []

    def counted(*arguments):
        refits.append(fit_all_lines(*arguments))
        return refits[-1]

    monkeypatch.setattr(effect_selection, "fit_all_lines", counted)
    narrow, trials = narrow_places(fit, batches, 1, SETTINGS)
    (effect,) = declared_effects(narrow.model.geometry)
    assert effect.label == "support-flexibility@z"
    assert len(refits) == len(trials) == 1
    assert narrow.chi2 - fit.chi2 < 20.0
    fitted = dict(zip(narrow.model.parameters.names, narrow.theta, strict=True))
    assert fitted["support-flexibility@z.compliance_z"] == pytest.approx(COMPLIANCE, rel=0.05)


def test_where_something_is_lost_together_motions_are_removed_one_by_one(wide, monkeypatch):
    """Wald's statistic may take for needless what a refit needs: then nothing is removed that a refit misses."""
    fit, batches = wide
    monkeypatch.setattr(effect_selection, "_smallest_place", lambda *_: ("x",))
    monkeypatch.setattr(effect_selection, "fit_all_lines", lambda *arguments: fit_all_lines(*arguments, 4))
    narrow, trials = narrow_places(fit, batches, 1, SETTINGS)
    (effect,) = declared_effects(narrow.model.geometry)
    assert "z" in effect.where
    assert [trial.decision for trial in trials] == ["narrowed"] * len(trials)


def test_a_refit_without_an_effect_is_made_once_for_a_fit_its_lines_and_settings(wide, monkeypatch):
    fit, batches = wide
    fit, fits = replace(fit, reduced={}), []

    def counted(start, batches, settings, iterations=1):
        fits.append(len(batches))
        return fit_all_lines(start, batches, settings, iterations)

    monkeypatch.setattr(effect_selection, "fit_all_lines", counted)
    (support,) = declared_effects(fit.model.geometry)
    first = refit_without_effect(fit, support, batches, SETTINGS.fit)
    assert refit_without_effect(fit, support, list(batches), SETTINGS.fit) is first
    assert not declared_effects(first.model.geometry)
    coarse = replace(SETTINGS.fit, comparison_tolerance=1.0)
    assert refit_without_effect(fit, support, batches, coarse) is not first
    others = [replace(batch) for batch in batches]
    assert refit_without_effect(fit, support, others, coarse) is not first
    assert len(fits) == 3


def test_an_effect_that_a_stopped_fit_left_off_its_null_is_needless():
    """Forty sigma from the null, where the fit stopped: its minimum is at the null all the same."""
    rig = rotor_balance()
    batches = stack_runs([noisy_lines(rig, np.random.default_rng(5), ("Fx", "My", "Fz"))], [], rig.channel_names)
    gain = DeclaredEffect(name="channel-gain", where=("x.strain",), parameters={"gain": 1.0})
    model = balance_model(rig.model_copy(update={"effects": (gain,)}))
    fit = fit_all_lines(model.at(), batches, SETTINGS.fit)
    (effect,) = declared_effects(model.geometry)
    (item,) = effect.parameters
    place = model.parameters.index(effect.full_name(item))
    variance = np.diag(covariance_from_information(fit.minimum.total.information))
    moved = fit.theta.copy()
    moved[place] = 1.0 + 40.0 * np.sqrt(variance[np.flatnonzero(model.parameters.free) == place][0])
    stopped = fit_all_lines(model.at(moved), batches, SETTINGS.fit, 0)
    assert not stopped.minimum.converged
    as_it_stands = replace(stopped, minimum=replace(stopped.minimum, converged=True))
    assert effect_wald_statistic(as_it_stands, effect)[0] > 1000.0
    assert effect_wald_statistic(stopped, effect)[0] == pytest.approx(effect_wald_statistic(fit, effect)[0], abs=2.0)
    assert effect_wald_statistic(fit, effect)[0] < 10.0
