"""Loads near an end of a record, whose response the transient of a narrow window describes as well."""

import numpy as np
import pytest

from balance_cli.signals.local.fit import ModelOrders, WindowedData, fit_windows
from balance_cli.signals.local.separation import separates_transient
from balance_cli.signals.local.window import split_windows


def window(position, lines, orders):
    """The fit of a pulse at a share of the record to a response that its orders describe."""
    r = np.linspace(-1.0, 1.0, lines)
    U = np.exp(-2j * np.pi * position * np.arange(lines))[None, :, None]
    Y = U * (1.0 + 0.3 * r)[None, :, None]
    data = WindowedData(Y, U, np.ones((1, lines)), r[None])
    return split_windows(fit_windows(data, orders), data)[0]


@pytest.mark.parametrize(
    ("position", "lines", "separates"),
    [(0.5, 36, True), (0.96, 36, False), (0.04, 36, False), (0.96, 144, True), (0.995, 144, False)],
)
def test_how_near_the_end_a_load_is_told_from_the_transient_follows_the_width_of_the_window(position, lines, separates):
    fit = window(position, lines, ModelOrders(3, 2, 0))
    assert np.abs(fit.residual).max() < 1e-6
    assert separates_transient(fit, slice(lines // 3, 2 * lines // 3)) is separates


def test_lower_degrees_tell_more():
    assert not separates_transient(window(0.92, 36, ModelOrders(4, 4, 0)), slice(12, 24))
    assert separates_transient(window(0.92, 36, ModelOrders(2, 1, 0)), slice(12, 24))
