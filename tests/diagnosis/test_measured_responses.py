"""Diagnosis by measured responses alone: what is linear is found, and what needs samples is said not to be testable."""

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

import balance_cli as bal
from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.cli import balance
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.measured_responses import MeasuredResponses, add_responses, effects_of_samples
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.io.artefacts import Provenance, save_artefact
from balance_cli.io.errors import UserError
from balance_cli.simulation import SweepPlan, simulate_run, true_rig
from balance_cli.simulation.rig import apply_effects
from balance_cli.steps.hold_out import hold_out_data
from tests.support.rigs import two_degrees_of_freedom

GEOMETRY = two_degrees_of_freedom()
DELAY = 3e-4


def runs(number, effects=()):
    """One sweep of each component, with a name of its own."""
    rig = apply_effects(true_rig(GEOMETRY, stiffness=[1.03e6, 0.98e6]), effects)
    plans = [SweepPlan(run=f"{name}-{number}", excited=(name,), level=(level,), periods=6, period=2.0,
                       band=(4.0, 100.0)) for name, level in (("Fz", 20.0), ("My", 5.0))]  # fmt: skip
    return [simulate_run(rig, plan, seed=10 * number + i)[0] for i, plan in enumerate(plans)]


@pytest.fixture(scope="module")
def late():
    """Two sets of responses of a rig with one late channel."""
    effect = DeclaredEffect(name="time-delay", where=("a.strain",), parameters={"delay": DELAY})
    return tuple(bal.frequency_response(runs(number, [effect]), GEOMETRY) for number in (1, 2))


def test_a_late_channel_is_found_and_holds_in_responses_that_no_fit_has_seen(late):
    model = bal.identify(late[0], GEOMETRY)
    diagnosis, updated = bal.diagnose(model, late[0], hold_out=late[1])
    assert diagnosis.verdict == "explained"
    (effect,) = diagnosis.effects
    (delay,) = effect.parameters
    assert effect.label == "time-delay@a.strain" and abs(delay.value - DELAY) < 4.0 * delay.sigma < 0.1 * DELAY
    assert 0.85 < updated.quality.chi2_per_dof < 1.2
    assert set(diagnosis.hold_out) == {"Fz-2", "My-2"}
    for errors in diagnosis.hold_out.values():
        assert errors.after.frf_error < 1.2 * errors.noise.frf_error
        assert errors.before.frf_error > 2.0 * errors.noise.frf_error
    reasons = {item.name: item.reason for item in diagnosis.untestable_effects}
    assert len(reasons) == len(diagnosis.untestable_effects)
    assert all("no samples" in reasons[name] for name in ("cubic-stiffness", "channel-offset", "saturation"))


@pytest.mark.parametrize("count", [1, 2])
def test_responses_that_no_rig_has_are_not_explained(count):
    """Columns that are wrong by what no effect does, a ripple of some per cent about 40 Hz: one alone is named."""
    transfer = bal.frequency_response(runs(3), GEOMETRY)
    responses = list(transfer.responses)
    for i in range(count):
        line = responses[i].frequency
        ripple = 1.0 + 0.05 * np.exp(-(((line - 40.0) / 10.0) ** 2) + 1j * (i + 1.0) * line)
        responses[i] = replace(responses[i], response=responses[i].response * ripple[:, None, None])
    transfer = replace(transfer, responses=tuple(responses))
    model = bal.identify(transfer, GEOMETRY)
    diagnosis, _ = bal.diagnose(model, transfer, settings=replace(DEFAULT_SETTINGS, time_limit=5.0))
    if count == 1:
        assert diagnosis.left_out.name == "Fz-3" and diagnosis.verdict == "partly explained"
    else:
        assert diagnosis.verdict in ("unexplained", "partly explained") and diagnosis.chi2_per_dof_after > 1.2


def test_of_responses_that_repeat_each_other_one_is_kept_aside(late):
    nothing = Spectra((), (), {}, {})
    both = add_responses(nothing, [MeasuredResponses(item, f"{i}.h5") for i, item in enumerate(late)])
    data, spectra = hold_out_data((), (), (), both)
    assert data.kept_aside == data.names == ("Fz-1",)
    assert [run.run for run in spectra.lines] == ["My-1", "Fz-2", "My-2"]
    data, spectra = hold_out_data((), (), (), add_responses(nothing, [MeasuredResponses(late[0])]))
    assert data.names == () and len(spectra.lines) == 2
    given = add_responses(nothing, [MeasuredResponses(late[1])]).lines
    data, spectra = hold_out_data((), given, (), both)
    assert data.names == ("Fz-2", "My-2") and data.kept_aside == () and spectra is both


def test_responses_that_are_fitted_are_no_hold_out(late):
    model = bal.identify([], GEOMETRY, method="computed")
    with pytest.raises(UserError, match="a second time"):
        bal.diagnose(model, late[0], hold_out=late[0])


def test_an_effect_that_needs_samples_cannot_be_suspected(late):
    assert {"cubic-stiffness", "dry-friction", "mains-pickup"} <= set(effects_of_samples())
    model = bal.identify([], GEOMETRY, method="computed")
    settings = replace(DEFAULT_SETTINGS, suspected=("cubic-stiffness@a,inside",))
    with pytest.raises(UserError, match="frequency responses hold no samples"):
        bal.diagnose(model, late[0], settings=settings)


def test_the_command_names_what_it_lacks(tmp_path, late):
    nothing = Provenance("test", {}, (), {}, "")
    save_artefact(tmp_path / "tf.h5", "balance-transfer/1", late[0], nothing)
    model = bal.identify(late[0], GEOMETRY)
    save_artefact(tmp_path / "m.h5", "balance-model/1", model, nothing)
    paths = [str(tmp_path / name) for name in ("m.h5", "tf.h5")]
    options = ["-o", str(tmp_path / "d.h5"), "--model-out", str(tmp_path / "u.h5")]
    result = CliRunner().invoke(balance, ["diagnose", *paths, *options])
    assert result.exit_code == 0, result.output
    assert "no response repeats another one" in result.output
    assert "time-delay@a.strain" in result.output
    result = CliRunner().invoke(balance, ["diagnose", *paths, "--hold-out", paths[1], *options])
    assert result.exit_code == 2 and "a second time" in result.output


def test_responses_with_smooth_errors_are_no_data_of_a_diagnosis(late):
    """By local models they passed for crosstalk of 5 sigma in two of six campaigns without a fault."""
    model = bal.identify([], GEOMETRY, method="computed")
    smooth = replace(late[0], responses=tuple(replace(item, estimator="lrm") for item in late[0].responses))
    with pytest.raises(UserError, match="estimated by `lrm`: its errors are smooth"):
        bal.diagnose(model, smooth)
