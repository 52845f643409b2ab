"""Models identified from measured frequency responses, without the runs: as good as from the runs, and as honest."""

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

import balance_cli as bal
from balance_cli.campaign.recording.run_file import write_run
from balance_cli.campaign.rig.geometry_file import save_geometry
from balance_cli.cli import balance
from balance_cli.estimation.measured_responses import MeasuredResponses, add_responses, require_usable_responses
from balance_cli.estimation.measured_spectra import Spectra, measured_spectra
from balance_cli.io.errors import UserError
from balance_cli.model.parameters import declared_parameters
from balance_cli.signals.response.choices import IMPORTED
from balance_cli.signals.response.transfer import Transfer
from balance_cli.signals.run_spectrum import FrequencyResponse
from balance_cli.simulation import SweepPlan, simulate_run, true_rig
from balance_cli.steps.identify import identify
from balance_cli.steps.sweep_tf import estimate_responses
from tests.support.rigs import one_degree_of_freedom, two_degrees_of_freedom
from tests.support.truth import true_parameters, true_response

NOTHING = Spectra((), (), {}, {})
FREQUENCY = np.arange(4.0, 80.0, 0.5)


@pytest.fixture(scope="module")
def transfer(campaign):
    return estimate_responses(campaign.runs_of_kind("sweep"), campaign.geometry)


def test_the_model_of_the_responses_is_that_of_their_runs(campaign, identified, transfer):
    """Together with the static runs, within a part of the joint sigma: the noise of the data is the same."""
    statics = measured_spectra(campaign.runs_of_kind("static"), campaign.geometry)
    model = identify(add_responses(statics, [MeasuredResponses(transfer)]), campaign.geometry)
    table, other = model.parameters, identified.parameters
    free = table.declared_sigma > 0
    difference = (table.value - other.value)[free] / np.hypot(table.sigma, other.sigma)[free]
    assert np.sqrt(np.mean(difference**2)) < 0.5 and np.abs(difference).max() < 1.5
    ratio = (table.sigma / np.where(free, other.sigma, 1.0))[free]
    assert np.all((ratio > 0.8) & (ratio < 1.3))
    assert 0.85 < model.quality.chi2_per_dof < 1.2
    truth = true_parameters(campaign.rig, declared_parameters(campaign.geometry))
    error = (table.value - truth)[free] / table.sigma[free]
    assert np.sqrt(np.mean(error**2)) < 1.6 and np.abs(error).max() < 4.0


def imported_response(rig, seed, noise=1e-5):
    """The true response of a rig with one channel, as another program would have measured it."""
    rng = np.random.default_rng(seed)
    exact = true_response(rig, FREQUENCY)[:, :, 2:3]
    error = noise * (rng.normal(size=exact.shape) + 1j * rng.normal(size=exact.shape)) / np.sqrt(2.0)
    k, c, _ = exact.shape
    ones = np.ones((k, c, 1))
    response = FrequencyResponse("1-Z", rig.geometry.channel_names, ("Fz",), IMPORTED, FREQUENCY, exact + error,
                                 noise**2 * np.ones((k, c, c), complex), ones.astype(complex), ones, ones[:, :, 0],
                                 noise_dof=np.inf)  # fmt: skip
    return Transfer(rig.geometry, (response,), IMPORTED)


def test_parameters_scatter_by_their_sigma():
    geometry = one_degree_of_freedom()
    scores, chi2 = [], []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        rig = true_rig(geometry, stiffness=[4e5 * (1.0 + 0.05 * rng.normal())])
        rig = replace(
            rig, damping_ratios=0.02 * (1.0 + 0.3 * rng.normal(size=1)), mass=10.0 * (1 + 0.02 * rng.normal())
        )
        spectra = add_responses(NOTHING, [MeasuredResponses(imported_response(rig, seed))])
        model = identify(spectra, geometry)
        truth = true_parameters(rig, declared_parameters(geometry))
        names = [name in ("stiffness.z", "mass", "damping_ratio.1") for name in model.parameters.names]
        scores.append(((model.parameters.value - truth) / np.maximum(model.parameters.sigma, 1e-300))[names])
        chi2.append(model.quality.chi2_per_dof)
    assert 0.8 < np.sqrt(np.mean(np.square(scores))) < 1.25
    assert abs(np.mean(chi2) - 1.0) < 0.06


def test_three_inputs_at_once_have_correlated_columns_that_count_once():
    """The columns of runs that were solved together have errors in common; the whitened ones do not."""
    geometry = two_degrees_of_freedom()
    rig = true_rig(geometry, stiffness=[1.03e6, 0.98e6])
    plans = [SweepPlan(run=f"s{i}", excited=("Fz", "My"), level=(20.0, 5.0), periods=6, period=2.0, interleaved=False,
                       band=(4.0, 100.0)) for i in range(2)]  # fmt: skip
    runs = [simulate_run(rig, plan, seed=i)[0] for i, plan in enumerate(plans)]
    transfer = estimate_responses(runs, geometry)
    assert len(transfer.responses) == 1 and np.any(np.abs(transfer.responses[0].load_covariance[:, 0, 1]) > 0)
    model, other = (identify(spectra, geometry) for spectra in (
        add_responses(NOTHING, [MeasuredResponses(transfer)]), measured_spectra(runs, geometry)))  # fmt: skip
    assert model.quality.chi2_per_dof == pytest.approx(1.0, abs=0.15)
    np.testing.assert_allclose(model.modes.sigma_frequency, other.modes.sigma_frequency, rtol=0.15)
    sigma = np.hypot(model.modes.sigma_frequency, other.modes.sigma_frequency)
    assert np.all(np.abs(model.modes.frequency - other.modes.frequency) < 1.5 * sigma)


def test_data_that_would_count_twice_are_refused(campaign, transfer):
    items = (MeasuredResponses(transfer, "tf.h5"),)
    with pytest.raises(UserError, match="a second time"):
        require_usable_responses(items, campaign.runs_of_kind("sweep")[:1], campaign.geometry)
    with pytest.raises(UserError, match="a second time"):
        require_usable_responses((*items, *items), (), campaign.geometry)
    renamed = [replace(run, name="other", digest="d") for run in campaign.runs_of_kind("sweep")[:1]]
    copied = MeasuredResponses(transfer, "tf.h5", frozenset("d"))
    with pytest.raises(UserError, match="a second time"):
        require_usable_responses((copied,), renamed, campaign.geometry)
    require_usable_responses(items, campaign.runs_of_kind("static", "check"), campaign.geometry)


def test_responses_of_another_rig_hub_or_sensitivity_are_refused(campaign, transfer):
    geometry = campaign.geometry
    moved = geometry.model_copy(update={"hub": (0.0, 0.0, 9.0)})
    channel = geometry.channels[0].model_copy(update={"sensitivity": 1.0})
    gained = geometry.model_copy(update={"channels": (channel, *geometry.channels[1:])})
    for other, words in ((geometry.model_copy(update={"rig": "X"}), "of rig"), (moved, "hub")):
        with pytest.raises(UserError, match=words):
            require_usable_responses([MeasuredResponses(transfer)], (), other)
    require_usable_responses([MeasuredResponses(transfer)], (), gained)
    with pytest.raises(UserError, match="sensitivity"):
        require_usable_responses([MeasuredResponses(replace(transfer, estimator=IMPORTED))], (), gained)


def test_effects_that_need_samples_are_refused(campaign, transfer):
    with pytest.raises(UserError, match="`cubic-stiffness` cannot be fitted: frequency responses hold no samples"):
        bal.identify(transfer, campaign.geometry, effects=["cubic-stiffness@z1,inside"])


def test_the_command_takes_the_file_and_refuses_it_beside_its_runs(tmp_path):
    geometry = one_degree_of_freedom()
    save_geometry(tmp_path / "g.yaml", geometry)
    plan = SweepPlan(run="sweep", excited=("Fz",), level=(20.0,), periods=8, period=2.0)
    write_run(tmp_path / "sweep.h5", simulate_run(true_rig(geometry, stiffness=[4.1e5]), plan, seed=2)[0])
    run, g, tf, model = (str(tmp_path / name) for name in ("sweep.h5", "g.yaml", "tf.h5", "m.h5"))
    calls = [["sweep-tf", "-g", g, run, "-o", tf], ["identify", "-g", g, tf, "-o", model]]
    for call in calls:
        result = CliRunner().invoke(balance, call)
        assert result.exit_code == 0, result.output
    identified = bal.load_artefact(model)
    assert identified.modes.frequency[0] == pytest.approx(np.sqrt(4.1e5 / 10.0) / (2 * np.pi), rel=2e-4)
    result = CliRunner().invoke(balance, ["identify", "-g", g, tf, run, "-o", str(tmp_path / "n.h5")])
    assert result.exit_code == 2 and "a second time" in result.output and not (tmp_path / "n.h5").exists()
