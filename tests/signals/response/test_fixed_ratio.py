"""Loads that one run applies in a fixed ratio: a response to each does not follow, and the message says so."""

import numpy as np
import pytest

from balance_cli.io.errors import UserError
from balance_cli.signals.local.response import local_response
from balance_cli.signals.periodic import periodic_record
from balance_cli.signals.response.periodic_response import response_from_one_run
from tests.support.swept_rig import RATE, SweptRig, multisine, relative_error

RIG = SweptRig(components=("Fx", "My"), zeta=0.02)
PERIOD = 2.0


def run(second_phase: bool):
    """Seven periods of a multisine in Fx, and in My one of its own or the same at half the size."""
    x = multisine(round(PERIOD * RATE), RATE, 2, 3)
    if not second_phase:
        x[:, 1] = 0.5 * x[:, 0]
    return RIG.record(np.tile(x, (7, 1)), 1, excitation="multisine", period=PERIOD)


def responses(record):
    yield lambda: response_from_one_run(record, periodic_record(record, RIG.names).spectrum)
    yield lambda: local_response(record, RIG.names)


def test_loads_of_one_ratio_have_no_response_each():
    from_lines, from_record = responses(run(second_phase=False))
    with pytest.raises(UserError, match=r"Fx, My were applied in a fixed ratio: Fx -0\.5 My was never applied"):
        from_lines()
    with pytest.raises(UserError, match="proportional to each other"):
        from_record()


@pytest.mark.parametrize("method", range(2))
def test_loads_of_their_own_phases_have(method):
    measured = list(responses(run(second_phase=True)))[method]()
    inside = (measured.frequency > 5.0) & (measured.frequency < 140.0)
    error = relative_error(RIG, measured.frequency[inside], measured.response[inside])
    assert np.median(error) < 0.02
