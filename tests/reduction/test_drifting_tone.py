"""A tone in a load that drifts through a harmonic within the record: sigma covers it, and the load is `not steady`."""

import numpy as np
import pytest

from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.reduction.flags import NOT_STEADY
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduce import reduce_run
from tests.reduction.test_speed_modulation import EXACT, RIG, SIZE
from tests.support.wind_record import wind_record

SECONDS, HARMONIC = 12.0, 4
EXACT_RIG = RIG.model_copy(update={"tolerances": RIG.tolerances.model_copy(update=EXACT)})
LOADS = SIZE * np.exp(1j * np.arange(54.0).reshape(9, 6) ** 2)


@pytest.fixture(scope="module")
def source():
    return ModelSource(identify(Spectra((), (), {}, {}), EXACT_RIG, IdentifyOptions(method="computed")))


def reduced(source, size):
    """Loads beside a tone in Fx of a share of 4/rev that drifts from 3.85 to 4.15/rev."""
    speed = EXACT_RIG.rotor.speed

    def tone(time, psi):
        share = np.clip(time / SECONDS, 0.0, 1.0)
        phase = 2.0 * np.pi * speed * SECONDS * ((HARMONIC - 0.15) * share + 0.15 * share**2)
        return size * SIZE[0] * np.cos(phase)[:, None] * (np.arange(6) == 0)

    record = wind_record(EXACT_RIG, LOADS, further=tone if size else None, seconds=SECONDS)
    return reduce_run(record.run, EXACT_RIG, None, source)


def errors(loads):
    """Errors (2, 8, 6) of cosines and sines in standard deviations."""
    error = loads.amplitude[1:] - LOADS[1:]
    return np.stack([error.real / loads.sigma_cosine[1:], error.imag / loads.sigma_sine[1:]])


@pytest.mark.parametrize(("size", "flagged"), [(0.05, False), (0.3, False), (2.0, True)])
def test_sigma_covers_a_tone_that_drifts_through_a_harmonic(source, size, flagged):
    loads = reduced(source, size)
    assert np.abs(errors(loads)).max() < 4.0
    assert (NOT_STEADY in loads.flags[HARMONIC][0]) == flagged
    assert any("does a tone drift through it?" in note for note in loads.notes) == flagged


def test_sigma_of_a_steady_record_is_that_of_its_noise(source):
    loads = reduced(source, 0.0)
    assert np.abs(errors(loads)).max() < 4.0 and not any(NOT_STEADY in flag for row in loads.flags for flag in row)
