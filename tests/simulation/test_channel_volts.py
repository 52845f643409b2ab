"""Channels solved at the sample rate, with their filters, against the same channels on the fine grid."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import yaml

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.simulation import NO_NOISE, SweepPlan, ZeroPlan, simulate_run, true_rig
from balance_cli.simulation.extensions.base import Extension
from balance_cli.simulation.extensions.library import extension
from tests.support.simulation_rig import GEOMETRY, RIG

SWEEP = SweepPlan(run="s", excited=("Fy",), level=(30.0,), period=1.0, periods=6)
FREQUENCY = np.arange(2, 151)
S = 2j * np.pi * FREQUENCY


def channel_spectra(geometry, *extensions):
    """Amplitudes of the channels (149, c) in the last second."""
    channels = simulate_run(true_rig(geometry).with_extensions(*extensions), SWEEP, NO_NOISE)[0].read().channels
    return np.fft.rfft(channels[-800:], axis=0)[FREQUENCY] / 400


@dataclass(frozen=True)
class Doubled(Extension):
    """An effect that changes the volts that it gets, in place of a copy."""

    name: ClassVar[str] = "doubled"

    def volts(self, signals):
        signals.volts[:, 0] *= 2.0
        return signals.volts


@pytest.mark.parametrize("cutoff", [180.0, 180.01, 181.0], ids=["as anti-alias", "nearly", "apart"])
def test_a_pole_that_a_channel_shares_with_the_anti_alias_filter(cutoff):
    """The fifth pole of the Butterworth filter of 180 Hz is real: partial fractions of two such poles are infinite."""
    content = yaml.safe_load(RIG)
    content["channels"][1]["lowpass"] = cutoff
    changed, plain = channel_spectra(Geometry(**content)), channel_spectra(GEOMETRY)
    factor = (1 + S / (2 * np.pi * 90.0)) / (1 + S / (2 * np.pi * cutoff))
    np.testing.assert_allclose(changed[:, 1], factor * plain[:, 1], rtol=2e-5)


def test_an_effect_that_changes_volts_in_place_is_no_other_effect():
    np.testing.assert_allclose(channel_spectra(GEOMETRY, Doubled())[:, 0], 2 * channel_spectra(GEOMETRY)[:, 0], 1e-5)


def test_mixtures_act_in_their_order_with_other_effects():
    """A gain before and behind a delay; crosstalk of what is late already."""
    late, gain = extension("time-delay", ("x.strain",), delay=1e-3), extension("channel-gain", ("x.strain",), gain=1.5)
    mixed = extension("crosstalk", ("torque", "x.strain"), fraction=0.2)
    plain, some = channel_spectra(GEOMETRY), channel_spectra(GEOMETRY, gain, late, mixed)
    expected = 1.5 * np.exp(-1e-3 * S) * plain[:, 3]
    np.testing.assert_allclose(some[:, 3], expected, rtol=2e-5)
    np.testing.assert_allclose(some[:, 0], plain[:, 0] + 0.2 * expected, rtol=2e-5)
    before = channel_spectra(GEOMETRY, mixed, late, gain)
    np.testing.assert_allclose(before[:, 0], plain[:, 0] + 0.2 * plain[:, 3], rtol=2e-5)


def test_a_record_without_loads_has_nothing_to_delay():
    late = extension("time-delay", ("x.strain",), delay=1e-3)
    run, _ = simulate_run(true_rig(GEOMETRY).with_extensions(late), ZeroPlan(run="z", duration=1.0), NO_NOISE)
    assert not run.read().channels.any()
