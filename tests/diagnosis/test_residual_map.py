"""Where a model leaves a residual: simulated runs under their truth and under a wrong model."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.diagnosis.residual_map import describe_residual_location, residual_map
from balance_cli.diagnosis.result import ResidualMap
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from balance_cli.estimation.likelihood import data_chi2
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import Estimate, balance_model
from balance_cli.signals.run_spectrum import StaticPoints
from balance_cli.simulation import CampaignPlan, SweepPlan, simulate_campaign, true_rig
from tests.support.rigs import one_degree_of_freedom, rotor_balance, two_degrees_of_freedom

RIG = two_degrees_of_freedom()
PLAN = {"period": 4.0, "periods": 9, "band": (2.0, 120.0)}
MODEL = balance_model(RIG)


def select(**changes: float) -> Estimate:
    """The model with some of its declared values multiplied."""
    theta = MODEL.parameters.value.copy()
    for name, factor in changes.items():
        theta[MODEL.parameters.index(name)] *= factor
    return MODEL.at(theta)


@pytest.fixture(scope="module")
def spectra():
    """Two sweeps, from which a third is map_with without channel b, and a static run."""
    plans = (
        SweepPlan(run="heave", excited=("Fz",), level=(20.0,), **PLAN),
        SweepPlan(run="pitch", excited=("My",), level=(8.0,), **PLAN),
    )
    runs, _ = simulate_campaign(true_rig(RIG, damping_ratios=0.02), CampaignPlan(runs=plans), seed=3)
    return measured_spectra(runs, RIG)


@pytest.fixture(scope="module")
def batches(spectra):
    heave = spectra.lines[0]
    kept = np.array([0, 2])
    window = heave.window
    deaf = replace(
        heave.select(heave.frequency > 60.0),
        run="deaf",
        channel_names=("a.strain",),
        channels=heave.channels[heave.frequency > 60.0][:, :1],
        covariance=heave.covariance[heave.frequency > 60.0][:, kept[:, None], kept],
        window=None,
    )
    assert window is not None
    return stack_runs([*spectra.lines, deaf], [static()], RIG.channel_names)


def static(noise: float = 1e-3) -> StaticPoints:
    """Loads on two cells that share a vertical force by their places; noise per row."""
    rng = np.random.default_rng(7)
    loads = np.zeros((400, 6))
    loads[:, 2] = rng.uniform(-300.0, 300.0, 400)
    loads[:, 4] = rng.uniform(-100.0, 100.0, 400)
    force = np.stack([0.5 * loads[:, 2] - loads[:, 4] / 0.6, 0.5 * loads[:, 2] + loads[:, 4] / 0.6], axis=1)
    rows = 0.002 * force + noise * rng.normal(size=(400, 2))
    return StaticPoints("static", "bare", RIG.channel_names, rows, loads, noise**2 * np.eye(2), 300.0)


def test_under_the_truth_it_is_one(batches):
    residual = residual_map(batches, select(), select(), SETTINGS.residual_map)
    assert set(residual.runs) == {"heave", "pitch", "deaf", "static"}
    assert residual.channels == RIG.channel_names
    assert residual.after.shape == (4, len(residual.edges) - 1, 2) == residual.before.shape
    np.testing.assert_array_equal(residual.before, residual.after)
    for run in ("heave", "pitch"):
        rms = np.sqrt(np.nanmean(residual.after[residual.runs.index(run)] ** 2, axis=0))
        np.testing.assert_allclose(rms, 1.0, atol=0.06)
    at_rest = residual.after[residual.runs.index("static"), 0]
    assert np.all((at_rest > 0.05) & (at_rest < 3.0))
    assert describe_residual_location(residual, SETTINGS.residual_map).startswith("Nothing beyond the noise")


def test_its_sum_is_chi_square_where_channels_are_independent(spectra):
    """One channel: the map and the likelihood weigh alike."""
    rig = one_degree_of_freedom()
    plan = SweepPlan(run="heave", excited=("Fz",), level=(20.0,), **PLAN)
    runs, _ = simulate_campaign(true_rig(rig), CampaignPlan(runs=(plan,)), seed=1)
    lines = measured_spectra(runs, rig).lines
    batches = stack_runs(lines, [], rig.channel_names)
    model = balance_model(rig)
    theta = model.parameters.value * 1.003
    residual = residual_map(batches, model.at(theta), model.at(theta), SETTINGS.residual_map)
    counts = np.histogram(lines[0].frequency, np.append(residual.edges[:-1], np.inf))[0]
    total = 2.0 * np.sum(counts * residual.after[0, :, 0] ** 2)
    held = sum(2.0 for _ in lines)
    assert total == pytest.approx(data_chi2(batches, model.system(theta)), rel=0.02, abs=held)


def test_bands_hold_all_lines_and_are_nan_without_any(batches):
    residual = residual_map(batches, select(), select(), SETTINGS.residual_map)
    assert residual.edges[0] == 0.0 and residual.edges[1] == pytest.approx(2.0)
    assert len(residual.edges) == 32 and np.all(np.diff(residual.edges) > 0)
    assert residual.edges[-1] > 120.0 - 1e-9
    static_run, deaf = residual.after[residual.runs.index("static")], residual.after[residual.runs.index("deaf")]
    assert np.isfinite(static_run[0]).all() and np.isnan(static_run[1:]).all()
    assert np.isnan(deaf[:, 1]).all()
    high = residual.edges[:-1] > 60.0
    assert np.isfinite(deaf[high, 0]).all() and np.isnan(deaf[residual.edges[1:] < 60.0, 0]).all()
    for run in ("heave", "pitch"):
        assert np.isfinite(residual.after[residual.runs.index(run), 1:]).all()


def test_a_wrong_stiffness_shows_at_its_mode(batches):
    """Heave resonates at 50.3 Hz, pitch at 75.5 Hz; both cells a little too stiff."""
    residual = residual_map(
        batches, select(**{"stiffness.a": 1.01, "stiffness.b": 1.01}), select(), SETTINGS.residual_map
    )
    heave = residual.before[residual.runs.index("heave"), :, 0]
    worst = int(np.nanargmax(heave))
    assert residual.edges[worst] < 51.5 and residual.edges[worst + 1] > 49.0
    assert heave[worst] > 10 * np.nanmedian(heave)
    text = describe_residual_location(replace(residual, after=residual.before), SETTINGS.residual_map)
    assert text.startswith("Rms ") and "heave" in text and "all channels" in text and "Hz" in text


def map_with(after: np.ndarray) -> ResidualMap:
    runs = tuple(f"run-{i}" for i in range(after.shape[0]))
    channels = tuple(f"c{i}" for i in range(after.shape[2]))
    edges = np.append(0.0, 2.0 + 5.0 * np.arange(after.shape[1]))
    return ResidualMap(runs, channels, edges, after, after)


def test_the_location_names_runs_bands_and_channels():
    after = np.ones((12, 20, 15))
    after[3, 7:9, 4] = 30.0
    text = describe_residual_location(map_with(after), SETTINGS.residual_map)
    assert text == "Rms 1.22 of the noise; most in run-3, 32 to 42 Hz, c4."


def test_a_residual_at_rest_is_named():
    after = np.full((5, 6, 8), np.nan)
    after[:4, 1:] = 1.0
    after[4, 0] = 6.0
    assert "most in run-4, at rest, all channels" in describe_residual_location(map_with(after), SETTINGS.residual_map)


def test_a_residual_everywhere_is_described_so():
    text = describe_residual_location(map_with(np.full((12, 20, 15), 4.0)), SETTINGS.residual_map)
    assert text == "Rms 4.00 of the noise; most in all runs, all bands, all channels."


def test_noise_alone_has_no_location():
    rng = np.random.default_rng(0)
    noise = np.sqrt(rng.chisquare(60, (12, 20, 15)) / 60)
    assert describe_residual_location(map_with(noise), SETTINGS.residual_map).startswith("Nothing beyond the noise")


def test_a_rig_with_all_its_channels():
    """The sample rig: correlated channels, loads with noise, amplifiers that ring out in 28 s."""
    rig = rotor_balance()
    plan = SweepPlan(run="heave", excited=("Fz",), level=(80.0,))
    runs, _ = simulate_campaign(true_rig(rig), CampaignPlan(runs=(plan,)), seed=2)
    batches = stack_runs(measured_spectra(runs, rig).lines, [], rig.channel_names)
    model = balance_model(rig)
    truth = model.at()
    residual = residual_map(batches, truth, truth, SETTINGS.residual_map)
    rms = np.sqrt(np.mean(residual.after[0] ** 2, axis=0))
    np.testing.assert_allclose(rms, 1.0, atol=0.1)


def test_residuals_are_white_under_the_truth_and_alike_from_line_to_line_under_a_wrong_model(batches):
    """Of white residuals 5 % of the correlations exceed sqrt(-ln 0.05 / pairs); 40 of them: at most 7 (p = 0.001)."""
    wrong = select(**{"stiffness.a": 1.01, "stiffness.b": 1.01})
    residual = residual_map(batches, wrong, select(), SETTINGS.residual_map)
    by_run = dict(zip(residual.runs, residual.excited, strict=True))
    assert by_run == {"heave": "Fz", "pitch": "My", "deaf": "Fz", "static": ""}
    limit = np.sqrt(-np.log(0.05) / residual.pairs)
    assert residual.correlation_after.shape == limit.shape == (2, 20)
    assert np.count_nonzero(residual.correlation_after > limit) <= 7
    assert np.all(residual.correlation_before[:, 0] > 0.5)
