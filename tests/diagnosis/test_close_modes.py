"""A fit of the search goes on where two modes of different damping have to exchange their order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from balance_cli.diagnosis.search import refit
from balance_cli.diagnosis.search.refit import fit_until_stable
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.diagnosis.search.unmodelled_modes import add_resonance_by_whole_fit
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.estimation.mode_crossings import plate_frequencies
from balance_cli.model.balance import Estimate, balance_model
from balance_cli.model.placed_effects import declared_effects
from balance_cli.simulation import CampaignPlan, SweepPlan, simulate_campaign, true_rig
from tests.support.rigs import one_degree_of_freedom
from tests.support.unknown_effects import TunedMass

TRUE_STIFFNESS, TRUE_RATIOS = np.array([4e5, 4.04e5]), np.array([0.01, 0.04])
RIG = one_degree_of_freedom(
    cells=[
        {"name": name, "position": [0, 0, 0], "axis": axis, "stiffness": 4e5, "full_range": 1000.0}
        for name, axis in (("x", [1, 0, 0]), ("y", [0, 1, 0]))
    ],
    channels=[{"name": f"{name}.strain", "cell": name, "sensitivity": 0.002} for name in "xy"],
    tolerances={"stiffness": 0.05, "mass": 0.0, "damping_ratio": 1.0},
    freedom=["x", "y"],
)


SWEEPS = tuple(
    SweepPlan(run=f"sweep-{name}", excited=(name,), level=(5.0,), period=4.0, periods=6, band=(5.0, 80.0))
    for name in ("Fx", "Fy")
)


@pytest.fixture(scope="module")
def batches() -> tuple[Batch, ...]:
    """Sweeps of a rig whose mode along y is 0.5 % above that along x, and damped four times as much."""
    rig = replace(true_rig(RIG), stiffness=TRUE_STIFFNESS, damping_ratios=TRUE_RATIOS)
    runs = simulate_campaign(rig, CampaignPlan(runs=SWEEPS), seed=1).runs
    return stack_runs(measured_spectra(runs, RIG).lines, (), RIG.channel_names)


def start() -> Estimate:
    """The modes in the other order, each with its own damping."""
    model = balance_model(RIG)
    theta = model.parameters.value.copy()
    theta[model.parameters.index("stiffness.y")] = 3.97e5
    for number, ratio in enumerate(TRUE_RATIOS[::-1], 1):
        theta[model.parameters.index(f"damping_ratio.{number}")] = ratio
    return model.at(theta)


def damping_and_frequencies(batches: tuple[Batch, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    found = fit_until_stable(start(), SearchLines(batches, batches), DEFAULT_SETTINGS.fit)
    ratios = [found.theta[found.model.parameters.index(f"damping_ratio.{number}")] for number in (1, 2)]
    return np.array(ratios), plate_frequencies(found.model, found.theta)


def test_the_fit_goes_on_beyond_the_crossing(batches: tuple[Batch, ...]) -> None:
    ratios, frequencies = damping_and_frequencies(batches)
    np.testing.assert_allclose(ratios, TRUE_RATIOS, rtol=0.02)
    np.testing.assert_allclose(frequencies, np.sqrt(TRUE_STIFFNESS / 10.0), rtol=1e-4)


def test_no_step_leads_there(batches: tuple[Batch, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refit, "exchanged_modes", lambda model, theta: [])
    ratios, frequencies = damping_and_frequencies(batches)
    assert ratios[0] > ratios[1] and frequencies[1] / frequencies[0] < 1.004


# ---- a resonance beside them -----------------------------------------------------------------------------------------


def resonances(*frequencies: float) -> SearchLines:
    """Lines of the rig above with a mass of 0.6 kg tuned to each of these frequencies [Hz], along y."""
    tuned = (
        TunedMass(mass=0.6, frequency=f, damping_ratio=0.03, position=(0, 0, 0), direction=(0, 1, 0))
        for f in frequencies
    )
    rig = replace(true_rig(RIG), stiffness=TRUE_STIFFNESS, damping_ratios=TRUE_RATIOS)
    runs = simulate_campaign(rig.with_extensions(*tuned), CampaignPlan(runs=SWEEPS), seed=1).runs
    lines = stack_runs(measured_spectra(runs, RIG).lines, (), RIG.channel_names)
    return SearchLines(lines, lines)


def test_a_whole_fit_finds_the_resonance_that_leaves_them_apart() -> None:
    lines = resonances(48.0)
    base = fit_until_stable(start(), lines, DEFAULT_SETTINGS.fit)
    assert base.error > 0.05
    found, trials = add_resonance_by_whole_fit(base, base, lines, 3, DEFAULT_SETTINGS)
    assert found is not None and found.error < 3e-3
    assert [trial.decision for trial in trials][-1] == "accepted" and trials[0].round == 3
    (effect,) = declared_effects(found.geometry)
    values = {
        name.rpartition(".")[2]: value for name, value in zip(found.model.parameters.names, found.theta, strict=True)
    }
    assert effect.label == "extra-mode@y"
    assert values["frequency"] == pytest.approx(48.0, rel=1e-3) and values["mass"] == pytest.approx(0.6, rel=0.1)


def test_a_resonance_that_leaves_much_is_none() -> None:
    lines = resonances(42.0, 60.0)
    base = fit_until_stable(start(), lines, DEFAULT_SETTINGS.fit)
    found, trials = add_resonance_by_whole_fit(base, base, lines, 3, DEFAULT_SETTINGS)
    assert found is None
    assert len(trials) == DEFAULT_SETTINGS.modes.max_whole_fits and {trial.decision for trial in trials} == {"rejected"}
