"""Mains interference between the lines of a rig with as many cells as loads: information, and a whole diagnosis."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.result import EXPLAINED
from balance_cli.diagnosis.search.candidates import candidate_at
from balance_cli.diagnosis.search.score_statistics import Score
from balance_cli.diagnosis.selection.testability import find_untestable_effects
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.likelihood import batch_curvature
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import balance_model
from balance_cli.simulation import simulate_campaign, true_rig
from balance_cli.simulation.rig import apply_effects
from balance_cli.steps.diagnose import diagnose
from balance_cli.steps.identify import identify
from tests.support.diagnosis_content import trials
from tests.support.other_rigs import other_rig, short_campaign

RIG = other_rig("A")
CHANNEL, AMPLITUDE, FREQUENCY = "l3.piezo", 5e-2, 49.97


def tone(amplitude, frequency):
    return DeclaredEffect(
        name="mains-pickup", where=(CHANNEL,), parameters={"amplitude": amplitude, "frequency": frequency}
    )


@pytest.fixture(scope="module")
def spectra():
    """Static runs and three sweeps, whose lines are 7 Hz apart: the tone lies between two of them."""
    plan = short_campaign("A", sweeps=30.0).select_runs(
        ["static-bare", "static-trim", "sweep-Fx", "sweep-Fz", "sweep-Mz"]
    )
    runs, _ = simulate_campaign(apply_effects(true_rig(RIG), [tone(AMPLITUDE, FREQUENCY)]), plan, seed=2)
    return measured_spectra(runs, RIG, means=True)


def test_the_information_about_a_tone_is_never_negative(spectra):
    batches = stack_runs(spectra.lines, (), RIG.channel_names)
    for frequency in np.linspace(49.5, 50.5, 5):
        effects = (tone(AMPLITUDE, float(frequency)),)
        model = balance_model(RIG.model_copy(update={"effects": effects})).free_all_parameters()
        own = [i for i, name in enumerate(model.parameters.names) if name.startswith("mains")]
        for batch in batches:
            information = batch_curvature(batch, model.system(model.parameters.value)).information[np.ix_(own, own)]
            size = np.sqrt(np.maximum(np.diag(information), 1e-300))
            assert np.diag(information).min() >= 0.0
            assert np.linalg.eigvalsh(information / np.outer(size, size))[0] > -1e-6


@pytest.mark.parametrize(("band", "testable"), [((0.0, 40.0), False), ((45.0, 56.0), True), ((62.0, 200.0), True)])
def test_without_lines_at_the_mains_interference_is_not_testable(spectra, band, testable):
    """The lines are 7 Hz apart: the main lobe of a tone at 60 Hz reaches the first one above 62 Hz."""
    lines = tuple(run.select((run.frequency >= band[0]) & (run.frequency <= band[1])) for run in spectra.lines)
    found = find_untestable_effects((), (), replace(spectra, lines=lines), RIG, DEFAULT_SETTINGS.selection)
    reasons = {item.name: item.reason for item in found}
    assert ("mains-pickup" not in reasons) == testable
    assert testable or reasons["mains-pickup"].endswith("is at 50 or 60 Hz")


def test_an_effect_with_a_significant_trial_was_testable(spectra):
    """Beside a large unexplained residual the last scores are small: they say nothing about what the runs can show."""

    def untestable(p_value):
        trial = replace(trials()[0], label="gyroscopic-coupling", p_value=p_value)
        found = find_untestable_effects((weak,), (trial,), spectra, RIG, DEFAULT_SETTINGS.selection)
        return {item.name for item in found}

    weak = Score(candidate_at("gyroscopic-coupling", (), RIG), 0, 0.1, 1, 0.5, np.inf, np.eye(1), *np.ones((2, 1)))
    assert "gyroscopic-coupling" in untestable(0.3)
    assert "gyroscopic-coupling" not in untestable(1e-17)


def test_a_tone_that_the_lines_of_the_search_cannot_show_is_kept(spectra):
    diagnosis, _ = diagnose(identify(spectra, RIG), spectra)
    assert diagnosis.verdict == EXPLAINED
    (found,) = diagnosis.effects
    assert found.label == f"mains-pickup@{CHANNEL}"
    amplitude, frequency = found.parameters
    assert amplitude.value == pytest.approx(AMPLITUDE, rel=0.2)
    assert abs(frequency.value - FREQUENCY) < 4.0 * frequency.sigma
