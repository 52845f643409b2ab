import numpy as np
import pytest

from balance_cli.estimation.identified_model import identified_system
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.estimation.response_error import ResponseError
from balance_cli.estimation.response_error_estimate import (
    Residuals,
    estimate_response_error,
    response_error_of_residuals,
    with_unswept_loads,
)
from balance_cli.model.balance import balance_model
from balance_cli.model.system_response import response, solve
from tests.support.truth import true_response


@pytest.fixture(scope="module")
def batches(campaign):
    spectra = measured_spectra(campaign.runs, campaign.geometry)
    return stack_runs(spectra.lines, spectra.statics, campaign.geometry.channel_names)


def test_a_model_that_fits_misses_no_more_than_the_noise_of_a_line(campaign, identified, batches):
    """It is an upper value, which `identify` does not ask for where the model fits."""
    found = estimate_response_error(batches, identified_system(identified), campaign.geometry.channel_names)
    size = np.linalg.norm(true_response(campaign.rig, found.frequency), axis=1)
    missed = np.sqrt(np.sum(np.abs(found.factor) ** 2, axis=(2, 3)))
    assert np.quantile(missed / size, 0.9) < 0.01
    assert np.median(missed / size) < 0.005


def test_an_error_as_large_as_the_noise_is_not_left_out():
    """Four lines of twelve channels, each with an error of the size of its noise, in one direction."""
    rng = np.random.default_rng(1)
    direction = np.exp(2j * np.pi * rng.random(12))
    frequency = np.linspace(20.0, 21.0, 4)
    ratios = []
    for _ in range(50):
        noise = (rng.normal(size=(4, 12)) + 1j * rng.normal(size=(4, 12))) / np.sqrt(2.0)
        part = Residuals(frequency, noise + direction, np.ones((4, 12)))
        found = response_error_of_residuals([(2, part)], tuple(f"c{i}" for i in range(12)))
        covariance = found.covariance(np.array([20.5]), np.eye(6, dtype=complex)[2:3])[0]
        ratios.append((direction.conj() @ covariance @ direction).real / 12**2)
    assert np.mean(np.array(ratios) > 0.5) > 0.95


def test_the_error_of_a_wrong_model_is_the_one_there_is(campaign, batches):
    """The declared rig against the drawn one, whose response is known.

    Below 15 Hz the transients that the wrong model cannot remove exceed an error that is small there.
    """
    system = balance_model(campaign.geometry).system()
    names = campaign.geometry.channel_names
    found = estimate_response_error(batches, system, names)
    frequency = found.frequency[(found.frequency > 15) & (found.frequency < 150)]
    true_error = true_response(campaign.rig, frequency) - response(system, solve(system, frequency))
    for j in range(6):
        loads = np.zeros((len(frequency), 6), complex)
        loads[:, j] = 1.0
        variance = np.einsum("kcc->k", found.covariance(frequency, loads)).real
        power = np.sum(np.abs(true_error[:, :, j]) ** 2, axis=1)
        ratio = np.sqrt(variance / power)
        assert 0.6 < np.median(ratio) < 2.0
        assert np.mean(ratio > 0.4) > 0.9


def test_a_load_that_no_sweep_applied_is_missed_by_the_same_share(campaign):
    """Of the declared rig, swept by Fz and Mz alone, the error under the other loads is covered by what these show."""
    spectra, names = measured_spectra(campaign.runs, campaign.geometry), campaign.geometry.channel_names
    lines = [run for run in spectra.lines if run.components in (("Fz",), ("Mz",))]
    system = balance_model(campaign.geometry).system()
    found = estimate_response_error(stack_runs(lines, (), names), system, names)
    frequency = found.frequency[(found.frequency > 15) & (found.frequency < 150)]
    true_error = true_response(campaign.rig, frequency) - response(system, solve(system, frequency))
    for j in (0, 1, 3, 4):
        variance = np.einsum("kcc->k", found.covariance(frequency, np.eye(6, dtype=complex)[[j] * len(frequency)])).real
        ratio = np.sqrt(variance / np.sum(np.abs(true_error[:, :, j]) ** 2, axis=1))
        assert np.mean(ratio > 0.5) > 0.8
    swept = estimate_response_error(stack_runs(spectra.lines, (), names), system, names)
    assert swept.factor.shape[-1] == 3


def test_the_share_of_a_swept_load_is_that_of_the_others():
    error = ResponseError(("a", "b"), np.array([10.0, 12.0, 40.0]), np.zeros((3, 6, 2, 3), complex))
    error.factor[:, 2, 0, 0] = [0.1, 0.3, 0.0]
    loads = np.ones((3, 2, 6), complex) * [1.0, 2.0, 1.0, 1.0, 1.0, 0.0]
    loads[:, 1, 2] = 0.0
    variance = with_unswept_loads(error, loads, {2}).covariance(error.frequency, np.eye(6, dtype=complex)[[1, 1, 1]])
    np.testing.assert_allclose(np.einsum("kcc->kc", variance).real, np.outer([0.36, 0.36, 4.0 * 0.1 / 3], [1.0, 1.0]))
    assert with_unswept_loads(error, loads, set(range(6))) is error


def test_covariance_is_that_of_the_nearest_band_and_grows_with_the_load():
    factor = np.zeros((2, 6, 3, 3), complex)
    factor[0, 2, :, 0] = [1.0, 2.0j, 0.0]
    factor[1, 2, :, 0] = [0.0, 0.0, 3.0]
    error = ResponseError(("a", "b", "c"), np.array([10.0, 20.0]), factor)
    loads = np.zeros((2, 6), complex)
    loads[:, 2] = 2.0j
    first, second = error.covariance(np.array([11.0, 40.0]), loads)
    direction = np.array([1.0, 2.0j, 0.0])
    np.testing.assert_allclose(first, 4.0 * np.outer(direction, direction.conj()))
    np.testing.assert_allclose(second, np.diag([0.0, 0.0, 36.0]))
    assert not error.covariance(np.array([11.0]), np.zeros((1, 6), complex)).any()
