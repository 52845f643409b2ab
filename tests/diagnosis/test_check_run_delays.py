"""Check runs whose channels are late against the loads are named with the delay; other departures are not delays."""

from types import SimpleNamespace

import numpy as np
import pytest

from balance_cli.diagnosis.consistency.campaign import _deviating_runs
from balance_cli.diagnosis.consistency.delays import common_delay
from balance_cli.diagnosis.consistency.findings import DELAY, DIFFERENT_RIG

FREQUENCY = 17.5 * np.arange(1, 9)
RNG = np.random.default_rng(1)
PREDICTED = (RNG.standard_normal((8, 5)) + 1j * RNG.standard_normal((8, 5))) * np.geomspace(100.0, 1.0, 8)[:, None]


def late(delay, noise=0.05, seed=2):
    """The readings, late, with noise of a share of their size at each line."""
    rng = np.random.default_rng(seed)
    scatter = (rng.standard_normal(PREDICTED.shape) + 1j * rng.standard_normal(PREDICTED.shape)) / np.sqrt(2.0)
    size = np.sqrt(np.mean(np.abs(PREDICTED) ** 2, axis=1))[:, None]
    return PREDICTED * np.exp(-2j * np.pi * delay * FREQUENCY)[:, None] + noise * size * scatter


@pytest.mark.parametrize("delay", [3e-3, -3e-3, 1.25e-3, 8e-3])
@pytest.mark.parametrize("scale", [1.0, 1e-3, 50.0])
def test_the_delay_at_any_time_scale(delay, scale):
    found = common_delay(FREQUENCY / scale, late(delay), PREDICTED)
    assert found == pytest.approx(delay * scale, rel=0.02)


def test_noise_gains_and_another_response_are_no_delay():
    assert all(common_delay(FREQUENCY, late(0.0, seed=k), PREDICTED) is None for k in range(200))
    assert common_delay(FREQUENCY, 1.5 * PREDICTED, PREDICTED) is None
    assert common_delay(FREQUENCY, -PREDICTED, PREDICTED) is None
    assert common_delay(FREQUENCY, PREDICTED[:, ::-1], PREDICTED) is None
    lag = 1.0 / (1.0 + 1j * FREQUENCY / 60.0)[:, None]  # a support that moves bends amplitude and phase
    assert common_delay(FREQUENCY, np.where(np.arange(5) < 2, lag, 1.0) * PREDICTED, PREDICTED) is None


def evidence(forces):
    rows = SimpleNamespace(kind="check", frequency=FREQUENCY)
    reference = np.repeat(PREDICTED[:, :, None], 6, axis=2)
    loads = np.eye(6)[np.zeros(8, int)]
    return SimpleNamespace(run="check-1", rows=rows, applied=(0,), reference=reference, loads=loads, forces=forces)


def test_the_check_run_is_named():
    (finding,) = _deviating_runs([evidence(late(3e-3))])
    assert finding.kind == DELAY
    assert finding.sentence.startswith("the channels come 3 ms later after the loads") and "check-1" in finding.sentence
    assert [item.kind for item in _deviating_runs([evidence(PREDICTED[:, ::-1])])] == [DIFFERENT_RIG]
    assert _deviating_runs([evidence(late(0.0))]) == []
