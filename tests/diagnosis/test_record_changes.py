"""A gain or delay that drifts within the records shows in two channels of a cell, first half against last."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.diagnosis.causes import equal_effects, judge_number_of_causes
from balance_cli.diagnosis.conclusions import judge_drifts
from balance_cli.diagnosis.data_tests.channel_drifts import ChannelFit, channel_drift_tests
from balance_cli.diagnosis.data_tests.record_changes import record_tests
from balance_cli.diagnosis.result import (
    EXPLAINED,
    NOTHING_MISSING,
    PARTLY_EXPLAINED,
    RECORD_CHANGE_TEST,
    UNEXPLAINED,
    ModelFreeTest,
)
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.signals.local.nonperiodic_spectrum import nonperiodic_spectrum
from balance_cli.simulation import CampaignPlan, SweepPlan, simulate_campaign, true_rig
from tests.support.diagnosis_content import delay_effect, diagnosis
from tests.support.rigs import rotor_balance

SETTINGS = DEFAULT_SETTINGS.data_tests
SELECTION = DEFAULT_SETTINGS.selection


PERIODS, STEADY = 14, 6


@pytest.fixture(scope="module")
def runs():
    """The last periods of two sweeps, in which the start transients have gone."""
    sweeps = tuple(
        SweepPlan(run=f"sweep-{name}", excited=(name,), level=(level,), period=1.0, periods=PERIODS, band=(4.0, 150.0))
        for name, level in (("Fz", 80.0), ("Mx", 10.0))
    )
    return [
        replace(run, samples=n, source=MemorySource(run.read().channels[-n:], run.read().loads[-n:]))
        for run in simulate_campaign(true_rig(rotor_balance()), CampaignPlan(runs=sweeps), seed=4)[0]
        for n in [STEADY * 800]
    ]


def drifting(run, name, change):
    """The run with one channel changed: `change(volts, time, share of the record)`."""
    block = run.read()
    channels, n = block.channels.copy(), run.samples
    i = run.channel_names.index(name)
    channels[:, i] = change(channels[:, i], np.arange(n) / run.sample_rate, np.arange(n) / n)
    return replace(run, source=MemorySource(channels, block.loads))


def late(x, time, share):
    """A channel whose clock is 20 parts in a million slow."""
    spectrum = np.fft.rfft(np.concatenate([x, x[::-1]]))
    fine = np.fft.irfft(spectrum, 16 * len(x)) * 8.0
    return np.interp(time * (1.0 - 2e-5), np.arange(len(fine)) * time[1] / 8.0, fine)


def rows(runs, geometry=None):
    geometry = rotor_balance() if geometry is None else geometry
    spectra = measured_spectra(runs, geometry, means=True)
    return {row.place: row for row in record_tests(spectra.lines, geometry, SETTINGS)}


def test_steady_records_are_equal(runs):
    found = rows(runs)
    assert {row.name for row in found.values()} == {RECORD_CHANGE_TEST}
    assert {row.finding for row in found.values()} == {"equal"}
    assert min(row.p_value for row in found.values()) * len(found) > 1e-3


@pytest.mark.parametrize("size", [0.01, -0.004])
def test_a_gain_that_drifts_within_the_record_is_named(runs, size):
    """The second and third of six periods against the last two: half of the drift."""
    found = rows([drifting(run, "z1.piezo", lambda x, time, share: x * (1.0 + size * share)) for run in runs])
    row = found.pop("z1.strain, z1.piezo")
    assert row.p_value < 1e-6
    reads = float(row.finding.split("z1.piezo reads ")[1].split()[0])
    assert reads == pytest.approx(1.0 + size / 2.0, abs=1e-4)
    assert {other.finding for other in found.values()} == {"equal"}


def test_a_clock_that_runs_slow_is_a_delay_that_grows(runs):
    """A box whose clock is 20 parts in a million slow is 0.06 ms later three seconds on."""

    row = rows([drifting(run, "z1.piezo", late) for run in runs])["z1.strain, z1.piezo"]
    late_by = float(row.finding.split("z1.piezo is late by ")[1].split()[0])
    assert late_by == pytest.approx(0.06, abs=0.002)
    assert row.p_value < 1e-6


def test_short_records_and_cells_of_one_channel_have_no_row(runs):
    short = [
        replace(run, samples=2400, source=MemorySource(run.read().channels[-2400:], run.read().loads[-2400:]))
        for run in runs
    ]
    assert not rows(short)
    assert not rows(runs, strain_only())


def strain_only():
    """The balance with one channel in each cell."""
    channels = tuple(channel for channel in rotor_balance().channels if not channel.name.endswith("piezo"))
    return rotor_balance().model_copy(update={"channels": channels})


@pytest.mark.parametrize(
    ("names", "change", "size", "words"),
    [
        (("z1.strain", "z3.strain"), late, 0.04, "is late by {} ms; one cause for all of them would be a clock"),
        (("z2.strain",), lambda x, time, share: x * (1.0 - 0.004 * share), 0.998, "reads {} times as much"),
        ((), None, None, "equal"),
    ],
    ids=["clock of a box", "gain", "nothing"],
)
def test_channels_that_are_alone_in_their_cells_are_compared_with_all_others(runs, names, change, size, words):
    """The first two steady periods of a line begin two seconds before the last two, a third of the record."""
    changed = runs
    for name in names:
        changed = [drifting(run, name, change) for run in changed]
    lines = measured_spectra(changed, strain_only(), means=True).lines
    (row,) = channel_drift_tests(lines, strain_only(), SETTINGS)
    before, _, after = words.partition("{}")
    assert before in row.finding and after in row.finding
    if names:
        assert row.place == ", ".join(names) and row.p_value < 1e-6
        assert float(row.finding.split(before)[1].split()[0]) == pytest.approx(size, rel=0.04 if size < 0.1 else 1e-4)
    else:
        assert row.p_value > 1e-3


def test_an_effect_that_is_the_average_of_a_drift_is_not_explained():
    drift = ModelFreeTest(RECORD_CHANGE_TEST, "z1.strain, z1.piezo", 400.0, 2.0, 1e-9, "drifts within the records")
    equal = replace(drift, place="z2.strain, z2.piezo", p_value=0.3, finding="equal")
    explained = replace(diagnosis(EXPLAINED), effects=(delay_effect(),), data_tests=(drift, equal))
    judged = judge_drifts(explained)
    assert judged.verdict == PARTLY_EXPLAINED
    assert judged.notes[-1] == "time-delay@z1.piezo is the average of what drifts within the records, not constant"
    elsewhere = judge_drifts(replace(explained, effects=(replace(delay_effect(), where=("z2.piezo",)),)))
    assert elsewhere.verdict == PARTLY_EXPLAINED
    assert elsewhere.notes[-1] == "z1.strain, z1.piezo: drifts within the records"
    of_group = judge_drifts(replace(explained, effects=(replace(delay_effect(), where=("piezo",)),)))
    assert of_group.notes[-1] == "time-delay@piezo is the average of what drifts within the records, not constant"


def test_a_drift_that_no_effect_describes_is_missing():
    """The noise of the records contains it: chi2/dof of a gain that drifts by 2 % was 1.05."""
    drift = ModelFreeTest(RECORD_CHANGE_TEST, "z1.piezo", 400.0, 2.0, 1e-9, "drifts within the records")
    silent = replace(diagnosis(NOTHING_MISSING), effects=(), data_tests=(drift,))
    assert judge_drifts(silent).verdict == PARTLY_EXPLAINED
    assert judge_drifts(replace(silent, data_tests=(replace(drift, p_value=0.1),))).verdict == NOTHING_MISSING


@pytest.fixture(scope="module")
def random_runs():
    """Sweeps that do not repeat."""
    return random_sweeps(5)


def random_sweeps(seed, factor=1.0):
    sweeps = tuple(
        SweepPlan(
            run=f"sweep-{name}", excited=(name,), level=(factor * level,), excitation="random", period=1.0, periods=6
        )
        for name, level in (("Fz", 80.0), ("Mx", 10.0))
    )
    return simulate_campaign(true_rig(rotor_balance()), CampaignPlan(runs=sweeps), seed=seed)[0]


def random_row(runs):
    spectra = measured_spectra(runs, rotor_balance())
    (row,) = channel_drift_tests(spectra.lines, rotor_balance(), SETTINGS)
    return row


def test_random_records_that_are_steady_are_equal(random_runs):
    assert random_row(random_runs).finding == "equal"


def test_a_box_on_a_late_clock_shows_in_random_records(random_runs):
    """It is 20 parts in a million slow, and so 0.06 ms later in the last three seconds than in the first."""
    strain = tuple(name for name in rotor_balance().channel_names if name.endswith("strain"))
    runs = random_runs
    for name in strain:
        runs = [drifting(run, name, late) for run in runs]
    row = random_row(runs)
    assert row.place == ", ".join(strain) and row.p_value < 1e-12
    assert float(row.finding.split("is late by ")[1].split()[0]) == pytest.approx(0.06, rel=0.01)


def test_channels_that_are_late_are_named_however_little_is_left_of_their_ramp():
    """Lateness of x.strain is 8 sigma; the local models had left it too little of its ramp to count as loaded."""
    strain = tuple(name for name in rotor_balance().channel_names if name.endswith("strain"))
    runs = random_sweeps(8)
    for name in strain:
        runs = [drifting(run, name, late) for run in runs]
    assert random_row(runs).place == ", ".join(strain)


def test_a_gain_that_drifts_shows_in_random_records(random_runs):
    runs = [drifting(run, "y1.piezo", lambda x, time, share: x * (1.0 - 0.02 * share)) for run in random_runs]
    row = random_row(runs)
    assert row.place == "y1.piezo" and row.p_value < 1e-12
    assert float(row.finding.split("reads ")[1].split()[0]) == pytest.approx(0.99, abs=1e-3)


@pytest.mark.parametrize(("size", "place"), [(2e-4, "all channels, in records that do not repeat"), (4e-3, "y1.piezo")])
def test_what_local_models_leave_of_a_response_is_no_drift(size, place):
    """With a thousandth of the noise a drift of 2e-4 would be 20 sigma; local models may seem to drift as much."""
    runs = random_sweeps(5, factor=1e3)
    runs = [drifting(run, "y1.piezo", lambda x, time, share: x * (1.0 - size * share)) for run in runs]
    assert random_row(runs).place == place


@pytest.mark.parametrize(("noise", "tells"), [(1e-3, False), (1e-6, True)])
def test_a_swept_sine_does_not_tell_a_drift_below_its_noise(noise, tells):
    """Its local models leave of the ramp what noise makes of it: sound sweeps had p of 1e-33 by their numbers."""
    rng, rate, count = np.random.default_rng(3), 200.0, 2000
    time, frequency = np.arange(count) / rate, np.fft.rfftfreq(2 * count, 1.0 / rate)
    load = np.sin(2 * np.pi * (5.0 * time + 3.75 * time**2)) * np.clip(np.minimum(time, 10.0 - time), 0.0, 1.0)
    modes = [1.0 / (1.0 - (frequency / f) ** 2 + 0.04j * frequency / f) for f in (22.0, 31.0, 47.0)]
    channels = np.stack([np.fft.irfft(np.fft.rfft(load, 2 * count) * mode)[:count] for mode in modes], axis=1)
    loads = np.column_stack([load + noise * rng.standard_normal(count), np.zeros((count, 5))])
    source = MemorySource(channels + noise * rng.standard_normal(channels.shape), loads)
    names = ("a", "b", "c")
    run = Run("sweep", "rig", "sweep", names, count, source, True, rate, excited=("Fx",), excitation="sine-sweep")
    drift = nonperiodic_spectrum(replace(run, level=(0.7,)), names).drift
    assert bool(np.max(drift.signal_to_noise) > 0.0) == tells
    assert not tells or np.max(np.abs(drift.change[0])) < 2e-4


def test_noise_that_channels_have_in_common_is_no_drift():
    """Two of three channels share nearly all noise: 4 sigma of both are one deviation, not two."""
    rng, count = np.random.default_rng(2), 400
    covariance = np.full((3, 3), 0.99) + 0.01 * np.eye(3)
    covariance[2, :2] = covariance[:2, 2] = 0.0
    weight = np.ones((1, 3))
    drawn = rng.multivariate_normal(np.zeros(3), covariance, count)
    p_values = [ChannelFit.of(y[None], weight).p_value(weight, covariance[None], np.inf) for y in drawn]
    assert np.mean(np.array(p_values) < 0.01) < 0.02


def late_by(delay, channel):
    effect = delay_effect()
    return replace(effect, where=(channel,), parameters=(replace(effect.parameters[0], value=delay),))


def test_one_delay_of_many_channels_is_one_cause():
    """Eight of fifteen channels on one late box were eight causes, which no rig has at once."""
    names = ("x.strain", "y1.strain", "y2.strain", "x.piezo", "y1.piezo", "y2.piezo")
    late = [late_by(2.1e-3 + 2e-6 * (i % 3), name) for i, name in enumerate(names)]
    other = late_by(-2.1e-3, "torque")
    assert sorted(map(len, equal_effects([*late, other], SELECTION))) == [1, 6]
    judged = judge_number_of_causes(replace(diagnosis(EXPLAINED), effects=(*late, other)))
    assert judged.verdict == EXPLAINED
    assert judged.notes[-1].startswith("time-delay is the same in x.strain, ") and "torque" not in judged.notes[-1]


def test_values_that_are_hardly_known_are_not_one():
    vague = replace(delay_effect().parameters[0], sigma=5e-5)
    effects = [replace(delay_effect(), where=(name,), parameters=(vague,)) for name in ("x.piezo", "y1.piezo")]
    effects[1] = replace(effects[1], parameters=(replace(vague, value=3.5e-4),))
    assert len(equal_effects(effects, SELECTION)) == 2


def test_more_causes_than_a_rig_has_at_once_are_no_explanation():
    """Zeros of channels and one fault of all exciters count little; what acts in four cells or channels is four."""
    late = [late_by(2.5e-4 * (i + 1), name) for i, name in enumerate(("x.piezo", "y1.piezo", "y2.piezo", "z1.piezo"))]
    masses = [replace(delay_effect(), name="exciter-mass", where=(name,)) for name in ("Fx", "Fy", "Mz")]
    zero = replace(delay_effect(), name="channel-offset", where=("x.strain",))
    idle = replace(delay_effect(), name="low-pass", worth={"Fx": 1e-3})
    four = replace(diagnosis(EXPLAINED), effects=(*late, zero, idle))
    assert judge_number_of_causes(four) is four
    five = judge_number_of_causes(replace(four, effects=(*late, zero, idle, *masses)))
    assert five.verdict == PARTLY_EXPLAINED
    assert five.notes[-1].startswith("5 causes at once")
    unexplained = replace(five, verdict=UNEXPLAINED)
    assert judge_number_of_causes(unexplained) is unexplained
