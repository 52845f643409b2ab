import numpy as np
import pytest
from scipy.signal import butter, freqs

from balance_cli.campaign.rig.geometry import Acquisition, AnalogFilter
from balance_cli.signals.anti_alias import anti_alias_response


def acquisition(order=6, cutoff=200.0):
    return Acquisition(filter=AnalogFilter(type="butterworth", order=order, cutoff=cutoff))


@pytest.mark.parametrize("order", range(1, 13))
@pytest.mark.parametrize("cutoff", [0.5, 200.0])
def test_equals_the_analog_butterworth_of_scipy(order, cutoff):
    frequency = cutoff * np.array([0.0, 0.01, 0.3, 0.99, 1.0, 1.5, 4.0])
    _, expected = freqs(*butter(order, 2 * np.pi * cutoff, analog=True), worN=2 * np.pi * frequency)
    np.testing.assert_allclose(anti_alias_response(acquisition(order, cutoff), frequency), expected, rtol=1e-8)


def test_half_power_at_the_cutoff_and_the_delay_of_three_milliseconds():
    response = anti_alias_response(acquisition(), [200.0, 0.1])
    assert abs(response[0]) == pytest.approx(np.sqrt(0.5), rel=1e-12)
    # The delay at low frequency is the sum of -1/p over the poles, divided by the cut-off.
    assert -np.angle(response[1]) / (2 * np.pi * 0.1) == pytest.approx(3.07e-3, rel=2e-3)


def test_errors_of_a_forgotten_filter_at_one_and_eight_per_revolution():
    forgotten = np.abs(anti_alias_response(acquisition(), [17.5, 140.0]) - 1.0)
    np.testing.assert_allclose(forgotten, [0.337, 1.981], atol=0.001)


def test_no_filter_is_one_and_shapes_are_kept():
    assert np.all(anti_alias_response(Acquisition(), np.arange(6.0).reshape(2, 3)) == 1.0)
    assert anti_alias_response(acquisition(), np.zeros((2, 3))).shape == (2, 3)
    assert anti_alias_response(acquisition(), 10.0).shape == ()
