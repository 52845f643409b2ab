"""Why a calibration does not tell the effect of a load: too little of it, or readings that contradict the loads."""

import numpy as np
import pytest

from balance_cli.calibration.insignificant_loads import explain_insignificance
from balance_cli.calibration.static_matrices import TrimRows
from balance_cli.campaign.rig.components import COMPONENTS


def _rows(change):
    rng = np.random.default_rng(3)
    x = rng.uniform(-1.0, 1.0, (60, 6))
    read = x @ (np.eye(6) + 0.05 * rng.normal(size=(6, 6))) + 1e-4 * rng.normal(size=(60, 6))
    x, read = change(x, read)
    return TrimRows(read, x, np.zeros((60, 0)), np.repeat(np.arange(5), 12), np.ones(60))


def _reversed_in_most(x, read):
    x[12:36] *= -1.0
    return x, read


def _without_effect(x, read):
    """Fx as stated has nothing to do with the readings."""
    return np.column_stack([np.random.default_rng(9).uniform(-1.0, 1.0, len(x)), x[:, 1:]]), read


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda x, read: (x, np.roll(read, 1, axis=0)), "the readings seem to stand one row later than their loads"),
        (lambda x, read: (x, np.roll(read, -1, axis=0)), "the readings seem to stand one row earlier than their loads"),
        (_reversed_in_most, "the readings do not follow the loads"),
        (_without_effect, "`Fx` was hardly loaded"),
    ],
)
def test_the_reason_is_that_of_the_rows(change, words):
    """Two wrong series of five had been explained by a load that was hardly applied, to the whole range in all rows."""
    fault, remedy = explain_insignificance(_rows(change), COMPONENTS, 0)
    assert fault.startswith(words) and remedy
