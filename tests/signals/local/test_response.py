"""Responses from local models: loads that cannot be told apart are refused."""

from types import SimpleNamespace

import numpy as np
import pytest

from balance_cli.io.errors import UserError
from balance_cli.signals.local.response import _load_precision


def test_loads_in_proportion_are_refused_with_the_run():
    spectrum = SimpleNamespace(run=SimpleNamespace(file="r.h5"), components=("Fx", "Fy"))
    models = SimpleNamespace(spectrum=spectrum)
    np.testing.assert_allclose(_load_precision(models, 2.0 * np.eye(2)[None]), 0.5 * np.eye(2)[None])
    with pytest.raises(UserError, match=r"r\.h5, loads: the loads Fx, Fy are proportional to each other"):
        _load_precision(models, np.ones((1, 2, 2)))
