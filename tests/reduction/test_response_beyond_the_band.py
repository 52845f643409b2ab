"""Lines of a harmonic that reach beyond the measured response."""

import numpy as np
import pytest

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.reduction.measured_response import transfer_source
from balance_cli.reduction.speed_modulation import ChannelResponse
from tests.support.report_content import FREQUENCY, transfer


@pytest.mark.parametrize("end", [0, -1])
def test_beyond_the_measured_band_the_response_is_that_of_its_end(end):
    """A sound run ended with "request fewer harmonics" although all of its harmonics were measured."""
    content = transfer(COMPONENTS)
    source, edge = transfer_source(content, "local"), FREQUENCY[end]
    response = ChannelResponse(source, tuple(range(len(source.channel_names))), 0.0, content.geometry.acquisition)
    beyond = np.array([edge + (10.0 if end else -0.9 * edge)])
    at, of_end = response.at(beyond)[0], response.at(np.array([edge]))[0]
    filters = response.filter(beyond)[0] / response.filter(np.array([edge]))[0]
    np.testing.assert_allclose(at, of_end * filters, rtol=1e-12)
