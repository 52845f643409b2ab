import numpy as np
import pytest

from balance_cli.estimation.identified_model import identified_system
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.estimation.response_error import ResponseError
from balance_cli.estimation.response_error_estimate import estimate_response_error
from balance_cli.model.balance import balance_model
from balance_cli.model.system_response import response, solve
from tests.support.truth import true_response


@pytest.fixture(scope="module")
def batches(campaign):
    spectra = measured_spectra(campaign.runs, campaign.geometry)
    return stack_runs(spectra.lines, spectra.statics, campaign.geometry.channel_names)


def test_a_model_that_fits_has_hardly_any(campaign, identified, batches):
    found = estimate_response_error(batches, identified_system(identified), campaign.geometry.channel_names)
    if found is not None:
        assert np.mean(np.any(found.factor, axis=(2, 3))) < 0.05


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
