"""Local rational and polynomial models: no leakage beside lightly damped modes, and a covariance that is right."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.io.errors import UserError
from balance_cli.signals.local.fit import ModelOrders, WindowedData, fit_windows
from balance_cli.signals.local.models import _usual_lines, fit_local_models
from balance_cli.signals.local.nonperiodic_spectrum import nonperiodic_record, nonperiodic_spectrum
from balance_cli.signals.local.response import local_response, response_from_models
from balance_cli.signals.local.scaled_spectrum import RATIONAL_LINES, record_spectrum
from balance_cli.signals.local.window import (
    derivative_rows,
    pole_uncertainty,
    poles,
    response_rows,
    split_windows,
)
from balance_cli.signals.response.averaged_spectra import averaged_response
from balance_cli.signals.run_samples import read_samples
from balance_cli.simulation import Noise, SweepPlan, draw_rig, simulate_run
from balance_cli.simulation.assembly import equations_of_motion
from tests.support.rigs import rotor_balance
from tests.support.swept_rig import LOAD_NOISE, NOISE, SweptRig, chi2_per_dof, near_mode, relative_error

BAND = (5.0, 145.0)
RIG = SweptRig()
BOTH = SweptRig(components=("Fx", "My"))


@pytest.fixture(scope="module", params=["random", "sine_sweep"])
def run(request):
    return getattr(RIG, request.param)(seed=1)


@pytest.fixture(scope="module")
def models(run):
    return fit_local_models(record_spectrum(run, RIG.names, BAND))


@pytest.fixture(scope="module")
def lrm(models):
    return response_from_models(models, "lrm")


def scaled_error(response, rig):
    """Mean square (k,) of the error of every entry over its stated variance."""
    channels = np.diagonal(response.channel_covariance, axis1=1, axis2=2).real
    loads = np.diagonal(response.load_covariance, axis1=1, axis2=2).real
    error = np.abs(response.response - rig.response(response.frequency)) ** 2
    return np.mean(error / (channels[:, :, None] * loads[:, None, :]), axis=(1, 2))


def test_local_rational_model_does_not_leak(run, lrm):
    error = relative_error(RIG, lrm.frequency, lrm.response)
    near = near_mode(lrm.frequency, 0.5)
    assert np.percentile(error, 95) < 1e-3
    assert np.percentile(error[near], 95) < 5e-4


def test_the_other_estimators_do(run):
    """95th percentile beside the modes (half a hertz), what the local rational model is there for."""
    errors = {}
    for name, estimate in (("lpm", local_response), ("h1", averaged_response)):
        response = estimate(run, RIG.names, name, BAND)
        error = relative_error(RIG, response.frequency, response.response)
        errors[name] = np.percentile(error[near_mode(response.frequency, 0.5)], 95)
    assert errors["lpm"] > 0.05
    assert errors["h1"] > 0.1


def test_covariance_of_the_response_is_right(lrm):
    chi2 = scaled_error(lrm, RIG)
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.3)
    assert np.median(chi2) == pytest.approx(0.85, abs=0.25)


def test_a_rig_that_is_slower_throughout_has_the_same_response():
    """The same samples, recorded at a twentieth of the rate: only the frequencies are others."""
    run = RIG.random(seed=1, seconds=14.0)
    fast = local_response(run, RIG.names, "lrm", BAND)
    slow = local_response(replace(run, sample_rate=RIG.rate / 20.0), RIG.names, "lrm", (BAND[0] / 20, BAND[1] / 20))
    np.testing.assert_allclose(slow.frequency, fast.frequency / 20.0, rtol=1e-12)
    np.testing.assert_allclose(slow.response, fast.response, rtol=1e-9)
    np.testing.assert_allclose(slow.channel_covariance, fast.channel_covariance, rtol=1e-9)


@pytest.mark.parametrize("first", [1, 1000, 2500])
def test_windows_of_a_band_that_begins_near_zero_hold_a_mode(first):
    """The lines of the Silverbox end at 251 Hz, 0.03 Hz apart; its mode at 68 Hz has a half-power width of 3 Hz."""
    frequency = 0.0277 * np.arange(first, 9057)
    lines = _usual_lines(frequency, np.median(frequency))
    assert 3.0 < 0.0277 * lines < 20.0


def test_windows_do_not_widen_with_the_noise_above_what_was_excited():
    """The lines of a positioning axis reach 446 Hz, half of the power of its drive is below 1 Hz."""
    frequency = 0.04 * np.arange(1, 11092)
    lines = _usual_lines(frequency, 1.0)
    assert lines == RATIONAL_LINES


@pytest.mark.parametrize("excitation", ["random", "sine_sweep"])
def test_windows_of_a_short_record_are_narrower_than_the_distances_of_its_modes(excitation):
    """81 lines are 27 Hz wide: errors were rms 42 and 66 in 1e6, and sigma three times the scatter in the first."""
    rig = SweptRig(channels=12)
    response = local_response(getattr(rig, excitation)(1, 3.0), rig.names, "lrm", BAND)
    error = np.abs(response.response - rig.response(response.frequency))
    assert np.sqrt(np.mean(error**2)) < 30e-6
    assert np.sqrt(np.mean(scaled_error(response, rig))) == pytest.approx(1.0, abs=0.15)


def test_first_lines_of_a_short_sweep_are_as_good_as_their_sigma():
    """A transient of higher degree than the response, or a window kept for what it saves, made them up to 2.4."""
    rig = SweptRig(channels=12)
    errors = []
    for seed in range(4, 8):
        response = local_response(rig.sine_sweep(seed, 6.0), rig.names, "lrm", (2.0, 150.0))
        errors.append(np.mean(scaled_error(response, rig)[:20]))
    assert np.sqrt(np.mean(errors)) < 1.25


def test_lines_of_a_short_record_of_few_channels_have_chi_square_one():
    """With windows of 81 lines it was 0.02: bias counted as noise."""
    rig = SweptRig(channels=5)
    lines = nonperiodic_spectrum(rig.random(0, 3.0), rig.names, (2.0, 150.0))
    assert np.mean(chi2_per_dof(rig, lines)) == pytest.approx(1.0, abs=0.2)


def test_lines_near_the_end_of_a_stepped_record_do_not_lend_their_response_to_its_transient():
    """A line had a chi-square of 6.2 per degree of freedom, and nothing in the residual of its window showed it."""
    rig = SweptRig(zeta=0.02, noise=0.1 * NOISE, load_noise=0.1 * LOAD_NOISE)
    chi2 = chi2_per_dof(rig, nonperiodic_spectrum(rig.stepped(0), rig.names))
    assert chi2.max() < 3.5
    assert chi2.mean() == pytest.approx(1.0, abs=0.1)
    assert len(chi2) > 200


def test_a_record_too_short_for_its_modes_is_refused_with_the_width_of_its_windows():
    """Only stronger excitation had been asked for."""
    rig = SweptRig(channels=12, zeta=0.015, modes=(40.0, 44.0, 48.0, 52.0, 56.0, 60.0))
    fault = "the loads exceed their noise at no line"
    with pytest.raises(UserError, match=f"{fault}.*record for longer.*more than 3 modes within .* lines, 2.* Hz"):
        nonperiodic_spectrum(rig.random(0, 1.8), rig.names, (2.0, 150.0))


def test_coherence_is_high_and_below_one(lrm):
    best = lrm.multiple_coherence.max(axis=1)
    assert best.min() > 0.99
    assert best.max() < 1.0
    assert lrm.coherence[:, :, 0] == pytest.approx(lrm.multiple_coherence, abs=1e-9)


def test_noise_of_channels_and_loads_is_told_apart(models):
    line = 4 / models.spectrum.run.samples
    channels = np.diagonal(models.noise.channels, axis1=1, axis2=2).real.mean(axis=0) * models.spectrum.channel_scale**2
    loads = models.noise.loads[0, 0].real * models.spectrum.load_scale[0] ** 2
    assert channels == pytest.approx(np.full(5, NOISE**2 * line), rel=0.08)
    assert loads == pytest.approx(LOAD_NOISE**2 * line, rel=0.25)


@pytest.mark.parametrize("excitation", ["random", "sine_sweep"])
def test_chi_square_of_the_true_response_against_the_lines(excitation):
    """Some 650 lines of 5 channels in each of two runs, 60 of them beside the modes."""
    values, near = [], []
    for seed in range(2):
        lines = nonperiodic_spectrum(getattr(RIG, excitation)(seed), RIG.names, BAND)
        values.append(chi2_per_dof(RIG, lines))
        near.append(near_mode(lines.frequency, 0.5))
    values, near = np.concatenate(values), np.concatenate(near)
    assert near.sum() > 100
    assert values.mean() == pytest.approx(1.0, abs=0.1)
    assert values[near].mean() == pytest.approx(1.0, abs=0.15)


def test_lines_lose_next_to_nothing():
    """Information on a resonance frequency, against all lines of the record with a transient that is known."""
    run = RIG.random(seed=2)
    lines = nonperiodic_spectrum(run, RIG.names, (70.0, 85.0))
    U = np.fft.rfft(run.read().loads[:, :1], axis=0)[70 * 28 : 85 * 28] * 2 / run.samples
    everything = np.arange(70 * 28, 85 * 28) / 28.0
    noise = np.diag([NOISE**2] * 5 + [LOAD_NOISE**2]) * 4 / run.samples
    bound = information(everything, U, np.broadcast_to(noise, (len(everything), 6, 6)))
    assert information(lines.frequency, lines.loads, lines.covariance) == pytest.approx(bound, rel=0.15)


def information(frequency, loads, covariance):
    """Fisher information on a frequency scale, by which the response slides along the frequency axis."""
    step = 1e-6
    T = RIG.response(frequency)
    slope = (RIG.response(frequency * (1 + step)) - RIG.response(frequency * (1 - step))) / (2 * step)
    combine = np.concatenate([np.broadcast_to(np.eye(5), (len(T), 5, 5)), -T], axis=2)
    weight = np.linalg.inv(combine @ covariance @ combine.conj().swapaxes(1, 2))
    moved = np.einsum("kcu,ku->kc", slope, loads)
    return 2 * np.einsum("kc,kcd,kd->", moved.conj(), weight, moved).real


@pytest.mark.parametrize("excitation", ["random", "sine_sweep"])
def test_two_components_at_once(excitation):
    run = getattr(BOTH, excitation)(seed=3, seconds=20.0)
    response = local_response(run, BOTH.names, "lrm", BAND)
    assert response.components == ("Fx", "My")
    assert np.percentile(relative_error(BOTH, response.frequency, response.response), 95) < 2e-3
    lines = nonperiodic_spectrum(run, BOTH.names, BAND)
    assert chi2_per_dof(BOTH, lines).mean() == pytest.approx(1.0, abs=0.2)
    assert np.all(lines.frequency[::2] == lines.frequency[1::2])


def test_short_record_and_wrong_records():
    short = RIG.random(seconds=10.0)
    error = relative_error(RIG, *_of(local_response(short, RIG.names, "lrm", BAND)))
    assert np.percentile(error, 95) < 1.5e-3
    with pytest.raises(UserError, match="too short"):
        local_response(RIG.random(seconds=0.3), RIG.names)
    with pytest.raises(UserError, match="no `loads`"):
        local_response(replace(short, source=_without_loads(short)), RIG.names)


def test_loads_in_proportion_to_each_other_are_refused():
    run = BOTH.random(seconds=10.0)
    loads = run.read().loads.copy()
    loads[:, 4] = 0.3 * loads[:, 0]
    with pytest.raises(UserError, match="proportional to each other"):
        local_response(replace(run, source=replace(run.source, loads=loads)), BOTH.names)
    with pytest.raises(UserError, match="proportional to each other"):
        averaged_response(replace(run, source=replace(run.source, loads=loads)), BOTH.names)


def _of(response):
    return response.frequency, response.response


def _without_loads(run):
    return replace(run.source, loads=None)


# ---- one window ------------------------------------------------------------------------------------------------------


def window(seed=0, noise=0.0, lines=61, pole=0.2 + 0.15j):
    """Y = (b0 / (r - p) + b1) U + c0 / (r - p), three channels of one input."""
    rng = np.random.default_rng(seed)
    r = np.linspace(-1, 1, lines)[None]
    U = rng.normal(size=(1, lines, 1)) + 1j * rng.normal(size=(1, lines, 1))
    b0, b1, c0 = rng.normal(size=(3, 3)) + 1j * rng.normal(size=(3, 3))
    G = b0 / (r[..., None] - pole) + b1
    V = rng.normal(size=(1, lines, 3)) + 1j * rng.normal(size=(1, lines, 3))
    Y = G * U + c0 / (r[..., None] - pole) + noise * V / np.sqrt(2)
    return WindowedData(Y, U, np.ones((1, lines)), r), lambda x: b0 / (x - pole) + b1, pole


def test_exact_rational_function_is_found_exactly():
    windows, G, pole = window()
    fit = fit_windows(windows, ModelOrders(1, 1, 1))
    window_fit = split_windows(fit, windows)[0]
    assert fit.cost[0] < 1e-18
    assert poles(window_fit) == pytest.approx([pole])
    assert (response_rows(window_fit, np.array([0.37])) @ window_fit.coefficients)[0, 0] == pytest.approx(G(0.37))


def test_a_window_with_one_line_is_fitted_without_a_number_out_of_range():
    """Nothing tells its denominator, so that a step has no bound of its own."""
    windows, _, _ = window(noise=0.1, lines=27)
    weight = np.zeros((1, 27))
    weight[0, 0] = 1.0
    alone = replace(windows, Y=windows.Y * weight[..., None], weight=weight)
    for denominator in (1, 2, 3):
        fit = fit_windows(alone, ModelOrders(3, -1, denominator))
        assert np.linalg.norm(fit.denominator) == pytest.approx(1.0)
        assert np.all(np.isfinite(fit.coefficients))


def test_slope_of_a_window():
    windows, G, _ = window()
    one = split_windows(fit_windows(windows, ModelOrders(1, 1, 1)), windows)[0]
    slope = (derivative_rows(one, np.array([0.37])) @ one.coefficients)[0, 0]
    assert slope == pytest.approx((G(0.37 + 1e-6) - G(0.37 - 1e-6)) / 2e-6, rel=1e-6)


def test_influence_gives_the_coefficients():
    windows, _, _ = window(noise=0.1)
    one = split_windows(fit_windows(windows, ModelOrders(2, 1, 1)), windows)[0]
    assert one.pseudoinverse @ windows.Y[0] == pytest.approx(one.coefficients)


def test_stated_uncertainty_of_a_window_is_that_of_repetitions():
    """Coefficients and pole together, at the place where the pole matters most."""
    noise, r, errors, stated = 0.05, np.array([0.2]), [], []
    windows, G, _ = window(noise=0.0)
    rng = np.random.default_rng(11)
    size = windows.Y.shape
    for _ in range(300):
        V = noise * (rng.normal(size=size) + 1j * rng.normal(size=size)) / np.sqrt(2)
        noisy = replace(windows, Y=windows.Y + V)
        one = split_windows(fit_windows(noisy, ModelOrders(1, 1, 1)), noisy)[0]
        errors.append((response_rows(one, r) @ one.coefficients)[0, 0] - G(0.2))
        covariance = np.broadcast_to(noise**2 * np.eye(3), (61, 3, 3))
        linear = noise**2 * np.sum(np.abs(response_rows(one, r)[0, 0] @ one.pseudoinverse) ** 2)
        stated.append(linear + np.sum(np.abs(pole_uncertainty(one, r, covariance)[0, :, 0]) ** 2, axis=1))
    assert np.mean(np.abs(errors) ** 2, axis=0) == pytest.approx(np.mean(stated, axis=0), rel=0.2)
    assert np.abs(np.mean(errors, axis=0)) == pytest.approx(np.zeros(3), abs=3.5 * np.sqrt(np.max(stated) / 300))


def test_lines_of_a_stepped_record_are_wrong_by_little_beside_their_noise():
    """The lines are linear in the record, so that without its noise they show what the local models leave out.

    With numerators of fixed degree, a pole that followed the noise of one line made their chi-square ten times as
    large as it should be: 3554 too much in all.
    """
    geometry = rotor_balance()
    rig = draw_rig(geometry, np.random.default_rng(2))
    rig = replace(rig, damping_ratios=np.maximum(rig.damping_ratios, 0.005))
    plan = SweepPlan(run="sweep-Fx", excited=("Fx",), level=(40.0,), excitation="stepped", period=2.0, periods=5)
    noisy, _ = simulate_run(rig, plan, seed=2)
    clean, _ = simulate_run(rig, plan, Noise().scale_by(0.0), seed=2)
    record = nonperiodic_record(noisy, geometry.channel_names)
    window = record.first[:, None] + np.arange(record.weight.shape[1])
    channels, loads = read_samples(clean, geometry.channel_names)
    spectrum = np.fft.rfft(np.hstack([channels, loads[:, :1]]), axis=0)[record.bin_index] * (2.0 / len(channels))
    exact = np.matmul(record.weight[:, None, :], spectrum[window])[:, 0]
    lines = record.spectrum
    T = identified_response(rig, lines.frequency)
    remainder = exact[:, :-1] - T * exact[:, -1:]
    noise = lines.covariance[:, :-1, :-1] + T[:, :, None] * T[:, None, :].conj() * lines.covariance[:, -1:, -1:].real
    excess = 2.0 * np.real(np.einsum("ki,kij,kj->k", remainder.conj(), np.linalg.inv(noise), remainder))
    assert excess.sum() < 50.0
    assert excess.max() < 10.0
    assert len(lines.frequency) > 200


def identified_response(rig, frequency):
    """T (f, c) to Fx of a rig without effects, as it was declared to the simulation."""
    mechanics = equations_of_motion(rig)
    s = 2j * np.pi * frequency[:, None, None]
    A = s**2 * mechanics.mass + s * mechanics.damping + mechanics.total_stiffness()
    q = np.linalg.solve(A, np.broadcast_to(mechanics.loads[:, :1], (len(frequency), mechanics.size, 1)))[:, :, 0]
    forces = q @ (mechanics.cell_stiffness[:, None] * mechanics.cell_rows).T
    read = np.concatenate([forces, q @ mechanics.torque_rows.T], axis=1)
    cells = [cell.name for cell in rig.geometry.cells]
    place = [len(cells) if one.torque_meter else cells.index(one.cell) for one in rig.geometry.channels]
    gains = [one.sensitivity * np.ones(len(frequency), complex) for one in rig.geometry.channels]
    for gain, one in zip(gains, rig.geometry.channels, strict=True):
        if one.lowpass is not None:
            gain /= 1.0 + s[:, 0, 0] / (2 * np.pi * one.lowpass)
        if one.time_constant is not None:
            gain *= s[:, 0, 0] / (s[:, 0, 0] + 1.0 / one.time_constant)
    return read[:, place] * np.stack(gains, axis=1)
