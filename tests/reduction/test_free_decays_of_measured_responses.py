"""What rings at the start of a short record, where measured responses tell the modes: it is no load."""

import numpy as np
import pytest

from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.model.transient_modes import transient_modes
from balance_cli.reduction.harmonic_loads import harmonic_loads
from balance_cli.reduction.measured_response import TransferSource
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.reduction.rotor_record import rotor_record
from balance_cli.signals.response.response_poles import response_poles
from balance_cli.simulation import Noise, simulate_run, true_rig
from balance_cli.steps.identify import IdentifyOptions, identify
from tests.support.measured_source import measured_responses
from tests.support.other_rigs import other_rig, short_campaign

RIG = other_rig("D")


@pytest.fixture(scope="module")
def model():
    return ModelSource(identify(Spectra((), (), (), {}), RIG, IdentifyOptions(method="computed")))


@pytest.fixture(scope="module")
def measured(model):
    return measured_responses(model, RIG)


def test_measured_responses_tell_the_modes_and_nothing_else(model, measured):
    modes = transient_modes(model.system, 0.0, 150.0, with_derivatives=False)
    expected, found = modes.s[: modes.oscillating], np.array(response_poles(measured.responses))
    assert len(found) == len(expected) == 7
    distance = np.abs(found[:, None] - expected)
    assert sorted(distance.argmin(axis=1)) == list(range(7))
    assert np.all(distance.min(axis=0) < -0.02 * expected.real)


class WithoutPoles(TransferSource):
    """The same responses, whose modes nobody knows."""

    poles = ()


def test_what_rings_in_a_dozen_revolutions_from_rest_is_fitted(measured):
    plan = short_campaign("D", revolutions=12).select_runs(["wind-1"]).runs[0]
    run, truth = simulate_run(true_rig(RIG), plan, Noise(), 1)

    def largest_error(source):
        record = rotor_record(run, RIG, source)
        solved = harmonic_loads(record, RIG, source)
        cosine, sine = truth.harmonics(*record.spectra.interval)
        error = solved.loads - (cosine - 1j * sine)[1 : 1 + len(solved.loads)]
        stacked = np.concatenate([error.real, error.imag], axis=1)
        return np.abs(stacked / np.sqrt(np.einsum("hjj->hj", solved.covariance))).max()

    without = WithoutPoles(measured.channel_names, measured.responses, "local")
    assert largest_error(without) > 15.0
    assert largest_error(measured) < 3.0
