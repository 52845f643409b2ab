"""Pulses of a sampled tachometer against the azimuth that made it, seen through an analog low-pass with noise."""

import numpy as np
import pytest
import scipy.signal
from scipy.ndimage import uniform_filter1d

from balance_cli.io.errors import UserError
from balance_cli.signals.rotor import edges
from balance_cli.signals.rotor.low_pass_lag import AnalogLowPass
from balance_cli.signals.rotor.pulse_smoothing import smooth_pulses
from balance_cli.signals.rotor.tachometer import TachometerSettings, read_rotor_reference
from balance_cli.simulation.rotor import RotorKinematics

ROTOR = RotorKinematics(17.5, drift=0.01)
SWING = 5.0


def signal(rate, shape, noise=0.05, duration=8.0, filtered=True, rotor=ROTOR, cutoff=None):
    """A tachometer signal and its low-pass; `shape` is its level from 0 to 1 over the azimuth in revolutions.

    The true signal has 200 000 samples a second, 8 of them averaged over an edge.
    """
    fine = int(np.ceil(2e5 / rate))
    time = np.arange(int(duration * rate * fine)) / (rate * fine)
    level = uniform_filter1d(np.asarray(shape(rotor.azimuth(time) / (2 * np.pi)), float), 8)
    cutoff = cutoff or 0.4 * rate
    if filtered:
        level = scipy.signal.sosfilt(scipy.signal.butter(6, cutoff, fs=rate * fine, output="sos"), level)
    sampled = level[::fine]
    return SWING * (sampled + noise * np.random.default_rng(5).standard_normal(len(sampled))), AnalogLowPass(6, cutoff)


def pulse(width=0.06, per_revolution=1):
    return lambda psi: (psi * per_revolution) % 1.0 < width


def reference(samples, rate, **settings):
    return read_rotor_reference(lambda a, b: samples[a:b], len(samples), rate, TachometerSettings(**settings))


def azimuth_errors(times):
    """Azimuth [deg] at the pulses, those of a whole number of revolutions subtracted."""
    return (np.degrees(ROTOR.azimuth(times)) + 180.0) % 360.0 - 180.0


@pytest.mark.parametrize(("rate", "largest"), [(20000.0, 0.05), (1000.0, 0.3)])
def test_azimuth_of_noisy_pulses(rate, largest):
    samples, low_pass = signal(rate, pulse())
    found = reference(samples, rate, low_pass=low_pass)
    errors = azimuth_errors(found.pulse_times)
    inner = errors[10:-10]
    assert np.sqrt(np.mean(inner**2)) < largest
    assert 0.4 < np.std(errors) / found.azimuth_error_deg < 2.0
    assert found.scatter_deg > 2.0 * found.azimuth_error_deg and found.window > 5


def test_the_low_pass_would_shift_the_azimuth():
    samples, _ = signal(1000.0, pulse(0.3))
    assert np.mean(azimuth_errors(reference(samples, 1000.0).pulse_times)) > 8.0


def test_pulses_without_noise_are_found_between_the_samples():
    samples, low_pass = signal(20000.0, pulse(), noise=0.0)
    assert np.abs(azimuth_errors(reference(samples, 20000.0, low_pass=low_pass).pulse_times)).max() < 0.02


@pytest.mark.parametrize(
    ("width", "cutoff", "largest"), [(0.15, 100.0, 0.15), (0.92, 100.0, 0.4), (0.1, 50.0, 0.6), (0.4, 100.0, 0.1)]
)
def test_pulses_as_short_as_the_response_of_their_low_pass(width, cutoff, largest):
    """By the delay of a step they were 1, 8 and 17 deg off; a pause is as good as a pulse."""
    shape = (lambda psi: psi % 1.0 < width) if width < 0.5 else (lambda psi: psi % 1.0 > 1.0 - width)
    samples, low_pass = signal(500.0, shape, noise=0.002, duration=12.0, cutoff=cutoff)
    found = reference(samples, 500.0, low_pass=low_pass, slope="rising")
    expected = 0.0 if width < 0.5 else 360.0 * (1.0 - width)
    inner = azimuth_errors(found.pulse_times)[10:-10]
    assert abs(np.mean(inner) - expected) < largest
    assert any("hardly longer" in note for note in found.notes) == (width in (0.92, 0.1))


def test_pulses_shorter_than_their_low_pass_lets_them_be():
    samples, _ = signal(2000.0, pulse(0.02), duration=4.0)
    found = reference(samples, 2000.0, low_pass=AnalogLowPass(6, 100.0))
    assert any("does the tachometer pass the `filter` of the map?" in note for note in found.notes)


def test_a_keyway_is_a_pulse_downward():
    samples, low_pass = signal(20000.0, lambda psi: psi % 1.0 > 0.04)
    found = reference(-8.0 + samples, 20000.0, low_pass=low_pass)
    assert "falling" in found.notes[0] and np.abs(azimuth_errors(found.pulse_times)).mean() < 0.05


def test_missing_and_double_pulses_are_repaired_and_said():
    samples, low_pass = signal(
        20000.0, lambda psi: (psi % 1.0 < 0.06) & (np.floor(psi) != 40) | (abs(psi - 90.4) < 0.01)
    )
    found = reference(samples, 20000.0, low_pass=low_pass)
    assert any("missing" in note for note in found.notes) and any("stray" in note for note in found.notes)
    assert np.abs(azimuth_errors(found.pulse_times)).max() < 0.2
    assert np.allclose(np.diff(found.pulse_times), 1 / 17.5, rtol=0.03)


def test_several_pulses_a_revolution_without_index():
    samples, low_pass = signal(20000.0, pulse(0.4, 12))
    found = reference(samples, 20000.0, pulses_per_revolution=12, low_pass=low_pass)
    tooth = np.degrees(ROTOR.azimuth(found.pulse_times)) % 360.0
    assert np.ptp((tooth - tooth[5] + 180) % 360) < 0.3 and any("no index" in note for note in found.notes)


def test_a_missing_tooth_is_the_index():
    shape = lambda psi: ((psi * 12) % 1.0 < 0.4) & (np.floor((psi % 1.0) * 12) != 11)  # noqa: E731
    samples, low_pass = signal(20000.0, shape)
    found = reference(samples, 20000.0, pulses_per_revolution=12, index="gap", low_pass=low_pass)
    assert np.abs(azimuth_errors(found.pulse_times)).max() < 0.2


def test_a_wide_pulse_is_the_index():
    shape = lambda psi: (psi * 4) % 1.0 < np.where(psi % 1.0 < 0.25, 0.5, 0.2)  # noqa: E731
    samples, low_pass = signal(20000.0, shape)
    found = reference(samples, 20000.0, pulses_per_revolution=4, index="wide", low_pass=low_pass)
    assert np.abs(azimuth_errors(found.pulse_times)).max() < 0.2


@pytest.mark.parametrize("counts", [360.0, 4096.0])
@pytest.mark.parametrize("wraps", [True, False])
def test_counts_of_an_encoder(counts, wraps):
    time = np.arange(20000) / 2000.0
    turns = ROTOR.azimuth(time) / (2 * np.pi)
    samples = np.floor(counts * (turns % 1.0 if wraps else turns))
    found = reference(samples, 2000.0, kind="counts", counts_per_revolution=counts)
    errors = azimuth_errors(found.pulse_times)
    assert len(errors) in (174, 175, 176) and np.std(errors) < 360.0 / counts / 3 and abs(np.mean(errors)) < 0.1


def test_an_offset_is_the_azimuth_at_the_pulse():
    samples, low_pass = signal(20000.0, lambda psi: (psi - 0.25) % 1.0 < 0.06)
    found = reference(samples, 20000.0, low_pass=low_pass, offset_deg=90.0)
    assert np.abs(azimuth_errors(found.pulse_times)).max() < 0.2


@pytest.mark.parametrize(
    ("samples", "settings", "words"),
    [
        (np.zeros(5000), {}, "is constant"),
        (np.sin(np.arange(5000) / 20), {"level": 3.0}, "not between its states"),
        (np.arange(5000.0), {}, "crosses the level"),
        (np.random.default_rng(0).standard_normal(5000), {}, "tachometer"),
        (np.ones(50), {"kind": "counts", "counts_per_revolution": 360.0}, "does not count"),
    ],
)
def test_what_is_no_tachometer_is_refused(samples, settings, words):
    with pytest.raises(UserError) as caught:
        reference(samples, 1000.0, **settings)
    assert words in str(caught.value) and caught.value.remedy


def test_the_smoother_keeps_a_change_of_speed():
    revolutions = np.delete(np.arange(800), [100, 101, 400])
    speed_up = RotorKinematics(20.0, drift=0.05, drift_period=11.0)
    exact = np.concatenate([[0.0], speed_up.pulse_times(45.0)])[:800]
    jitter = 2e-5 * np.random.default_rng(2).standard_normal(800)
    smoothed = smooth_pulses((exact + jitter)[revolutions], revolutions)
    assert len(smoothed.times) == 800
    assert np.std(smoothed.times - exact) == pytest.approx(smoothed.sigma, rel=0.35)
    assert smoothed.scatter == pytest.approx(2e-5, rel=0.1)
    assert smooth_pulses(exact, np.arange(800)).sigma < 1e-7


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_an_angle_is_not_read_as_pulses(noise, direction):
    """Its middle, where the edges would be, is half a revolution away from zero."""
    psi = ROTOR.azimuth(np.arange(8000) / 1000.0) / (2 * np.pi)
    angle = 360.0 * ((direction * psi) % 1.0) + 360.0 * noise * np.random.default_rng(2).standard_normal(len(psi))
    with pytest.raises(UserError, match="an angle, not pulses") as raised:
        reference(angle, 1000.0)
    assert "kind: counts" in raised.value.remedy
    found = reference(angle, 1000.0, kind="counts", counts_per_revolution=360.0)
    errors = azimuth_errors(found.pulse_times)
    assert np.max(np.abs(errors)) < 1e-3 + 360.0 * noise / 2 and len(errors) in (140, 141, 142)
    assert noise or len(reference(angle, 1000.0, slope="rising").pulse_times) > 100


@pytest.mark.parametrize(("counts", "noise"), [(250.0, 0.05), (250.0, 2.0), (360.0, 0.02), (2 * np.pi, 0.01)])
def test_noise_does_not_hide_where_an_angle_begins_anew(counts, noise):
    """It carries the angle beyond a revolution, which was then taken for a register of 256, or an unwrapped angle."""
    turns = ROTOR.azimuth(np.arange(20000) / 1000.0) / (2 * np.pi)
    angle = counts * (turns % 1.0) + noise * np.random.default_rng(5).standard_normal(len(turns))
    found = reference(angle, 1000.0, kind="counts", counts_per_revolution=counts)
    errors = azimuth_errors(found.pulse_times)
    assert len(errors) in (349, 350, 351)
    assert np.std(errors) < 1.3 * found.azimuth_error_deg and abs(np.mean(errors)) < 0.1


def test_the_scale_of_an_analog_angle_is_that_of_its_jumps():
    """A converter that is 1 % off had turned the azimuth by 1.2 deg without a word."""
    turns = ROTOR.azimuth(np.arange(8000) / 1000.0) / (2 * np.pi)
    found = reference(356.4 * (turns % 1.0), 1000.0, kind="counts", counts_per_revolution=360.0)
    assert np.max(np.abs(azimuth_errors(found.pulse_times))) < 1e-3 and "356.4" in " ".join(found.notes)


@pytest.mark.parametrize("cutoff", [50.0, 200.0, 400.0])
def test_an_angle_that_a_filter_has_smeared_is_refused(cutoff):
    smeared, low_pass = signal(1000.0, lambda psi: psi % 1.0, noise=0.0, cutoff=cutoff)
    with pytest.raises(UserError) as raised:
        reference(360.0 / SWING * smeared, 1000.0, kind="counts", counts_per_revolution=360.0)
    assert "kind: pulses" in raised.value.remedy
    low_pass = AnalogLowPass(low_pass.order, cutoff)
    found = reference(smeared, 1000.0, slope="falling", low_pass=low_pass)
    assert np.max(np.abs(azimuth_errors(found.pulse_times))) < 360.0 * ROTOR.speed / cutoff / 10.0


@pytest.mark.parametrize(
    "shape",
    [
        pulse(0.5),
        lambda psi: 0.5 + 0.5 * np.sin(2 * np.pi * psi),  # magnetic sensor
        lambda psi: np.abs(2 * (psi % 1.0) - 1.0),  # triangle
        lambda psi: np.exp(-(psi % 1.0) / 0.2),  # behind a high-pass
    ],
)
def test_other_signals_have_pulses(shape):
    samples, _ = signal(1000.0, shape, noise=0.01, filtered=False)
    assert len(reference(samples, 1000.0).pulse_times) == pytest.approx(8 * 17.5, abs=2)


@pytest.mark.parametrize("seed", range(4))
def test_of_two_equal_states_the_rising_edge_counts(seed):
    """Noise decided which of the two was shorter: runs of one campaign were half a revolution apart."""
    time = np.arange(80_000) / 10_000.0
    samples = np.sin(ROTOR.azimuth(time)) + 0.01 * np.random.default_rng(seed).standard_normal(len(time))
    found = reference(samples, 10_000.0)
    assert np.abs(azimuth_errors(found.pulse_times)).max() < 1.0
    assert any("about equally long: state `slope`" in note for note in found.notes)
    sound, low_pass = signal(20000.0, pulse(0.4), duration=2.0)
    assert not any("equally" in note for note in reference(sound, 20000.0, low_pass=low_pass).notes)


def test_two_missing_teeth_are_the_index():
    """A wheel of 60 less 2 teeth, as of an engine, was refused."""
    shape = lambda psi: ((psi * 60) % 1.0 < 0.5) & (np.floor((psi % 1.0) * 60) < 58)  # noqa: E731
    samples, low_pass = signal(50_000.0, shape, duration=3.0)
    found = reference(samples, 50_000.0, pulses_per_revolution=60, index="gap", low_pass=low_pass)
    assert np.abs(azimuth_errors(found.pulse_times)).max() < 0.2


@pytest.mark.parametrize("wide", [0.2, 0.05])
def test_of_two_pulses_the_wide_one_is_the_index_at_any_speed(wide):
    """The median of as many wide as narrow pulses is one or the other, by the speed: the run was refused."""
    rotor = RotorKinematics(17.5, drift=0.03)
    shape = lambda psi: (psi * 2) % 1.0 < np.where(psi % 1.0 < 0.5, wide, 0.1)  # noqa: E731
    samples, low_pass = signal(20000.0, shape, rotor=rotor)
    found = reference(samples, 20000.0, pulses_per_revolution=2, index="wide", low_pass=low_pass)
    azimuth = np.degrees(rotor.azimuth(found.pulse_times)) - (0.0 if wide > 0.1 else 180.0)
    assert np.abs((azimuth + 180.0) % 360.0 - 180.0).max() < 1.0


@pytest.mark.parametrize("rate", [14_000.0, 12_000.0, 10_000.0, 8000.0])
def test_an_encoder_that_was_sampled_slowly_is_refused_or_states_the_speed_that_it_may_be(rate):
    """Pulses faster than half the sample rate look like slower ones: 12 kHz made 15.7 Hz of 17.6 Hz, without a word."""
    samples, _ = signal(rate, pulse(0.5, 360), duration=2.0, filtered=False)
    try:
        assert reference(samples, rate, pulses_per_revolution=360).alias_rate == pytest.approx(17.61, rel=1e-3)
    except UserError as error:
        assert rate > 11_000.0 and "1/rev" in error.remedy


def test_an_encoder_that_was_sampled_fast_is_no_other():
    samples, _ = signal(100_000.0, pulse(0.5, 360), duration=2.0, filtered=False)
    found = reference(samples, 100_000.0, pulses_per_revolution=360)
    assert found.mean_rate == pytest.approx(17.61, rel=1e-3) and found.alias_rate > 10 * found.mean_rate


@pytest.mark.parametrize("block", [1000, 1013])
def test_edges_do_not_depend_on_the_blocks_in_which_samples_are_read(block, monkeypatch):
    """Blocks overlap, and an edge within two samples of their end was found twice: a stray pulse, a wrong gap."""
    samples, _ = signal(20000.0, pulse(0.5, 64), duration=2.0)
    read = lambda a, b: samples[a:b]  # noqa: E731
    levels = edges.find_levels(read, len(samples), None, None)
    whole = edges.find_edges(read, len(samples), 20000.0, levels)
    monkeypatch.setattr(edges, "BLOCK", block)
    parts = edges.find_edges(read, len(samples), 20000.0, levels)
    assert len(whole.rising) > 2200
    assert np.allclose(parts.rising, whole.rising, rtol=0, atol=1e-9)
    assert np.allclose(parts.falling, whole.falling, rtol=0, atol=1e-9)


def test_a_tooth_that_every_revolution_misses_is_named_once():
    """Each of 348 missing teeth had a line of its own, and none said that they may be the index."""
    shape = lambda psi: ((psi * 12) % 1.0 < 0.4) & (np.floor((psi % 1.0) * 12) != 11)  # noqa: E731
    samples, low_pass = signal(20000.0, shape)
    notes = reference(samples, 20000.0, pulses_per_revolution=12, low_pass=low_pass).notes
    assert len(notes) < 8 and any("index: gap" in note for note in notes)
    sound, low_pass = signal(20000.0, pulse(0.4, 12))
    notes = reference(sound, 20000.0, pulses_per_revolution=12, low_pass=low_pass).notes
    assert not any("index: gap" in note for note in notes)


@pytest.mark.parametrize("goes_on", [True, False])
def test_a_count_that_goes_on_states_where_azimuth_0_is(goes_on):
    """An encoder that counts on from any revolution knows no index: azimuths were off by 105 degrees without a word."""
    turns = ROTOR.azimuth(np.arange(20000) / 2000.0) / (2 * np.pi)
    samples = np.floor(360.0 * turns) + 12345.0 if goes_on else np.floor(360.0 * (turns % 1.0))
    notes = reference(samples, 2000.0, kind="counts", counts_per_revolution=360.0).notes
    assert any("multiple of 360" in note for note in notes) is goes_on
