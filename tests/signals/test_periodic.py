"""Lines of periodic records: steady periods, amplitudes, and a noise covariance that is right."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.io.errors import UserError
from balance_cli.signals import covariance_pooling
from balance_cli.signals.covariance_pooling import inverse_bias_factor, pooled_covariance
from balance_cli.signals.local.nonperiodic_spectrum import nonperiodic_record
from balance_cli.signals.periodic import periodic_record, periodic_spectrum, samples_per_period
from balance_cli.signals.periodic_transient import find_steady_start
from tests.support.swept_rig import LOAD_NOISE, NOISE, SweptRig, chi2_per_dof, near_mode

RIG = SweptRig()
SEEDS = range(6)


@pytest.fixture(scope="module")
def records():
    return [periodic_record(RIG.multisine(seed), RIG.names) for seed in SEEDS]


def test_lines_are_those_excited(records):
    lines = records[0].spectrum
    assert lines.frequency == pytest.approx(np.arange(2, 150.1, 0.25))
    assert lines.components == ("Fx",)
    # 593 lines of equal amplitude a carry rms 40: 593 a^2 / 2 = 1600.
    assert np.abs(lines.loads[:, 0]) == pytest.approx(np.sqrt(3200 / 593), rel=2e-3)


def test_chi_square_of_the_true_response_is_one_everywhere(records):
    """5 channels, 593 lines, 6 runs: 17 790 complex values, so 1 +- 0.0075; beside the modes 1 +- 0.03."""
    values = np.concatenate([chi2_per_dof(RIG, record.spectrum) for record in records])
    near = np.concatenate([near_mode(record.spectrum.frequency, 0.5) for record in records])
    assert values.mean() == pytest.approx(1.0, abs=0.04)
    assert values[near].mean() == pytest.approx(1.0, abs=0.12)


def test_noise_is_measured_within_a_few_percent(records):
    """Sample noise s gives a line of a period of N samples the variance 4 s^2 / N, a mean of m periods that over m."""
    ratios = []
    for record in records:
        m = (record.periods - record.first)[:, None]
        variance = np.diagonal(record.spectrum.covariance, axis1=1, axis2=2).real * m
        expected = 4 * np.array([NOISE] * 5 + [LOAD_NOISE]) ** 2 / 1600
        ratios.append((variance / expected).mean(axis=0))
    assert np.mean(ratios, axis=0) == pytest.approx(np.ones(6), abs=0.05)


def test_the_noise_of_channels_does_not_depend_on_the_unit_of_the_loads(records):
    """In loads of micronewtons channels had the noise of their rounding beside the largest signal, in whatever unit."""
    run, factor = RIG.multisine(SEEDS[0]), 2.0**20
    block = run.read()
    small = replace(run, source=MemorySource(block.channels, block.loads * factor))
    lines, plain = periodic_spectrum(small, RIG.names), records[0].spectrum
    assert lines.channels == pytest.approx(plain.channels, rel=1e-12)
    assert lines.loads == pytest.approx(plain.loads * factor, rel=1e-12)
    scale = np.array([1.0] * 5 + [factor])
    assert lines.covariance / np.outer(scale, scale) == pytest.approx(plain.covariance, rel=1e-9)


def test_periods_are_discarded_where_a_mode_still_rings(records):
    for record in records:
        slowest = np.abs(record.spectrum.frequency - 20.3) < 0.3
        assert record.first[slowest].min() > np.median(record.first)
        assert record.steady
        assert record.start == pytest.approx(record.first.max() * 4.0)
        assert record.stop == pytest.approx(28.0)


def test_a_record_that_begins_steady_loses_no_period():
    record = periodic_record(RIG.multisine(spin_up=40, periods=5), RIG.names)
    assert np.mean(record.first == 0) > 0.99


def test_two_periods_remain_however_long_the_transient():
    slow = SweptRig(zeta=0.0005)
    record = periodic_record(slow.multisine(periods=4), slow.names)
    assert record.first.max() == 2
    assert not record.steady


def test_transient_that_has_to_stay_is_in_the_covariance():
    short = periodic_record(RIG.multisine(periods=3), RIG.names)
    assert chi2_per_dof(RIG, short.spectrum).mean() < 1.3


def test_record_need_not_begin_with_a_period():
    run = RIG.multisine()
    block = run.read(333)
    cut = replace(run, samples=len(block.channels), source=MemorySource(block.channels, block.loads))
    record = periodic_record(cut, RIG.names)
    assert record.periods == 6
    assert chi2_per_dof(RIG, record.spectrum).mean() == pytest.approx(1.0, abs=0.1)


def test_period_that_is_no_whole_number_of_samples():
    """Two periods of 400.5 samples are 801: lines are cut from pairs, and only every second one was excited."""
    n, rate = 801, RIG.rate
    run = RIG.multisine(period=n / rate, periods=8)
    doubled = np.fft.rfft(run.read().loads[:n, 0])
    assert samples_per_period(run) == n
    declared = replace(run, period=n / rate / 2)
    assert samples_per_period(declared) == n
    assert np.count_nonzero(np.abs(doubled) > 100) > 100
    with pytest.raises(UserError, match="whole number of samples"):
        samples_per_period(replace(run, period=(n + 0.2371) / rate))


def test_wrong_period_is_refused():
    rig = SweptRig()
    with pytest.raises(UserError, match="repeats"):
        periodic_record(replace(rig.random(seconds=12.0), period=4.0), rig.names)


def test_a_constant_load_is_refused():
    """Its lines are the rounding of the transform, which passed for a load without noise."""
    run = RIG.multisine(periods=4)
    constant = MemorySource(run.read().channels, np.full((run.samples, 6), 3.0))
    with pytest.raises(UserError, match="no load varies within a period"):
        periodic_spectrum(replace(run, source=constant), RIG.names)


def test_what_the_user_must_hear():
    run = RIG.multisine(periods=3)
    with pytest.raises(UserError, match="no `period`"):
        periodic_spectrum(replace(run, period=None), RIG.names)
    with pytest.raises(UserError, match="two periods"):
        periodic_spectrum(replace(run, period=20.0), RIG.names)
    with pytest.raises(UserError, match="no channel `nowhere`"):
        periodic_spectrum(run, ("c0", "nowhere"))
    with pytest.raises(UserError, match="column is zero"):
        periodic_spectrum(replace(run, excited=("Mz",)), RIG.names)
    with pytest.raises(UserError, match="no line was excited from 160"):
        periodic_spectrum(run, RIG.names, (160.0, 170.0))


def test_a_measured_component_that_holds_only_noise_is_no_input():
    run = RIG.multisine(periods=4)
    block = run.read()
    assert block.loads is not None
    loads = block.loads.copy()
    loads[:, 4] = 0.01 * np.random.default_rng(3).normal(size=len(loads))
    lines = periodic_spectrum(replace(run, source=MemorySource(block.channels, loads)), RIG.names)
    assert lines.components == ("Fx",)
    assert lines.covariance.shape[1:] == (6, 6)


def test_a_cross_axis_load_that_was_measured_is_an_input():
    two = SweptRig(components=("Fx", "My"))
    declared = replace(two.multisine(periods=4), excited=("Fx",), level=(40.0,))
    assert periodic_spectrum(declared, two.names).components == ("Fx", "My")


def _deviations(rng, lines, n, counts):
    vectors = rng.normal(size=(lines, counts, n)) + 1j * rng.normal(size=(lines, counts, n))
    return vectors / np.sqrt(2.0), np.full(lines, float(counts))


def test_inverse_bias_factor_by_simulation():
    """Mean inverse of a complex Wishart matrix, 20 degrees of freedom, 6 signals."""
    rng = np.random.default_rng(1)
    vectors, _ = _deviations(rng, 4000, 6, 20)
    scatter = np.einsum("kmi,kmj->kij", vectors, vectors.conj())
    inverse = np.linalg.inv(scatter / 20).mean(axis=0).real * inverse_bias_factor(20, 6)
    assert np.diagonal(inverse) == pytest.approx(np.ones(6), abs=0.03)
    assert inverse_bias_factor(np.inf, 6) == 1.0
    with pytest.raises(ValueError, match="no inverse"):
        inverse_bias_factor(6, 6)


def test_one_bad_line_does_not_spoil_its_neighbors():
    rng = np.random.default_rng(2)
    deviations, counts = _deviations(rng, 400, 6, 3)
    clean = pooled_covariance(deviations, counts)
    assert clean.dof >= 150
    deviations[200] *= 1e2
    spoilt = pooled_covariance(deviations, counts)
    assert np.trace(spoilt.at_lines[190]).real == pytest.approx(np.trace(clean.at_lines[190]).real, rel=0.08)
    assert np.trace(clean.at_lines, axis1=1, axis2=2).real.mean() == pytest.approx(6.0, rel=0.03)


def test_covariance_follows_the_color_of_the_noise():
    rng = np.random.default_rng(3)
    deviations, counts = _deviations(rng, 1000, 4, 3)
    color = np.linspace(1.0, 10.0, 1000)
    pooled = pooled_covariance(deviations * np.sqrt(color)[:, None, None], counts)
    ratio = np.trace(pooled.at_lines, axis1=1, axis2=2).real / (4 * color)
    assert np.abs(ratio[30:-30] - 1).max() < 0.3
    assert ratio[30:-30].mean() == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize(("lines", "dof"), [(40, 3.0), (200, 2.0), (200, 1.6), (97, 6.0), (30, 10.0), (1, 400.0)])
def test_pooled_covariance_is_the_mean_over_the_window_around_each_knot(monkeypatch, lines, dof):
    monkeypatch.setattr(covariance_pooling, "ROBUST_ITERATIONS", 1)
    monkeypatch.setattr(covariance_pooling, "INITIAL_POWER_LIMIT", np.inf)
    rng = np.random.default_rng(3)
    deviations = rng.standard_normal((lines, 2, 3)) + 1j * rng.standard_normal((lines, 2, 3))
    pooled = pooled_covariance(deviations, np.full(lines, dof))
    width = min(int(np.ceil(covariance_pooling.LEAST_POOLED_DOF / dof)) | 1, (lines - 1) | 1)
    for knot, center in zip(pooled.knots, range(0, lines, pooled.step), strict=True):
        start = min(max(center - width // 2, 0), lines - width)
        rows = deviations[start : start + width].reshape(-1, 3)
        np.testing.assert_allclose(knot, rows.T @ rows.conj() / (width * dof), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("lines", "n", "vectors"), [(400, 4, 3), (1, 2, 2), (7, 2, 1), (1001, 3, 1)])
def test_distances_are_those_of_the_covariance_at_each_line(lines, n, vectors):
    """Lines in any number, also fewer than a window, and a window whose steps do not divide them."""
    deviations, counts = _deviations(np.random.default_rng(lines), lines, n, vectors)
    pooled = pooled_covariance(deviations, counts, floor=0.1)
    weighted = np.linalg.solve(pooled.at_lines[:, None], deviations[..., None])[..., 0]
    squared = np.sum(deviations.conj() * weighted, axis=2).real * inverse_bias_factor(max(pooled.dof, n + 1), n)
    np.testing.assert_allclose(pooled.distances(deviations), squared, rtol=1e-10)


def test_white_noise_alone_is_steady_from_the_beginning():
    rng = np.random.default_rng(4)
    spectra = rng.normal(size=(6, 500, 8)) + 1j * rng.normal(size=(6, 500, 8))
    assert np.mean(find_steady_start(spectra, spectra.shape[2]).first == 0) > 0.98


def test_recovery_of_one_channel_is_seen():
    """A slow exponential in one of eight signals, smooth over all lines."""
    rng = np.random.default_rng(5)
    spectra = rng.normal(size=(7, 500, 8)) + 1j * rng.normal(size=(7, 500, 8))
    spectra[:, :, 3] += 40.0 * np.exp(-4 / 3 * np.arange(7))[:, None]
    first = find_steady_start(spectra, spectra.shape[2]).first
    bias = (40.0 * np.exp(-4 / 3 * first)) / (7 - first) / (1 - np.exp(-4 / 3))
    assert np.median(bias * np.sqrt((7 - first) / 2)) < 0.7
    assert np.mean(first <= 5) == 1.0


def test_sigma_contains_the_transient_of_a_record_that_does_not_settle():
    """Six periods of a quarter of a second; the slowest mode decays by a seventh in each of them."""
    ratios = []
    for seed in SEEDS:
        record = periodic_record(RIG.multisine(seed, period=0.25, periods=6), RIG.names)
        assert not record.steady
        lines = record.spectrum
        T = RIG.response(lines.frequency)
        error = lines.channels - np.einsum("kcu,ku->kc", T, lines.loads)
        variance = np.diagonal(lines.covariance, axis1=1, axis2=2).real[:, :5]
        ratios.append(np.mean(np.abs(error) ** 2 / variance, axis=1))
    assert np.median(ratios) > 0.15
    assert np.mean(np.concatenate(ratios) > 4.0) < 0.05


def test_the_transient_in_the_first_of_three_periods_is_not_noise():
    """Three periods of 8 s from rest: the first one alone has the transient."""
    record = periodic_record(RIG.multisine(period=8.0, periods=3), RIG.names)
    assert np.mean(record.first == 1) > 0.9
    assert np.median(chi2_per_dof(RIG, record.spectrum)) == pytest.approx(1.0, abs=0.3)
    # Of the mean of two periods of 8 s; with the transient as noise it was 2100 times as large.
    variance = np.diagonal(record.spectrum.covariance, axis1=1, axis2=2).real[:, 0]
    assert np.median(variance) == pytest.approx(2.0 * NOISE**2 / (8.0 * RIG.rate), rel=0.3)


@pytest.mark.parametrize(("periods", "spin_up", "rings"), [(2, 0, True), (2, 5, False), (4, 0, False)])
def test_two_periods_from_rest_ring(periods, spin_up, rings):
    assert periodic_record(RIG.multisine(period=4.0, periods=periods, spin_up=spin_up), RIG.names).rings is rings


def test_two_periods_from_rest_give_the_lines_of_a_record_that_does_not_repeat():
    """Their difference is mostly transient: as noise it would hide what the record says."""
    run = RIG.multisine(period=4.0, periods=2)
    local = nonperiodic_record(run, RIG.names).spectrum
    assert np.median(chi2_per_dof(RIG, local)) == pytest.approx(1.0, abs=0.4)
    # Between the lines that were excited the load is zero: no response is computed there.
    assert np.abs(local.loads[:, 0]).min() > 0.005 * np.abs(local.loads[:, 0]).max()
