"""A single tap near the start of its record, as a trigger records it: the usual hammer test."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.io.errors import UserError
from balance_cli.signals.early_taps import prepend_rest
from balance_cli.signals.impact import use_hammer_record
from balance_cli.signals.local.noise import whitening_matrices
from balance_cli.signals.local.response import local_response

RATE, SAMPLES, OMEGA, ZETA = 4000.0, 4000, 2 * np.pi * 35.0, 0.01
RNG = np.random.default_rng(4)


def tapped(tap, noise=0.0, state=(0.0, 0.0), force_noise=0.0):
    """One mode of unit static response, struck at `tap` [s] by a pulse of 3.5 ms, from an initial state."""
    time = np.arange(SAMPLES) / RATE
    inside = (time > tap) & (time < tap + 0.0035)
    force = np.where(inside, 42.0 * np.sin(np.pi * (time - tap) / 0.0035) ** 2, 0.0)
    system = scipy.signal.StateSpace(
        [[0.0, 1.0], [-(OMEGA**2), -2 * ZETA * OMEGA]], [[0.0], [OMEGA**2]], [[1.0, 0.0]], [[0.0]]
    )
    response = scipy.signal.lsim(system, force, time, X0=state)[1] + noise * RNG.normal(size=SAMPLES)
    loads = np.zeros((SAMPLES, 6))
    loads[:, 2] = force + force_noise * RNG.normal(size=SAMPLES)
    source = MemorySource(response[:, None], loads)
    return Run(
        *("tap", "rig", "sweep", ("z",), SAMPLES, source, True, RATE),
        excited=("Fz",),
        excitation="impact",
        level=(1.0,),
    )


def response_error(run):
    """Error of the response to 150 Hz over the response, and the median error over its stated sigma."""
    found = local_response(prepend_rest(use_hammer_record(run)), ("z",))
    at = found.frequency < 150.0
    omega = 2 * np.pi * found.frequency[at]
    true = OMEGA**2 / (OMEGA**2 - omega**2 + 2j * ZETA * OMEGA * omega)
    error = np.abs(found.response[at, 0, 0] - true)
    sigma = np.sqrt(found.channel_covariance[at, 0, 0].real * found.load_covariance[at, 0, 0].real)
    return np.sqrt(np.mean(error**2) / np.mean(np.abs(true) ** 2)), np.median(error / sigma)


@pytest.mark.parametrize("tap", [0.0005, 0.005, 0.02, 0.2])
def test_the_response_is_right_wherever_the_tap_is(tap):
    """With taps in the first 2 % of the record it was off by 7 % to 10^6 %."""
    error, over_sigma = response_error(tapped(tap, noise=0.05))
    assert error < 0.002 and 0.4 < over_sigma < 1.7


def test_the_noise_of_a_force_cell_does_not_hide_the_tap():
    error, over_sigma = response_error(tapped(0.005, noise=0.05, force_noise=0.4))
    assert error < 0.02 and over_sigma < 2.0


def test_a_rig_that_was_not_at_rest_has_no_rest_before_its_record():
    run = tapped(0.01, state=(2.0, 0.0))
    assert prepend_rest(run) is run
    late = tapped(0.3)
    assert prepend_rest(late) is late


def test_a_record_that_begins_within_its_tap_is_refused():
    run = tapped(0.01)
    block = run.read()
    cut = replace(run, samples=SAMPLES - 44, source=MemorySource(block.channels[44:], block.loads[44:]))
    with pytest.raises(UserError, match="begins within a tap"):
        prepend_rest(cut)


def test_a_record_without_a_hit_is_refused():
    """The trigger missed: the force is noise alone."""
    run = tapped(0.01, noise=0.05)
    loads = np.zeros((SAMPLES, 6))
    loads[:, 2] = RNG.normal(size=SAMPLES)
    with pytest.raises(UserError, match="no load has a hit"):
        use_hammer_record(replace(run, source=MemorySource(run.read().channels, loads)))


def test_noise_of_a_computed_record_is_whitened_although_rounding_made_it_indefinite():
    covariance = np.array([[[1.0, 1.0], [1.0, 1.0 - 1e-15]]], complex) * 1e-12
    assert np.isfinite(whitening_matrices(covariance)).all()
