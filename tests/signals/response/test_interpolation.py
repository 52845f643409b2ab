"""A response between its lines, a quarter of a hertz apart, beside modes whose half width is a tenth of one."""

import numpy as np
import pytest

from balance_cli.io.errors import UserError
from balance_cli.signals.response import window_models
from balance_cli.signals.response.choices import INTERPOLATIONS
from balance_cli.signals.response.interpolation import interpolate_response, interpolate_values
from balance_cli.signals.response.interpolation_error import interpolate_and_judge, interpolate_with_error
from balance_cli.signals.run_spectrum import FrequencyResponse
from tests.support.swept_rig import LOAD_NOISE, MODES, NOISE, SweptRig, relative_error

RIG = SweptRig()
LINES = np.arange(2.0, 150.1, 0.25)


def measured(noise: float = 1.0, seed: int = 0, rig: SweptRig = RIG, lines: np.ndarray = LINES) -> FrequencyResponse:
    """Lines of a multisine of rms 40, averaged over three periods of 4 s."""
    rng = np.random.default_rng(seed)
    T = rig.response(lines)
    k, c, u = T.shape
    amplitude, size = np.sqrt(3200 / 593), 4 / 1600 / 3
    load = LOAD_NOISE**2 * size
    covariance = NOISE**2 * size * np.eye(c) + load * T @ T.conj().swapaxes(1, 2)
    root = np.linalg.cholesky(covariance)
    e = (rng.normal(size=(k, c, u)) + 1j * rng.normal(size=(k, c, u))) / np.sqrt(2) / amplitude
    loads = np.broadcast_to(np.eye(u) / amplitude**2, (k, u, u)).astype(complex)
    ones = np.ones(T.shape)
    noisy, level = T + noise * root @ e, (40.0,) * u
    return FrequencyResponse(
        "run", rig.names, rig.components, "periodic", lines, noisy, covariance, loads, ones, ones[:, :, 0], level=level
    )


def places(seed: int = 1, count: int = 400) -> np.ndarray:
    """Frequencies all over the band, and within a hertz of each mode."""
    rng = np.random.default_rng(seed)
    near = (np.array(MODES)[:, None] + rng.uniform(-1, 1, (len(MODES), 20))).ravel()
    return np.concatenate([rng.uniform(2.5, 149.5, count), near])


def errors(method: str) -> tuple[np.ndarray, np.ndarray]:
    at = interpolate_response(measured(), places(), method)
    error = relative_error(RIG, places(), at.value)
    return error[:400], error[400:]


def test_local_is_the_best_by_far():
    """95th percentiles, all over the band and beside the modes: 0.07 % and 0.03 % against 20 % and more."""
    everywhere, near = errors("local")
    assert np.percentile(everywhere, 95) < 1.5e-3
    assert np.percentile(near, 95) < 1e-3
    for method in ("spline", "first-order", "nearest"):
        assert np.percentile(errors(method)[1], 95) > 0.1


@pytest.mark.parametrize("method", INTERPOLATIONS)
def test_values_alone_are_as_good(method):
    """They come from the same local models."""
    response = measured()
    error = relative_error(RIG, places(), interpolate_values(response, places(), method))
    expected = errors(method)
    assert np.percentile(error[:400], 95) < 1.1 * np.percentile(expected[0], 95) + 2e-4
    assert np.percentile(error[400:], 95) < 1.1 * np.percentile(expected[1], 95) + 2e-4


def test_without_noise_local_is_nearly_exact():
    at = interpolate_response(measured(noise=0.0), places())
    assert np.max(relative_error(RIG, places(), at.value)) < 2e-3


def test_stated_covariance_is_that_of_the_error():
    rig = SweptRig(channels=4)
    chi2 = []
    for seed in range(2):
        at = interpolate_response(measured(seed=seed, rig=rig), places())
        error = (at.value - rig.response(places()))[:, :, 0]
        weight = np.linalg.inv(at.channel_covariance) / at.load_covariance
        chi2.append(np.einsum("hc,hcd,hd->h", error.conj(), weight, error).real / 4)
    assert np.median(chi2) == pytest.approx(0.9, abs=0.25)
    assert np.mean(chi2) == pytest.approx(1.1, abs=0.3)


@pytest.mark.parametrize("method", ["local", "spline", "first-order"])
def test_derivative(method):
    smooth = SweptRig(zeta=0.2)
    at = interpolate_response(measured(noise=0.0, rig=smooth), 50.1, method)
    slope = (smooth.response(np.array([50.1001])) - smooth.response(np.array([50.0999])))[0] / 2e-4
    assert np.abs(at.derivative - slope).max() < 0.03 * np.abs(slope).max()


@pytest.mark.parametrize("method", INTERPOLATIONS)
def test_at_a_line_and_shapes(method):
    response = measured(noise=0.0)
    interpolated = interpolate_response(response, 50.25, method)
    assert interpolated.value.shape == (5, 1)
    assert interpolated.channel_covariance.shape == (5, 5)
    assert interpolated.load_covariance.shape == (1, 1)
    assert interpolated.value == pytest.approx(RIG.response(np.array([50.25]))[0], rel=1e-4)
    assert interpolate_response(response, np.array([10.0, 60.0]), method).value.shape == (2, 5, 1)
    several = measured(noise=0.0, rig=SweptRig(components=("Fx", "My")))
    assert interpolate_response(several, np.array([10.1]), method).value.shape == (1, 5, 2)


def test_nearest_keeps_the_lines_own_covariance():
    response = measured()
    at = interpolate_response(response, 50.3, "nearest")
    k = int(np.argmin(np.abs(LINES - 50.3)))
    assert at.channel_covariance == pytest.approx(response.channel_covariance[k])
    assert at.load_covariance == pytest.approx(response.load_covariance[k])


def test_few_lines_will_do():
    response = measured(noise=0.0, lines=np.array([10.0, 10.5, 11.0]))
    for method in INTERPOLATIONS:
        value = interpolate_response(response, 10.6, method).value
        assert value == pytest.approx(RIG.response(np.array([10.6]))[0], rel=0.02)


def test_outside_the_lines():
    with pytest.raises(UserError, match=r"measured from 2 to 150 Hz \(run\), not at 157\.5 Hz"):
        interpolate_response(measured(), np.array([17.5, 157.5]))


def squared_errors(at, frequency: np.ndarray) -> np.ndarray:
    """Squared error over stated variance (h,), mean over the channels."""
    variance = np.einsum("hcc,huu->hcu", at.channel_covariance, at.load_covariance).real
    return np.mean(np.abs(at.value - RIG.response(frequency)) ** 2 / variance, axis=(1, 2))


def test_sigma_holds_where_lines_are_too_far_apart():
    """Lines ten half widths of a mode apart: sigma from noise is too small at a fifth of the frequencies."""
    response = measured(lines=np.arange(2.0, 150.1, 2.0))
    frequency = places(count=100)
    plain = squared_errors(interpolate_response(response, frequency), frequency)
    assert np.mean(plain > 4.0) > 0.15
    with_error = squared_errors(interpolate_with_error(response, frequency, "local"), frequency)
    assert np.mean(with_error > 4.0) < 0.02


@pytest.mark.parametrize("method", ["spline", "first-order", "nearest"])
def test_sigma_holds_for_curves_that_are_too_simple(method):
    response, frequency = measured(), places(count=100)
    assert np.mean(squared_errors(interpolate_response(response, frequency, method), frequency) > 4.0) > 0.2
    assert np.mean(squared_errors(interpolate_with_error(response, frequency, method), frequency) > 4.0) < 0.08


def test_sigma_of_a_well_resolved_response_hardly_grows():
    response, frequency = measured(), places(count=40)
    plain = interpolate_response(response, frequency)
    with_error = interpolate_with_error(response, frequency, "local")
    traces = [np.trace(at.channel_covariance, axis1=1, axis2=2).real for at in (plain, with_error)]
    assert np.median(traces[1] / traces[0]) < 1.05


def test_values_do_not_depend_on_what_was_interpolated_before():
    """To the last digit: runs are reduced in any order, by any number of workers."""
    first, second = measured(), measured()
    frequency = places(count=60)
    interpolate_with_error(second, np.array([17.3, 80.1, 149.9]), "local")
    interpolate_values(second, frequency[::-1], "local")
    for function in (interpolate_values, interpolate_with_error):
        ours, others = (function(response, frequency, "local") for response in (first, second))
        np.testing.assert_array_equal(getattr(ours, "value", ours), getattr(others, "value", others))


def test_the_fit_of_a_window_does_not_depend_on_those_fitted_with_it():
    """To the last digit, as above: of one window alone, of a few, and of more than are fitted at once."""
    response, every = measured(), np.arange(300)[:, None] + np.arange(11)
    together = window_models.window_models(response, every)
    for rows in (*np.split(np.arange(60, 84), 24), np.arange(290, 300, 3), np.arange(5, 205)):
        alone = window_models.window_models(measured(), every[rows])
        for row, model in zip(rows, alone, strict=True):
            expected = together[row]
            assert model.fit.orders == expected.fit.orders
            for name in ("denominator", "coefficients", "triangle", "residual"):
                np.testing.assert_array_equal(getattr(model.fit, name), getattr(expected.fit, name))


def test_windows_are_fitted_once_and_those_of_a_long_response_are_not_all_kept(monkeypatch):
    response, fitted = measured(), []
    fit = window_models._fit_windows_of_lines
    monkeypatch.setattr(
        window_models, "_fit_windows_of_lines", lambda of, index: fitted.append(len(index)) or fit(of, index)
    )
    values = interpolate_values(response, np.array([17.3, 35.1]), "local")
    assert fitted == [2]
    np.testing.assert_array_equal(interpolate_values(response, np.array([17.3, 35.1]), "local"), values)
    interpolate_response(response, 17.31)
    assert fitted == [2]
    interpolate_values(response, np.array([17.3, 80.1]), "local")
    assert fitted == [2, 1]
    monkeypatch.setattr(window_models, "MOST_KEPT", 2)
    np.testing.assert_array_equal(interpolate_values(response, np.array([35.1, 17.3]), "local"), values[1::-1])
    assert len(response.window_models) == 2


@pytest.mark.parametrize("seed", range(3))
def test_noise_makes_no_poles(seed):
    """Far below the modes a line that noise has moved in all channels is no mode, which would be beside it only."""
    lines, between, sigma = np.arange(1.0, 151.0), np.arange(6.5, 145.0), 0.1
    rng, gains = np.random.default_rng(seed), np.linspace(0.5, 2.0, 8)

    def smooth(frequency):
        return gains / (1.0 - (frequency / 400.0) ** 2 + 0.02j)[:, None]

    noise = rng.standard_normal((2, len(lines), 8)) * sigma / np.sqrt(2.0)
    value = (smooth(lines) + noise[0] + 1j * noise[1])[:, :, None]
    covariance = np.broadcast_to(sigma**2 * np.eye(8) + 0j, (len(lines), 8, 8))
    ones = np.ones(value.shape)
    response = FrequencyResponse(
        "run", tuple("abcdefgh"), ("Fx",), "periodic", lines, value, covariance, ones + 0j, ones, ones[:, :, 0]
    )
    error = interpolate_values(response, between, "local")[:, :, 0] - smooth(between)
    assert np.sqrt(np.mean(np.abs(error) ** 2, axis=1)).max() < 3.0 * sigma  # had been 5.3 to 21


def test_a_measured_line_is_taken_where_lines_are_far_apart():
    """Twenty half widths of a mode apart: a rational function through eleven lines misses them by a tenth and more."""
    response = measured(lines=np.arange(5.0, 150.1, 5.0))
    lines = response.frequency[4:-4]
    for place, tolerance in ((lines, 3e-3), (lines * (1.0 + 1e-5), 5e-3)):
        judged = interpolate_and_judge(response, place, "local")
        assert np.max(relative_error(RIG, place, judged.response.value)) < tolerance
        assert np.mean(squared_errors(judged.response, place) < 4.0) > 0.9
        guessed = np.sqrt(np.trace(judged.form, axis1=1, axis2=2).real * judged.response.load_covariance[:, 0, 0].real)
        assert np.max(guessed / np.linalg.norm(RIG.response(place), axis=(1, 2))) < 5e-3
    between = 0.5 * (lines[1:] + lines[:-1])
    judged = interpolate_and_judge(response, between, "local")
    assert np.max(relative_error(RIG, between, judged.response.value)) > 0.1
    assert np.mean(squared_errors(judged.response, between) < 4.0) > 0.9


def test_a_pole_of_noise_beside_a_mode_is_in_sigma():
    """At 59.84 Hz noise makes a pole that lines hardly prefer: chi-square had been 8.8 per degree of freedom."""
    rig = SweptRig(channels=4)
    at = interpolate_response(measured(seed=5, rig=rig), places())
    error = (at.value - rig.response(places()))[:, :, 0]
    weight = np.linalg.inv(at.channel_covariance) / at.load_covariance
    chi2 = np.einsum("hc,hcd,hd->h", error.conj(), weight, error).real / 4
    assert np.max(chi2) < 5.0
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.15)
