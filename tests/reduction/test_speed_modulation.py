"""A rotor speed that varies beside modes: what the response makes of constant loads is neither a line nor a step."""

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.reduction.flags import NOT_STEADY, UNMODELLED_LINE, UNTESTED
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.reduction.speed_modulation import ModulationRemoved
from balance_cli.signals.interpolating_spline import spline_through
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduce import reduce_run
from tests.support.other_rigs import other_rig
from tests.support.wind_record import wind_record

EXACT = {"stiffness": 1e-6, "mass": 1e-6, "centre_of_gravity": 1e-7, "inertia": 1e-6, "damping_ratio": 1e-4}
RIG = other_rig("D")
RIG = RIG.model_copy(update={"tolerances": RIG.tolerances.model_copy(update=EXACT), "damping_ratio": 0.01})
SIZE = np.array([40.0, 40.0, 80.0, 15.0, 15.0, 12.0])


@pytest.fixture(scope="module")
def source():
    return ModelSource(identify(Spectra((), (), (), {}), RIG, IdentifyOptions(method="computed")))


def harmonics():
    rng = np.random.default_rng(8)
    return SIZE * (rng.standard_normal((9, 6)) + 1j * rng.standard_normal((9, 6))) / (1.0 + np.arange(9))[:, None]


def governor(time):
    return 0.01 * np.sin(2 * np.pi * 0.3 * time)


def flags(source, **options):
    record = wind_record(RIG, harmonics(), rate=500.0, seconds=14.0, **options)
    loads = reduce_run(record.run, RIG, None, source)
    words = [{word for row in rows for word in row.split("; ") if word} - {UNTESTED} for rows in loads.flags[1:]]
    return words, loads


@pytest.mark.parametrize(
    "speed_change",
    [governor, lambda t: 0.005 * np.sin(2 * np.pi * t), lambda t: 0.1 * (t / 14.0 - 0.5)],
    ids=["1 % at 0.3 Hz", "0.5 % at 1 Hz", "ramp of 10 %"],
)
def test_the_response_to_constant_loads_has_no_flag(source, speed_change):
    words, _ = flags(source, speed_change=speed_change)
    assert words == [set()] * 8


def test_a_tone_that_does_not_turn_with_the_rotor_is_still_a_line(source):
    words, loads = flags(source, speed_change=governor, further=lambda t, psi: 0.3 * SIZE * np.cos(370.0 * t)[:, None])
    assert all(UNMODELLED_LINE in row for row in words)
    (frequency,) = (float(note.split("line at ")[1].split(" Hz")[0]) for note in loads.notes if "line at" in note)
    assert frequency == pytest.approx(370.0 / (2 * np.pi), abs=1.0 / 14.0)


def test_a_tone_five_bins_from_a_harmonic_is_a_line(source):
    frequency = 3.0 * RIG.rotor.speed + 5.0 / 14.0
    words, _ = flags(source, further=lambda t, psi: 0.3 * SIZE * np.cos(2 * np.pi * frequency * t)[:, None])
    assert UNMODELLED_LINE in words[2]


def test_a_higher_harmonic_is_still_a_line(source):
    words, loads = flags(source, speed_change=governor, further=lambda t, psi: SIZE * np.cos(9 * psi)[:, None])
    assert words == [set()] * 7 + [{UNMODELLED_LINE}]
    assert any("(9/rev)" in note for note in loads.notes)


def test_a_harmonic_that_steps_is_still_not_steady(source):
    first = harmonics()[1]

    def doubled(time, psi):
        return (time > 8.5)[:, None] * (np.exp(1j * psi)[:, None] * first).real

    words, _ = flags(source, speed_change=governor, further=doubled)
    assert NOT_STEADY in words[0]
    assert all(NOT_STEADY not in row for row in words[3:])


@pytest.mark.parametrize("per_break", [3, 50])
def test_carriers_with_their_envelopes_are_taken_out_between_and_beyond_breaks(per_break):
    """The sum by matrix products between breaks is that of the envelopes at each sample."""
    rng, rate, samples = np.random.default_rng(4), 800.0, 500
    breaks = np.arange(-2, samples // per_break - 1) * per_break / rate
    points = rng.standard_normal((len(breaks), 3, 2)) + 1j * rng.standard_normal((len(breaks), 3, 2))
    envelopes, frequency = spline_through(breaks, points, degree=3), np.array([17.0, 34.0, 51.0])
    time = np.arange(samples) / rate
    parent = MemorySource(np.zeros((samples, 3)), None)
    removed = ModulationRemoved(parent, rate, frequency, envelopes, (2, 0))
    carriers = np.exp(2j * np.pi * np.outer(time, frequency))
    expected = -np.real(np.sum(carriers[..., None] * envelopes.polynomials()(time), axis=1))
    read = np.vstack([removed.read(0, 123).channels, removed.read(123, samples).channels])
    assert np.allclose(read[:, [2, 0]], expected, rtol=1e-12, atol=1e-12) and not read[:, 1].any()
