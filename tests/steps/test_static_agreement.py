"""C0 of a calibration against the response at rest that runs are reduced by."""

from dataclasses import replace

import numpy as np
import pytest

import balance_cli as bal
from balance_cli.calibration.linear_matrix import LinearMatrix
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.diagnosis.consistency.findings import STATIC_RESPONSE
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.io.errors import UserError
from balance_cli.io.units import STANDARD_GRAVITY
from balance_cli.reduction.flags import MODEL_CONTRADICTED
from balance_cli.reduction.measured_response import transfer_source
from balance_cli.reduction.model_sources import model_source
from balance_cli.signals.response.transfer import select_channels
from balance_cli.simulation import Noise, simulate_campaign, true_rig
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.calibration_from_linear_matrix import calibration_from_linear_matrix
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.static_agreement import static_findings
from balance_cli.steps.sweep_tf import estimate_responses
from balance_cli.steps.trim_agreement import trim_findings
from tests.support.other_rigs import RIGS, other_rig, short_campaign


def scale(calibration, factor, trims=(), rows=slice(None), columns=slice(None)):
    """The calibration as if readings per load were `factor` times as large, in all trims or some."""

    def changed(trim):
        C0 = trim.C0.copy()
        C0[rows, columns] *= factor
        return replace(trim, C0=C0)

    return replace(
        calibration,
        trims={
            name: changed(trim) if name in (trims or calibration.trims) else trim
            for name, trim in calibration.trims.items()
        },
    )


@pytest.fixture(scope="module")
def rigs():
    """Calibration and exact model of each rig."""
    benches = {}
    for letter in RIGS:
        geometry = other_rig(letter)
        plan = short_campaign(letter)
        statics = plan.select_runs([run.run for run in plan.runs if run.kind == "static"])
        runs = simulate_campaign(true_rig(geometry), statics, Noise(), 1).runs
        model = identify(Spectra((), (), (), {}), geometry, IdentifyOptions(method="computed"))
        # As a fit of sweeps would leave it: the tolerances of a declared rig hide what is to be found.
        model = replace(model, covariance=model.covariance * 1e-4)
        benches[letter] = (calibrate(runs, geometry), model_source(model), geometry)
    return benches


@pytest.mark.parametrize("letter", RIGS)
def test_clean_rigs_agree_and_three_percent_of_one_trim_are_a_warning(rigs, letter):
    calibration, source, geometry = rigs[letter]
    assert static_findings(calibration, source, geometry) == ()
    (finding,) = static_findings(scale(calibration, 1.03, ("trim",)), source, geometry)
    assert finding.kind == STATIC_RESPONSE
    assert not finding.is_fault
    assert finding.trims == ("trim",)
    assert finding.factor == pytest.approx(1.03, abs=0.005)


@pytest.mark.parametrize("letter", RIGS)
def test_a_lever_that_is_five_percent_longer_than_stated_is_a_warning(rigs, letter):
    """Where lift sizes the channels it is below 2 % of their range: mean moments were 13 sigma off, unsaid."""
    calibration, source, geometry = rigs[letter]
    column = next(iter(calibration.trims.values())).components.index("My")
    (finding,) = static_findings(scale(calibration, 1.05, ("trim",), columns=column), source, geometry)
    assert not finding.is_fault
    assert finding.trims == ("trim",) and finding.components == ("My",)
    assert finding.factor == pytest.approx(1.05, abs=0.005)


@pytest.mark.parametrize("letter", RIGS)
def test_trims_that_differ_by_one_factor_are_a_warning_and_single_channels_are_none(rigs, letter):
    calibration, _, _ = rigs[letter]
    assert trim_findings(calibration) == ()
    (finding,) = trim_findings(scale(calibration, 1.03, ("trim",)))
    assert not finding.is_fault
    assert finding.trims == ("bare", "trim")
    assert finding.factor == pytest.approx(1.03, abs=0.005)
    assert trim_findings(scale(calibration, 1.03, ("trim",), rows=slice(0, 1))) == ()
    (finding,) = trim_findings(scale(calibration, STANDARD_GRAVITY, ("trim",)))
    assert "are they in kgf" in finding.text
    (finding,) = trim_findings(scale(calibration, 1.03, ("trim",), rows=slice(0, -1)))
    assert finding.channels == calibration.trims["trim"].channel_names[:-1]


@pytest.mark.parametrize("letter", RIGS)
def test_gross_differences_are_faults_that_name_their_cause(rigs, letter):
    calibration, source, geometry = rigs[letter]
    kg, *_ = static_findings(scale(calibration, STANDARD_GRAVITY), source, geometry)
    assert kg.is_fault
    assert "are they in kgf" in kg.text
    lbf, *_ = static_findings(scale(calibration, 4.44822, columns=2), source, geometry)
    assert lbf.components == ("Fz",)
    assert "are they in lbf?" in lbf.text
    turned, *_ = static_findings(scale(calibration, -1.0, rows=0), source, geometry)
    assert turned.channels == calibration.trims["bare"].channel_names[:1]
    assert "gain or polarity" in turned.text
    rng = np.random.default_rng(2)
    foreign = {name: replace(trim, C0=rng.permutation(trim.C0, axis=0)) for name, trim in calibration.trims.items()}
    other, *_ = static_findings(replace(calibration, trims=foreign), source, geometry)
    assert "another balance" in other.text


def test_campaign_agrees_with_its_model_and_its_measured_responses(campaign, identified, calibration):
    transfer = estimate_responses([run for run in campaign.runs if run.kind == "sweep"], campaign.geometry)
    measured = transfer_source(transfer, "local")
    assert static_findings(calibration, model_source(identified), campaign.geometry) == ()
    assert static_findings(calibration, measured, campaign.geometry) == ()
    fault, *_ = static_findings(scale(calibration, STANDARD_GRAVITY), measured, campaign.geometry)
    assert fault.is_fault


def test_a_channel_without_a_response_to_some_load_is_left_out_of_measured_responses(campaign, calibration):
    """Dead in one sweep of Fx, that of another level serves; dead in all, no load is computed from the channel."""
    transfer = estimate_responses([run for run in campaign.runs if run.kind == "sweep"], campaign.geometry)

    (swept,) = (item for item in transfer.responses if item.components == ("Fx",))
    others = tuple(item for item in transfer.responses if item is not swept)
    live = tuple(name for name in campaign.geometry.channel_names if name != "z1.strain")
    dead = replace(select_channels(swept, live), level=(2.0 * swept.level[0],))
    once, twice = (
        transfer_source(replace(transfer, responses=(*others, *sweeps)), "local") for sweeps in ((dead, swept), (dead,))
    )
    assert once.channel_names == campaign.geometry.channel_names and not once.channels_left_out
    assert twice.channels_left_out == {"z1.strain": "its response to Fx was not measured"}
    assert twice.at(np.array([20.0]), 0.0).shape[1] == len(campaign.geometry.channel_names) - 1
    assert static_findings(calibration, twice, campaign.geometry) == ()


def test_loads_of_contradicting_calibrations_are_flagged_or_refused(campaign, identified, calibration):
    wind = campaign.runs_of_kind("wind")
    off = bal.reduce(wind, scale(calibration, 1.03), identified)
    assert any("calibration and response at rest differ" in text for text in off.warnings)
    for loads in off.runs.values():
        assert all(MODEL_CONTRADICTED in word for row in loads.flags for word in row)
        assert any("at rest" in note for note in loads.notes)
    with pytest.raises(UserError, match="kgf"):
        bal.reduce(wind, scale(calibration, STANDARD_GRAVITY), identified)


def matrix_of(calibration, source, geometry, weight, factor=1.0):
    """A matrix of loads from readings alone, which channels weigh otherwise than their response does."""
    trim = calibration.trims["bare"]
    rows = [source.system.channel_names.index(name) for name in trim.channel_names]
    response = source.at(np.zeros(1), 0.0)[0].real[rows][:, [COMPONENTS.index(name) for name in trim.components]]
    T0 = np.linalg.pinv(response * weight[: len(rows), None]) * weight[: len(rows)]
    T0[0] *= factor
    units = tuple("V" for _ in rows)
    matrix = LinearMatrix(trim.components, trim.channel_names, units, T0, trim.calibrated_range)
    return calibration_from_linear_matrix(matrix, geometry, ())


@pytest.mark.parametrize("letter", ["A", "B", "D"])
def test_a_matrix_of_loads_from_more_channels_leaves_open_what_these_read(rigs, letter):
    """The pseudo-inverse of one with other weights differed by 37 % from the response, and all loads were flagged."""
    calibration, source, geometry = rigs[letter]
    weight = 10.0 ** np.random.default_rng(2).uniform(-0.5, 0.5, 40)
    assert static_findings(matrix_of(calibration, source, geometry, weight), source, geometry) == ()
    (finding,) = static_findings(matrix_of(calibration, source, geometry, weight, 1.05), source, geometry)
    assert not finding.is_fault and calibration.trims["bare"].components[0] in finding.components
