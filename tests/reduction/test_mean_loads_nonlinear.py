"""Mean loads where the readings curve with the loads: by iteration, or refused."""

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from balance_cli.calibration.convergence import contraction
from balance_cli.calibration.terms import all_terms, term_derivatives, term_values
from balance_cli.campaign.recording.channel_health import ChannelHealth
from balance_cli.campaign.recording.run import MemorySource
from balance_cli.campaign.recording.run_file import write_run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.cli import balance
from balance_cli.io.errors import UserError
from balance_cli.reduction.mean_loads import linear_mean_loads
from balance_cli.reduction.mean_loads_nonlinear import ALL_TRIMS, nonlinear_mean_loads
from balance_cli.reduction.response_sources import static_source
from balance_cli.reduction.wind_off import zero_record
from balance_cli.steps.reduce import reduce_run
from tests.support.nonlinear_rig import (
    AMPLITUDE,
    NAMES,
    RIG,
    calibration,
    other_flags,
    readings,
    record,
    spectra,
    static_runs,
)
from tests.support.rigs import CONFIGS

LOADS = np.array([300.0, -200.0, 2000.0, 100.0, -80.0, 150.0])
ALL_LIVE = ChannelHealth(NAMES, {})


def zero(shift=0.0, seed=5):
    return zero_record(record("zero", np.zeros(6), shift, kind="zero", seed=seed), NAMES)


def reduced(run, cal, reference=None):
    return reduce_run(run, RIG, cal, static_source(cal), reference)


def with_model(cal, **changes):
    """The calibration with its model changed."""
    return replace(cal, all_trims=replace(cal.all_trims, model=replace(cal.all_trims.model, **changes)))


def test_mean_loads_are_those_applied_within_sigma():
    found = reduced(record("w", LOADS), calibration(), zero())
    error = (found.amplitude[0].real - LOADS) / found.sigma_cosine[0]
    assert np.abs(error).max() < 4.0
    assert np.all(found.sigma_cosine[0] < 1e-4 * AMPLITUDE)
    assert found.flags[0] == ("untested", "", "", "", "untested", "untested")
    assert found.trim == ALL_TRIMS and found.redundancy[0] < found.redundancy_limit[0]
    straight = replace(calibration(), all_trims=None)
    assert np.max(np.abs(reduced(record("w", LOADS), straight, zero()).amplitude[0].real - LOADS)) > 0.5


def test_what_shifts_record_and_zero_alike_changes_nothing():
    plain, shifted = (reduced(record("w", LOADS, shift), calibration(), zero(shift)) for shift in (0.0, 0.02))
    np.testing.assert_allclose(shifted.amplitude[0], plain.amplitude[0], rtol=0, atol=1e-9)


def test_without_a_zero_run_loads_count_from_the_zeros_of_the_calibration():
    found = reduced(record("w", LOADS), calibration())
    assert other_flags(found.flags[0]) == ("no zero",) * 6
    assert np.all(np.abs(found.amplitude[0].real - LOADS) < 5e-4 * AMPLITUDE)


@pytest.mark.parametrize("lost", ["z3.strain", "y1.strain"])
def test_a_dead_channel_is_left_out(lost):
    run = record("w", LOADS)
    channels = run.read().channels.copy()
    channels[:, NAMES.index(lost)] = 0.0
    found = reduced(replace(run, source=MemorySource(channels, None)), calibration(), zero())
    assert lost in found.left_out
    assert np.all(np.abs(found.amplitude[0].real - LOADS) < 5 * found.sigma_cosine[0])


def test_sigma_covers_the_errors_of_calibration_and_record():
    rng = np.random.default_rng(3)
    cal, inside = calibration(), []
    for _ in range(200):
        loads = 0.8 * AMPLITUDE * rng.uniform(-1, 1, 6)
        volts = 0.05 + readings(loads)[0] + 2e-5 * rng.normal(size=len(NAMES))
        found = nonlinear_mean_loads(spectra(volts, 2e-5), cal, cal.all_trims.model, ALL_LIVE, None)
        inside.append(np.abs(found.loads - loads) < 1.96 * found.sigma)
    assert np.mean(inside) > 0.85
    assert np.mean(found.sigma / AMPLITUDE) < 1e-4


@pytest.mark.parametrize("curved", [True, False])
def test_sigma_without_a_zero_record_covers_the_scatter_of_the_zeros(curved):
    rng = np.random.default_rng(4)
    scatter, whole = 2e-3, calibration(curved)
    zeros = 0.05 + scatter * rng.normal(size=(25, len(NAMES)))
    trims = {name: replace(trim, offsets=zeros) for name, trim in whole.trims.items()}
    cal, inside = replace(with_model(whole, zeros=zeros), trims=trims), []
    for _ in range(40):
        loads = 0.5 * AMPLITUDE * rng.uniform(-1, 1, 6)
        response = readings(loads)[0] if curved else loads @ cal.trims["bare"].C0.T
        mean = spectra(0.05 + scatter * rng.normal(size=len(NAMES)) + response, 1e-5)
        found = (
            nonlinear_mean_loads(mean, cal, cal.all_trims.model, ALL_LIVE, None)
            if curved
            else linear_mean_loads(mean, cal, ALL_LIVE, None)
        )
        # The matrix of a trim has one degree of freedom for its errors here: its residual test rejects hardly anything.
        flags = other_flags(found.flags) if curved else tuple(flag.removesuffix("; untested") for flag in found.flags)
        assert flags == ("no zero",) * 6 and "untested" in found.flags[5]
        inside.append(np.abs(found.loads - loads) < 1.96 * found.sigma)
    assert 0.91 < np.mean(inside) < 0.99


def test_readings_that_contradict_each_other_are_flagged():
    volts = 0.05 + readings(LOADS)[0]
    volts[NAMES.index("z2.strain")] += 0.01
    found = nonlinear_mean_loads(spectra(volts, 2e-5), calibration(), calibration().all_trims.model, ALL_LIVE, None)
    assert other_flags(found.flags) == ("no zero; redundancy",) * 6
    sound = nonlinear_mean_loads(
        spectra(0.05 + readings(LOADS)[0], 2e-5), calibration(), calibration().all_trims.model, ALL_LIVE, None
    )
    assert np.all(found.sigma > 3 * sound.sigma)


@pytest.mark.parametrize("curved", [True, False])
def test_a_load_outside_those_of_the_calibration_is_flagged(curved):
    cal = calibration(curved)
    assert cal.all_trims.model.is_nonlinear == curved
    loads = LOADS * [1, 1, 1, 1, 1, 1.03 * 450.0 / 150.0]
    found = reduced(record("w", loads, curved=curved), cal, zero())
    assert other_flags(found.flags[0]) == ("",) * 5 + ("extrapolated",)
    np.testing.assert_allclose(found.amplitude[0].real, loads, atol=0.5)


def test_a_straight_model_leaves_the_nearest_trim_in_its_place():
    cal = calibration(curved=False)
    volts = 0.05 + LOADS @ cal.trims["bare"].C0.T
    found = linear_mean_loads(spectra(volts), cal, ALL_LIVE, None)
    trim = cal.trims[found.trim]
    np.testing.assert_array_equal(found.loads, trim.mean_load + trim.T0 @ (volts - trim.mean_channels))
    assert reduced(record("w", LOADS, curved=False), cal).trim in cal.trims


def test_random_terms_compute_mean_loads_also_where_no_term_was_selected():
    straight, curved = calibration(curved=False), calibration()
    assert straight.all_trims.random_terms is None and not straight.all_trims.model.is_nonlinear
    cal = replace(straight, all_trims=replace(straight.all_trims, random_terms=curved.all_trims.loads_model))
    assert reduced(record("w", LOADS), cal, zero()).trim in cal.trims
    cal = replace(cal, trims={"bare": straight.trims["bare"]})
    found = reduced(record("w", LOADS), cal, zero())
    assert found.trim == ALL_TRIMS
    error = (found.amplitude[0].real - LOADS) / found.sigma_cosine[0]
    assert np.abs(error).max() < 4.0
    with pytest.raises(AssertionError):
        np.testing.assert_allclose(reduced(record("w", LOADS), straight, zero()).amplitude[0].real, LOADS, atol=0.5)


def test_loads_beyond_the_reach_of_the_proof_are_refused():
    with pytest.raises(UserError) as caught:
        reduced(record("w9", 1.6 * AMPLITUDE * [0, 0, 1, 0, 0, 0]), calibration(), zero())
    message = str(caught.value)
    assert message.startswith(
        "w9, mean of Fz: the mean lies outside the range of proved convergence: Fz of about 5600 N"
    )
    assert "1.6 times the calibrated range (3500 N)" in message and "--skip-bad" in message


def test_loads_so_large_that_the_iteration_runs_away_are_refused():
    with pytest.raises(UserError, match=r"mean of .*Fx.*times the calibrated range"):
        reduced(record("w9", 60.0 * AMPLITUDE * [1, 0, 1, 0, 0, 0]), calibration(), zero())


def test_a_model_whose_iteration_is_not_proved_is_refused():
    model = calibration().all_trims.model
    curved = np.arange(len(model.terms))[:, None] >= 6
    wild = with_model(calibration(), coefficients=np.where(curved, 60.0, 1.0) * model.coefficients)
    assert not wild.all_trims.model.contraction().is_proved
    with pytest.raises(UserError, match=r"w, mean of Fx, Fy, Fz, Mx, My, Mz: the iteration .* not proved to converge"):
        reduced(record("w", LOADS), wild, zero())


def test_channels_that_do_not_determine_the_loads_are_refused():
    with pytest.raises(UserError, match="do not determine the mean loads"):
        live = ChannelHealth(tuple(name for name in NAMES if name != "torque"), {"torque": "dead"})
        nonlinear_mean_loads(spectra(np.zeros(len(NAMES))), calibration(), calibration().all_trims.model, live, None)


def test_skip_bad_leaves_out_the_run_that_cannot_be_solved(tmp_path):
    for run in (*static_runs(np.random.default_rng(1)), record("w1", LOADS), record("w2", [0, 0, 7000.0, 0, 0, 0])):
        write_run(tmp_path / f"{run.name}.h5", run)
    cal, out = tmp_path / "cal.h5", tmp_path / "loads.csv"
    static = [str(path) for path in sorted(tmp_path.glob("static-*.h5"))]
    words = ["calibrate", "-g", str(CONFIGS / "rts-6.yaml"), *static, "-o", str(cal)]
    assert CliRunner().invoke(balance, words).exit_code == 0
    words = ["reduce", "--calibration", str(cal), "--static", *(str(tmp_path / f"w{i}.h5") for i in (1, 2))]
    refused = CliRunner().invoke(balance, [*words, "-o", str(out), "--strict"])
    assert refused.exit_code == 2 and not out.exists()
    assert "w2.h5, mean of Fz" in refused.stderr
    done = CliRunner().invoke(balance, [*words, "-o", str(out), "--skip-bad"])
    assert done.exit_code == 0, done.output
    assert "w1" in out.read_text() and "w2" not in out.read_text()


# ---- the model and the proof behind them -----------------------------------------------------------------------------


def test_the_tangent_is_the_derivative_of_the_readings():
    model = calibration().all_trims.model
    h = 1e-6
    for j in range(6):
        step = h * np.eye(6)[j] * model.calibrated_range
        numerical = (model.readings(LOADS[None] + step) - model.readings(LOADS[None] - step))[0] / (2 * h)
        np.testing.assert_allclose(model.jacobian(LOADS)[0, :, j], numerical, atol=1e-8)


def test_the_proof_holds_where_a_load_has_next_to_no_part_in_the_slowest_direction():
    terms = [term for term in all_terms(6) if term.name(COMPONENTS) in ("Fx^3", "Fx Fz", "Fz^2")]
    nonlinear_matrix = np.zeros((6, 3))
    nonlinear_matrix[0, :], nonlinear_matrix[4, 0], nonlinear_matrix[2, 2] = 0.02, 0.05, 1e-6
    proof = contraction(nonlinear_matrix, terms, 6)
    assert proof.is_proved and np.all(proof.reach < 1.3)
    rng = np.random.default_rng(0)
    # What was proved: no error after one step is larger than M times the error before.
    M = np.abs(nonlinear_matrix) @ np.max(np.abs(term_derivatives(terms, proof.reach[None])), axis=0)
    x, y = (proof.reach * rng.uniform(-1, 1, (500, 6)) for _ in range(2))
    after = np.abs((term_values(terms, x) - term_values(terms, y)) @ nonlinear_matrix.T)
    assert np.all(after <= np.abs(x - y) @ M.T + 1e-12)


def test_what_is_untested_is_judged_by_loads_and_sigma_in_one_unit(monkeypatch):
    """Loads relative to their range were compared with sigma in N: three untested cells left Fz 9 sigma off."""
    judged = []

    def judge(equations, sensors, limit, sigma):
        judged.append((equations.estimator @ equations.readings, sigma))
        return np.zeros(len(sigma), bool)

    monkeypatch.setattr("balance_cli.reduction.mean_loads_nonlinear.untested_means", judge)
    found = reduced(record("w", LOADS), calibration(), zero())
    (loads, sigma), in_newton = judged[0], calibration().all_trims.model.calibrated_range
    np.testing.assert_allclose(loads * in_newton, LOADS, rtol=0.05, atol=5.0)
    np.testing.assert_allclose(sigma * in_newton, found.sigma_cosine[0], rtol=1e-6)
