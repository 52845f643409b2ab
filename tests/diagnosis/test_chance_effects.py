"""Effects that chance explains: removed when the time is over, too; tones by the frequencies that were looked at."""

import numpy as np
import pytest
from scipy.special import i0e

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.search.extended_models import extend_model
from balance_cli.diagnosis.selection import effect_selection
from balance_cli.diagnosis.selection.effect_selection import REASON_NOT_NEEDED, prune_effects, select_effects
from balance_cli.diagnosis.selection.fit import fit_all_lines
from balance_cli.diagnosis.selection.mains_frequency import frequency_looks
from balance_cli.diagnosis.selection.selection_task import SelectionTask
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from balance_cli.diagnosis.significance import bonferroni_p_value
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import balance_model
from balance_cli.model.placed_effects import declared_effects
from balance_cli.simulation import CampaignPlan, SweepPlan, simulate_campaign, true_rig
from balance_cli.simulation.preset_plans import HIGH_SWEEP_LEVELS
from balance_cli.simulation.rig import apply_effects
from tests.support.rigs import rotor_balance

RIG = rotor_balance()
LATE = DeclaredEffect(name="time-delay", where=("x.piezo",), parameters={"delay": 2e-5})
CHANCE = (
    DeclaredEffect(name="channel-gain", where=("y2.piezo",), parameters={"gain": 1.0}),
    DeclaredEffect(name="low-pass", where=("z1.piezo",), parameters={"cutoff": 1e5}),
)
HUM = DeclaredEffect(name="mains-pickup", where=("z2.piezo",), parameters={"amplitude": 1e-5, "frequency": 50.0})
LENGTH = 6.0


@pytest.fixture(scope="module")
def batches():
    """Sweeps of a rig with one late channel."""
    sweeps = (
        SweepPlan(run=f"sweep-{name}", excited=(name,), level=(level,), period=1.0, periods=int(LENGTH))
        for name, level in HIGH_SWEEP_LEVELS.items()
    )
    runs = simulate_campaign(apply_effects(true_rig(RIG), (LATE,)), CampaignPlan(runs=tuple(sweeps)), seed=3).runs
    return stack_runs(measured_spectra(runs, RIG, means=True).lines, (), RIG.channel_names)


def fit_with(effects, batches):
    geometry = RIG.model_copy(update={"effects": tuple(effects)})
    plain = balance_model(RIG)
    return fit_all_lines(extend_model(plain.at(), geometry), batches, SETTINGS.fit)


@pytest.mark.parametrize("is_over", [True, False])
def test_what_chance_explains_is_never_left_in(batches, is_over):
    fit = fit_with((LATE, *CHANCE), batches)
    pruned, trials = prune_effects(fit, SelectionTask(batches, SETTINGS, lambda _: is_over), 300, 1)
    assert [effect.effect.name for effect in declared_effects(pruned.model.geometry)] == ["time-delay"]
    assert [trial.reason for trial in trials] == [REASON_NOT_NEEDED] * 2
    alone = fit_with((LATE,), batches)
    # The tolerance of chi-square of fits that are compared.
    assert pruned.chi2 == pytest.approx(alone.chi2, abs=2.0 * SETTINGS.fit.comparison_tolerance)


def test_what_only_an_unsupported_effect_had_made_necessary_goes_with_it(batches, monkeypatch):
    """A wrong effect may need others that correct it; without it the right ones are enough."""
    left = fit_with((LATE, *CHANCE), batches)
    monkeypatch.setattr(effect_selection, "drop_unsupported_effects", lambda *_: (left, ("removed",)))
    fit, trials = select_effects(fit_with((LATE,), batches), SelectionTask(batches, SETTINGS, lambda _: True), 300, 1)
    assert [effect.effect.name for effect in declared_effects(fit.model.geometry)] == ["time-delay"]
    assert trials[0] == "removed"
    assert [trial.reason for trial in trials[1:]] == [REASON_NOT_NEEDED] * 2


def test_a_tone_is_looked_for_at_as_many_frequencies_as_a_record_resolves(batches):
    fit = fit_with((LATE, HUM), batches)
    by_name = {effect.effect.name: effect for effect in declared_effects(fit.model.geometry)}
    assert frequency_looks(fit, by_name["time-delay"], batches, SETTINGS) == 1.0
    # Two starts, 1 Hz about each, two looks in each lobe of 1/T; the transient may cost a period.
    looks = frequency_looks(fit, by_name["mains-pickup"], batches, SETTINGS)
    assert 4.0 * (LENGTH - 1.0) <= looks <= 4.0 * LENGTH


@pytest.mark.parametrize("weights", [np.ones(12), np.array([1.0] + 11 * [0.01])])
def test_gains_of_noise_are_no_likelier_than_so_many_looks_say(weights):
    """Twelve records of 20 s of white noise, in each the likelihood ratio of a tone of unknown phase and frequency."""
    rng, T, count = np.random.default_rng(1), 20.0, 160
    frequency = np.linspace(-0.5, 0.5, int(4 * T) + 1)
    phasors = np.exp(-2j * np.pi * np.outer(frequency, (np.arange(count) + 0.5) / count * T)) / np.sqrt(count)
    amplitude = np.geomspace(0.03, 30.0, 40)
    looks = SETTINGS.mains.looks_per_lobe * T
    p_values = []
    for _ in range(250):
        noise = rng.normal(size=(2, len(weights), count))
        b = np.abs(phasors @ (noise[0] + 1j * noise[1]).T) * np.sqrt(weights)
        x = b[:, :, None] * amplitude
        gain = np.max(2.0 * np.sum(x + np.log(i0e(x)), axis=1) - weights.sum() * amplitude**2)
        p_values.append(bonferroni_p_value(gain, 1, looks))
    # Three standard deviations of a binomial share of 5 %; without the looks every second gain is below it.
    assert np.mean(np.array(p_values) < 0.05) < 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / 250)


def test_noise_in_one_bin_is_in_all_lines_of_its_window():
    """The variance of an inner product of lines, which share bins, against that of noise drawn in the bins."""
    sweep = SweepPlan(run="random", excited=("Fz",), level=(200.0,), excitation="random", period=4.0, periods=3)
    run = simulate_campaign(true_rig(RIG), CampaignPlan(runs=(sweep,)), seed=4).runs[0]
    lines = measured_spectra([run], RIG, means=True).lines[0]
    waveform, rng = lines.waveform, np.random.default_rng(0)
    bins = rng.normal(size=(2, len(waveform.bin_index), 400)) * np.sqrt(0.5)
    noise = waveform.combine_bins(bins[0] + 1j * bins[1])
    noise /= np.sqrt(np.mean(np.abs(noise) ** 2, axis=1, keepdims=True))
    near = np.abs(lines.frequency - 50.0) < 8.0
    x = np.where(near, np.exp(1j * rng.uniform(0.0, 0.2, len(near))), 0.0)
    spread = np.mean(np.abs(x.conj() @ noise) ** 2) / np.sum(np.abs(x) ** 2)
    # 400 draws of a chi-square of two degrees of freedom: 5 % each way is one standard deviation.
    assert waveform.noise_spread(x) == pytest.approx(spread, rel=0.2)
    assert near.sum() > 5
