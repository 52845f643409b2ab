"""The step and the command: which estimator for which run, runs solved together, what is said of the result."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.campaign.rig.channel import Channel
from balance_cli.cli import balance
from balance_cli.io.artefacts import load_artefact
from balance_cli.io.errors import UserError
from balance_cli.signals.periodic import periodic_record
from balance_cli.signals.response.transfer import (
    Transfer,
    least_coherence,
    relative_sigma,
    response_components,
    response_to_component,
    select_component,
)
from balance_cli.steps import sweep_tf
from balance_cli.steps.sweep_tf import ESTIMATORS, estimate_responses
from tests.support.rigs import rotor_balance
from tests.support.swept_rig import SweptRig, relative_error

ROOT = Path(__file__).parents[2]
RIG = SweptRig()
BOTH = SweptRig(components=("Fx", "My"))
GEOMETRY = rotor_balance().model_copy(
    update={"channels": tuple(Channel(name=name, cell="x", sensitivity=0.01) for name in RIG.names)}
)


@pytest.fixture(scope="module")
def periodic():
    high = replace(RIG.multisine(0), name="high")
    low = replace(RIG.multisine(1), name="low", level=(16.0,))
    other = replace(high, name="zero", kind="zero")
    return estimate_responses([high, other, low], GEOMETRY)


def test_periodic_runs_need_no_model(periodic):
    assert [response.run for response in periodic.responses] == ["high", "low"]
    assert {response.estimator for response in periodic.responses} == {"periodic"}
    assert periodic.unused_runs == {"zero": "a zero run; only sweeps are used"}
    assert periodic.steady_parts["high"].steady
    assert periodic.steady_parts["high"].stop == pytest.approx(28.0)
    for response in periodic.responses:
        assert np.percentile(relative_error(RIG, response.frequency, response.response), 95) < 2e-3


def test_stated_covariance_of_a_periodic_response(periodic):
    response = periodic.responses[0]
    error = (response.response - RIG.response(response.frequency))[:, :, 0]
    weight = np.linalg.inv(response.channel_covariance) / response.load_covariance
    chi2 = np.einsum("kc,kcd,kd->k", error.conj(), weight, error).real / 5 * (150 - 5) / 150
    assert chi2.mean() == pytest.approx(1.0, abs=0.1)


def test_the_response_that_reduction_uses(periodic):
    assert response_to_component(periodic, "Fx").run == "high"
    with pytest.raises(UserError, match="no measured response to Mz"):
        response_to_component(periodic, "Mz")


def test_what_is_said_of_the_result(periodic):
    assert response_components(periodic) == ("Fx",)
    assert 0.99 < least_coherence(periodic)["Fx"] < 1.0
    error = relative_error(RIG, periodic.responses[0].frequency, periodic.responses[0].response)
    assert np.median(relative_sigma(periodic.responses[0])) < 2 * np.median(error)


def test_records_that_do_not_repeat_get_a_local_model():
    run = RIG.random(seconds=10.0)
    assert [r.estimator for r in estimate_responses([run], GEOMETRY).responses] == ["lrm"]
    with pytest.raises(UserError, match="no `period`"):
        estimate_responses([run], GEOMETRY, "periodic")


def test_a_period_that_cannot_be_cut_gets_one_too():
    run = replace(RIG.random(seconds=10.0), period=3.141592)
    assert [r.estimator for r in estimate_responses([run], GEOMETRY).responses] == ["lrm"]


def test_computed_records_without_noise():
    rig = SweptRig(noise=0.0, load_noise=0.0)
    for run in (rig.multisine(), rig.random(seconds=10.0)):
        (response,) = estimate_responses([run], GEOMETRY, band=(5.0, 145.0)).responses
        assert np.median(relative_error(rig, response.frequency, response.response)) < 1e-4


@pytest.mark.parametrize("estimator", [name for name in ESTIMATORS if name not in ("auto", "periodic")])
def test_every_estimator_takes_every_run(estimator):
    runs = [replace(RIG.multisine(periods=3), name="a"), replace(RIG.sine_sweep(seconds=10.0), name="b")]
    transfer = estimate_responses(runs, GEOMETRY, estimator, (10.0, 60.0))
    assert [response.estimator for response in transfer.responses] == [estimator] * 2
    for response in transfer.responses:
        assert response.frequency[0] >= 10.0
        assert response.frequency[-1] <= 60.0
        assert np.median(relative_error(RIG, response.frequency, response.response)) < 0.05


def test_components_excited_at_once_are_told_apart_by_as_many_runs():
    runs = [replace(BOTH.multisine(seed), name=f"run-{seed}") for seed in range(2)]
    (response,) = estimate_responses(runs, GEOMETRY).responses
    assert (response.run, response.estimator, response.level) == ("run-0+run-1", "periodic", (40.0, 40.0))
    # Random phases: at some lines the two runs are nearly alike, and the covariance says so.
    assert np.median(relative_error(BOTH, response.frequency, response.response)) < 2e-3
    column = select_component(response, "My")
    assert column.response[:, :, 0] == pytest.approx(response.response[:, :, 1])
    assert column.load_covariance[:, 0, 0] == pytest.approx(response.load_covariance[:, 1, 1])
    assert scatter(response, BOTH) == pytest.approx(1.0, abs=0.15)


def scatter(response, rig):
    """Mean square of the error of every entry over its stated variance."""
    channels = np.diagonal(response.channel_covariance, axis1=1, axis2=2).real
    loads = np.diagonal(response.load_covariance, axis1=1, axis2=2).real
    error = np.abs(response.response - rig.response(response.frequency)) ** 2
    return np.mean(error / (channels[:, :, None] * loads[:, None, :]))


def test_or_from_one_run_across_its_lines():
    (response,) = estimate_responses([BOTH.multisine(period=8.0, periods=5)], GEOMETRY).responses
    assert response.estimator == "periodic-local"
    assert np.percentile(relative_error(BOTH, response.frequency, response.response), 95) < 0.02


def test_runs_with_loads_in_proportion_tell_nothing_apart():
    run = BOTH.multisine()
    with pytest.raises(UserError, match="proportional to each other"):
        estimate_responses([run, replace(run, name="again")], GEOMETRY)


def test_dead_channels_and_runs_without_any():
    run = RIG.multisine(periods=3)
    channels = run.read().channels.copy()
    channels[:, 2] = 0.5
    transfer = estimate_responses([replace(run, source=MemorySource(channels, run.read().loads))], GEOMETRY)
    assert list(transfer.channels_left_out["run"]) == ["c2"]
    assert transfer.responses[0].channel_names == ("c0", "c1", "c3", "c4")
    with pytest.raises(UserError, match="no channel can be used"):
        estimate_responses([replace(run, source=MemorySource(0 * channels, run.read().loads))], GEOMETRY)
    with pytest.raises(UserError, match="none of the runs is a sweep"):
        estimate_responses([replace(run, kind="check")], GEOMETRY)


def test_lines_and_response_of_a_run_agree():
    run = RIG.multisine(periods=4)
    lines = periodic_record(run, RIG.names).spectrum
    (response,) = estimate_responses([run], GEOMETRY).responses
    assert response.response[:, :, 0] == pytest.approx(lines.channels / lines.loads)


# ---- the command -----------------------------------------------------------------------------------------------------


def call(*arguments):
    return CliRunner().invoke(balance, ["sweep-tf", "-g", str(ROOT / "configs" / "rts-6.yaml"), *map(str, arguments)])


def sample(name):
    return ROOT / "sample_data" / f"{name}.h5"


def test_command(tmp_path):
    out, summary = tmp_path / "tf.h5", tmp_path / "tf.json"
    result = call(sample("sweep-Fx-high"), sample("sweep-Mz-low"), sample("wind-1"), "-o", out, "--json", summary)
    assert result.exit_code == 0, result.output
    said = json.loads(summary.read_text())
    assert list(said["runs"]) == ["sweep-Fx-high", "sweep-Mz-low"]
    assert set(said["coherence_min"]) == set(said["relative_sigma"]) == {"Fx", "Mz"}
    assert 0.9 < said["coherence_min"]["Fx"] < 1.0
    assert said["left_out"] == {"wind-1": "a wind run; only sweeps are used"}
    transfer = load_artefact(out, {"balance-transfer/1": Transfer}).content
    assert transfer.responses[0].frequency[[0, -1]] == pytest.approx([2.0, 150.0])
    assert transfer.steady_parts["sweep-Mz-low"].steady


def test_same_inputs_same_digest(tmp_path):
    digests = set()
    for name in ("a.h5", "b.h5"):
        assert call(sample("sweep-Mz-low"), "-o", tmp_path / name).exit_code == 0
        digests.add(load_artefact(tmp_path / name, {"balance-transfer/1": Transfer}).digest)
    assert len(digests) == 1


def test_command_without_a_sweep(tmp_path):
    result = call(sample("wind-1"), "-o", tmp_path / "tf.h5")
    assert result.exit_code == 2
    assert "sweep" in result.output
    assert not (tmp_path / "tf.h5").exists()
    assert call(sample("sweep-Mz-low"), "--from", 90, "--to", 20, "-o", tmp_path / "tf.h5").exit_code == 2


THREE = SweptRig(components=("Fx", "Fz", "My"))


def six_runs(spread):
    """Six runs of three components; the readings of each are wrong by a factor of its own."""
    rng = np.random.default_rng(3)
    for seed in range(6):
        # Declared levels differ in the last digit, as a program writes them.
        run = replace(THREE.multisine(seed), name=f"run-{seed}", level=tuple(40.0 + 1e-9 * seed for _ in range(3)))
        block = run.read()
        yield replace(run, source=MemorySource(block.channels * (1 + spread * rng.standard_normal()), block.loads))


@pytest.mark.parametrize("spread", [0.0, 3e-3])
def test_more_runs_than_components_are_solved_together_and_their_differences_enter_sigma(spread):
    (response,) = estimate_responses(six_runs(spread), GEOMETRY).responses
    assert response.run.count("+") == 5
    assert np.sqrt(scatter(response, THREE)) == pytest.approx(1.0, abs=0.05 if spread == 0.0 else 0.25)


def test_runs_of_other_levels_are_solved_apart():
    runs = [replace(THREE.multisine(seed), name=f"run-{seed}") for seed in range(3)]
    low = [replace(run, name=f"low-{run.name}", level=(20.0, 40.0, 40.0)) for run in runs]
    assert len(estimate_responses([*runs, *low], GEOMETRY).responses) == 2


def test_progress_names_each_sweep_as_it_is_worked_on(monkeypatch):
    """The sweeps come one by one; a list made beforehand let the bar stand at 0 % until all were done."""
    order, runs = [], [replace(RIG.multisine(seed), name=f"sweep {seed}") for seed in range(2)]

    def progress(sweeps):
        for run in sweeps:
            order.append(f"begin {run.name}")
            yield run
            order.append(f"end {run.name}")

    def measure(run, *rest):
        order.append(f"measure {run.name}")
        return periodic_record(run, *rest)

    monkeypatch.setattr(sweep_tf, "periodic_record", measure)
    estimate_responses(runs, GEOMETRY, progress=progress)
    assert order == [f"{word} {run.name}" for run in runs for word in ("begin", "measure", "end")]
